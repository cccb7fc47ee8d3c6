// SPDX-License-Identifier: Apache-2.0
//
// Recordings: reading them with the calls of live streams, going through all their samples, and
// writing them.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>
#include <pybind11/stl/filesystem.h>

#include <dssm/recording.hpp>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "client/python/reader.hpp"
#include "client/python/writer.hpp"

namespace dssm::python {
namespace {

// --- reading

struct RecordedReader {
  RecordedReader(Recording from, const StreamId& id, const WantedType& wanted)
      : reads(open(from, id), wanted), recording(std::move(from)) {}

  static RecordedRawReader open(const Recording& from, const StreamId& id) {
    return value_without_gil([&] { return from.open_raw_reader(id); });
  }
  Reads<RecordedRawReader> reads;
  Recording recording;
};

// As of a live stream, of all incarnations; read by a reader of its own, which keeps the cursor.
// `wait` is that of Reader.history(): nothing arrives in a recording.
py::object recorded_history(RecordedReader& reader, py::handle from, py::handle to,
                            py::handle /*wait*/) {
  const Time t0 = to_time(from), t1 = to_time(to);
  const ValueType& values = reader.reads.values();
  RecordedRawReader raw = RecordedReader::open(reader.recording, reader.reads.raw().id());
  std::vector<std::byte> payload(raw.payload_bytes()), payloads;
  std::vector<SampleInfo> infos;
  without_gil([&] {
    SampleInfo info;
    ReadStatus status = t0 < t1 ? ReadStatus::restarted : ReadStatus::not_yet;
    while (status == ReadStatus::restarted) status = raw.read_at_or_after(t0, payload, info);
    if (status == ReadStatus::ok) raw.seek(info.tid);
    while (status == ReadStatus::ok && info.time < t1) {
      zero_rest(payload, info);
      infos.push_back(info);
      payloads.insert(payloads.end(), payload.begin(), payload.end());
      do {
        status = raw.read_next(payload, info);
      } while (status == ReadStatus::restarted);
    }
  });
  Rows rows(values, infos.size());
  for (std::size_t i = 0; i < infos.size(); ++i) {
    std::copy_n(payloads.data() + i * payload.size(), payload.size(), rows.payload().data());
    rows.add(infos[i]);
  }
  return rows.result();
}

// Goes through all samples of a recording.
struct Cursor {
  explicit Cursor(const Recording& from) : recording(from), cursor(from.cursor()) {}

  // (index of the stream, Sample); none at an end.
  template <bool kForward>
  std::optional<py::tuple> step() {
    RecordedSample sample;
    {
      const Use use(in_use);
      const bool found =
          without_gil([&] { return kForward ? cursor.next(sample) : cursor.previous(sample); });
      if (!found) return std::nullopt;
    }
    const auto found =
        types.try_emplace(sample.stream, recording.streams()[sample.stream].type).first;
    const ValueType& values = found->second;
    const py::object array = values.new_array();
    std::ranges::copy(sample.payload, ValueType::bytes_of(array).begin());
    return py::make_tuple(sample.stream,
                          make_sample(sample.info, values.value_of(array, sample.info)));
  }

  Recording recording;
  RecordingCursor cursor;
  std::map<std::size_t, ValueType> types;
  bool in_use = false;
};

Recording open_recording(const py::object& path) {
  std::vector<std::filesystem::path> files;
  if (py::isinstance<py::list>(path) || py::isinstance<py::tuple>(path)) {
    files = path.cast<std::vector<std::filesystem::path>>();
    return value_without_gil([&] { return Recording::open(files); });
  }
  const auto one = path.cast<std::filesystem::path>();
  return value_without_gil([&] { return Recording::open(one); });
}

py::object recorded_property(const Recording& recording, std::size_t stream, py::handle time) {
  if (stream >= recording.streams().size())
    throw py::index_error("there is no stream of that index");
  const RecordedStreamInfo& info = recording.streams()[stream];
  const std::optional<std::size_t> index =
      time.is_none() ? (info.property_times.empty() ? std::nullopt
                                                    : std::optional(info.property_times.size() - 1))
                     : info.property_at(to_time(time));
  if (!index) return py::none();
  const auto bytes = value_without_gil([&] { return recording.property(stream, *index); });
  return py::bytes(reinterpret_cast<const char*>(bytes.data()), bytes.size());
}

// --- writing

struct RecordingFile {
  explicit RecordingFile(RecordingWriter of) : writer(std::move(of)) {}
  RecordingWriter& checked() {
    Use::check(in_use);
    if (!writer) raise("closed", "the recording is finished");
    return *writer;
  }
  std::optional<RecordingWriter> writer;  // empty: finished
  bool in_use = false;
};

// A stream of a recording that is written.
struct RecordedOutput {
  std::shared_ptr<RecordingFile> file;
  std::uint32_t number = 0;
  StreamId id;
  ValueType values;
  Tid next_tid = 0;
};

std::shared_ptr<RecordingFile> create_recording(const std::filesystem::path& file,
                                                const std::string& compression,
                                                std::uint64_t max_file_bytes,
                                                std::uint64_t max_total_bytes) {
  RecordingOptions options;
  options.max_file_bytes = max_file_bytes;
  options.max_total_bytes = max_total_bytes;
  if (compression == "none") {
    options.compression = Compression::none;
  } else if (compression == "lz4") {
    options.compression = Compression::lz4;
  } else if (compression == "zstd") {
    options.compression = Compression::zstd;
  } else {
    throw py::value_error("a compression is 'none', 'lz4' or 'zstd', not '" + compression + "'");
  }
  return std::make_shared<RecordingFile>(
      value_without_gil([&] { return RecordingWriter::create(file, options); }));
}

std::unique_ptr<RecordedOutput> add_stream(const std::shared_ptr<RecordingFile>& file,
                                           std::string_view name, py::handle type,
                                           std::uint64_t depth, py::handle cycle,
                                           std::uint64_t incarnation, const py::bytes& property) {
  const WantedType wanted = wanted_type(type);
  if (!wanted.type)
    throw py::type_error("add_stream() needs the type of the stream's samples, not None");
  RecordedStream stream;
  stream.id = to_stream_id(name);
  stream.type = *wanted.type;
  stream.depth = depth;
  stream.cycle = to_duration(cycle);
  stream.incarnation = incarnation;
  const std::string_view bytes = property;
  const auto as_bytes = std::as_bytes(std::span<const char>(bytes.data(), bytes.size()));
  stream.property.assign(as_bytes.begin(), as_bytes.end());
  RecordingWriter& writer = file->checked();
  const Use use(file->in_use);
  const std::uint32_t number = value_without_gil([&] { return writer.add_stream(stream); });
  return std::make_unique<RecordedOutput>(
      RecordedOutput{file, number, stream.id, ValueType(stream.type, wanted.dtype)});
}

void record_sample(RecordedOutput& output, py::handle value, py::handle time,
                   std::optional<Tid> tid, py::handle clock_error_ns) {
  RecordingWriter& writer = output.file->checked();
  SampleInfo info;
  Duration to_recorder = kUnknownClockError;
  py::object keeper;
  std::span<const std::byte> payload;
  if (is_sample(value)) {
    info = info_of(value);
    payload = output.values.payload_of(value_of(value), keeper);
    payload = payload.first(std::min<std::size_t>(payload.size(), info.payload_bytes));
  } else {
    payload = output.values.payload_of(value, keeper);
    info.tid = output.next_tid;
    info.time = WallClock::now();
    info.clock_error = kForeignClockError;
  }
  if (!time.is_none()) info.time = to_time(time);
  if (tid) info.tid = *tid;
  if (!clock_error_ns.is_none()) to_recorder = to_clock_error(clock_error_ns);
  info.payload_bytes = payload.size();
  {
    const Use use(output.file->in_use);
    value_without_gil([&] { return writer.write(output.number, info, to_recorder, payload); });
  }
  output.next_tid = info.tid + 1;
}

void finish(RecordingFile& file) {
  if (!file.writer) return;
  RecordingWriter& writer = file.checked();
  {
    const Use use(file.in_use);
    value_without_gil([&] { return writer.finish(); });
  }
  file.writer.reset();
}

void define_recorded_infos(py::module_& module) {
  py::class_<RecordedStreamInfo>(module, "RecordedStreamInfo",
                                 "A stream in a recording, of one incarnation.")
      .def_property_readonly(
          "name", [](const RecordedStreamInfo& s) { return s.id.str(); }, "'lidar:0@pc1'.")
      .def_property_readonly(
          "type", [](const RecordedStreamInfo& s) { return s.type; }, "Its description.")
      .def_property_readonly(
          "depth", [](const RecordedStreamInfo& s) { return s.depth; }, "Of its ring.")
      .def_property_readonly(
          "cycle", [](const RecordedStreamInfo& s) { return to_seconds(s.cycle); },
          "The expected time between two samples [s].")
      .def_property_readonly(
          "incarnation", [](const RecordedStreamInfo& s) { return s.incarnation; },
          "Differs between two rings of one name.")
      .def_readonly("samples", &RecordedStreamInfo::samples, "How many are in the recording.")
      .def_readonly("payload_bytes", &RecordedStreamInfo::payload_bytes, "Of all samples.")
      .def_readonly("lost_samples", &RecordedStreamInfo::lost_samples,
                    "That could not be recorded.")
      .def_readonly("first_tid", &RecordedStreamInfo::first_tid, "NO_TID without samples.")
      .def_readonly("last_tid", &RecordedStreamInfo::last_tid, "NO_TID without samples.")
      .def_property_readonly(
          "first_time_ns", [](const RecordedStreamInfo& s) { return to_ns(s.first_time); },
          "The least time of its samples.")
      .def_property_readonly(
          "last_time_ns", [](const RecordedStreamInfo& s) { return to_ns(s.last_time); },
          "The greatest time of its samples.")
      .def("__repr__", [](const RecordedStreamInfo& s) {
        return "<dssm.RecordedStreamInfo " + s.id.str() + ", " + std::to_string(s.samples) +
               " samples>";
      });
  py::class_<RecordedTrigger>(module, "RecordedTrigger", "Why something was recorded.")
      .def_readonly("name", &RecordedTrigger::name, "Of the trigger.")
      .def_readonly("reason", &RecordedTrigger::reason, "A sentence; may be empty.")
      .def_readonly("host", &RecordedTrigger::host, "Where it happened.")
      .def_property_readonly(
          "time_ns", [](const RecordedTrigger& t) { return to_ns(t.time); }, "When it happened.");
}

void define_reading(py::module_& module) {
  py::class_<RecordedReader, std::shared_ptr<RecordedReader>> reader(
      module, "RecordedReader",
      "Reads a stream in a recording with the calls of Reader. next() begins with the first "
      "sample; "
      "None is the end. For one thread at a time. Recording.reader() makes it.");
  define_reads(reader);
  reader
      .def("history", &recorded_history, py::arg("t0"), py::arg("t1"), py::kw_only(),
           py::arg("wait") = false,
           "The samples with t0 <= time < t1 as one numpy.recarray, as Reader.history().")
      .def("__iter__", [](py::object self) { return self; })
      .def("__next__", [](RecordedReader& r) {
        py::object sample = r.reads.next(py::cast(false));
        if (sample.is_none()) throw py::stop_iteration();
        return sample;
      });

  py::class_<Cursor>(
      module, "RecordingCursor",
      "Goes through all samples of all streams, in the order in which they were recorded. "
      "For one thread at a time.")
      .def("__iter__", [](py::object self) { return self; })
      .def("__next__",
           [](Cursor& c) {
             const auto sample = c.step<true>();
             if (!sample) throw py::stop_iteration();
             return *sample;
           })
      .def("next", &Cursor::step<true>, "(index in Recording.streams, Sample); None at the end.")
      .def("previous", &Cursor::step<false>,
           "The same of the sample before; None at the beginning.")
      .def(
          "seek",
          [](Cursor& c, py::handle time) {
            const Time t = to_time(time);
            const Use use(c.in_use);
            without_gil([&] { return c.cursor.seek(t), true; });
          },
          py::arg("time"), "next() returns the first sample recorded with at least that time.");

  py::class_<Recording>(
      module, "Recording",
      "A recording that is open for reading: an MCAP file, a folder of them, or logs of SSM.")
      .def(py::init(&open_recording), py::arg("path"),
           "Opens a file, all files of a folder, or a list of files. Needs no dssmd.")
      .def_property_readonly("streams", &Recording::streams,
                             "Its streams: a list of RecordedStreamInfo.")
      .def_property_readonly("files", &Recording::files,
                             "Its files, in the order in which they were written.")
      .def_property_readonly("triggers", &Recording::triggers, "What made the recorder write.")
      .def_property_readonly("warnings", &Recording::warnings,
                             "What could not be read, a sentence each.")
      .def(
          "reader",
          [](const Recording& recording, std::string_view name, py::handle type) {
            return std::make_shared<RecordedReader>(recording, to_stream_id(name),
                                                    wanted_type(type));
          },
          py::arg("name"), py::arg("type") = py::none(),
          "A reader of one stream; type: as Session.reader().")
      .def(
          "cursor", [](const Recording& recording) { return Cursor(recording); },
          "A RecordingCursor before the first sample.")
      .def("__iter__", [](const Recording& recording) { return Cursor(recording); })
      .def("property", &recorded_property, py::arg("stream"), py::arg("time") = py::none(),
           "The property that the stream with that index had at `time`, None: at last, as bytes; "
           "None if "
           "it had none.");
  module.def("_read_joint_recorded",
             [](py::handle time, const std::vector<std::shared_ptr<RecordedReader>>& readers,
                py::handle max_error, py::handle max_age, py::handle wait) {
               return read_joint<RecordedJointSample>(time, readers, max_error, max_age, wait);
             });
}

void define_writing(py::module_& module) {
  py::class_<RecordedOutput>(module, "RecordedOutput", "A stream of a recording that is written.")
      .def("write", &record_sample, py::arg("value"), py::arg("time") = py::none(), py::kw_only(),
           py::arg("tid") = py::none(), py::arg("clock_error_ns") = py::none(),
           "Adds a sample: a Sample with its tid and time, or a value as Writer.write() takes "
           "it.\n\n"
           "time: None is the Sample's, or now.\ntid: None is the Sample's, or the one after the "
           "last.\n"
           "clock_error_ns: bound on the distance of the time from this PC's clock; None: not "
           "known.")
      .def(
          "add_gap",
          [](RecordedOutput& o, Tid first, std::uint64_t count) {
            RecordingWriter& writer = o.file->checked();
            const Use use(o.file->in_use);
            value_without_gil([&] { return writer.add_gap(o.number, first, count); });
          },
          py::arg("first"), py::arg("count"), "Samples from `first` on could not be kept.")
      .def_property_readonly(
          "name", [](const RecordedOutput& o) { return o.id.str(); }, "The stream.");
  py::class_<RecordingFile, std::shared_ptr<RecordingFile>>(
      module, "RecordingWriter", "Writes a recording. For one thread at a time.")
      .def(py::init(&create_recording), py::arg("file"), py::kw_only(),
           py::arg("compression") = "lz4", py::arg("max_file_bytes") = 0,
           py::arg("max_total_bytes") = 0,
           "Creates a file, which must not exist.\n\n"
           "compression: 'none', 'lz4' or 'zstd'.\n"
           "max_file_bytes: continues in another file at this size; 0: one file.\n"
           "max_total_bytes: deletes the oldest files beyond this; 0: none.")
      .def("add_stream", &add_stream, py::arg("name"), py::arg("type"), py::kw_only(),
           py::arg("depth") = 0, py::arg("cycle") = 0.0, py::arg("incarnation") = 0,
           py::arg("property") = py::bytes(),
           "Adds a stream; the result has write(). `reader.type` records a stream as it is.")
      .def("finish", &finish, "Completes the file. The end of a `with` block does it.")
      .def("__enter__", [](py::object self) { return self; })
      .def("__exit__", [](RecordingFile& f, const py::args&) { finish(f); });
}

}  // namespace

void define_recordings(py::module_& module) {
  define_recorded_infos(module);
  define_reading(module);
  define_writing(module);
}

}  // namespace dssm::python
