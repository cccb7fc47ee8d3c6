// SPDX-License-Identifier: Apache-2.0
//
// The reads that a reader of a live stream and one of a recording have in common, for Python: the
// same names, arguments and results, so that a program can use either.
//
// None is returned for not_yet, an exception raised for each other result but `restarted`: reads
// continue with the new ring by themselves, except those of a given tid, which raise Restarted.
#pragma once

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <cstring>
#include <dssm/recording.hpp>
#include <memory>
#include <optional>
#include <set>
#include <thread>
#include <vector>

#include "client/python/python.hpp"
#include "client/python/values.hpp"

namespace dssm::python {

// Raises the exception for a result of a read other than ok. `what` was read: "sample 5".
[[noreturn]] void raise(ReadStatus status, const StreamId& id, const std::string& what);

template <class Raw>
class Reads {
 public:
  // Reads of a recording may wait for the disk.
  static constexpr bool kMayWait = std::is_same_v<Raw, RecordedRawReader>;

  Reads(Raw raw, const WantedType& wanted)
      : raw_(std::make_shared<Raw>(std::move(raw))),
        values_(wanted.dtype.is_none() ? ValueType(raw_->type())
                                       : ValueType(raw_->type(), wanted.dtype)) {
    check_type(raw_->id(), raw_->type(), wanted);
  }

  // The reader, if it is neither closed nor in use.
  Raw& raw() const {
    Use::check(in_use_);
    if (!raw_) raise("closed", "the reader is closed");
    return *raw_;
  }
  bool& in_use() const { return in_use_; }
  const ValueType& values() const { return values_; }

  void close() {
    Use::check(in_use_);
    raw_.reset();
  }
  bool is_closed() const { return !raw_; }

  // --- by tid and in order

  py::object newest() {
    return read([](Raw& raw, auto payload, auto& info) { return raw.read_newest(payload, info); },
                [] { return std::string("the newest sample"); });
  }

  py::object next(py::handle wait) {
    if constexpr (!kMayWait) {
      if (!wait.is(py::handle(Py_False)) && !this->wait(wait_deadline(wait))) return py::none();
    }
    return read(
        [this](Raw& raw, auto payload, auto& info) {
          return is_new_ && !kMayWait ? raw.read_newest(payload, info)
                                      : raw.read_next(payload, info);
        },
        [] { return std::string("the next sample"); });
  }

  py::object previous() {
    return read([](Raw& raw, auto payload, auto& info) { return raw.read_previous(payload, info); },
                [] { return std::string("the previous sample"); });
  }

  py::object tid(Tid tid) {
    return read(
        [&](Raw& raw, auto payload, auto& info) { return raw.read_tid(tid, payload, info); },
        [&] { return "sample " + std::to_string(tid); }, false);
  }

  py::object info(Tid tid) {
    SampleInfo info;
    return checked(raw_read([&](Raw& raw) { return raw.read_info(tid, info); }), info,
                   [&] { return "sample " + std::to_string(tid); });
  }

  void seek(Tid tid) {
    raw().seek(tid);
    is_new_ = false;
  }

  // --- by time

  py::object at(py::handle time, py::handle max_age, py::handle wait) {
    const Time t = to_time(time);
    const Duration age = to_duration(max_age, kAnyAge);
    return read_by_time(
        [&](Raw& raw, auto payload, auto& info) { return raw.read_at(t, payload, info, age); }, t,
        wait_deadline(wait));
  }
  py::object at_or_after(py::handle time) {
    const Time t = to_time(time);
    return read_by_time(
        [&](Raw& raw, auto payload, auto& info) { return raw.read_at_or_after(t, payload, info); },
        t);
  }
  py::object nearest(py::handle time) {
    const Time t = to_time(time);
    return read_by_time(
        [&](Raw& raw, auto payload, auto& info) { return raw.read_nearest(t, payload, info); }, t);
  }
  py::object find(py::handle time) {
    const Time t = to_time(time);
    SampleInfo info;
    return checked(raw_read([&](Raw& raw) { return raw.find(t, info); }), info,
                   [&] { return text_of(t); });
  }

  py::object neighbours(py::handle time) {
    const Time t = to_time(time);
    check_leases();
    const py::object before = values_.new_array(), after = values_.new_array();
    Neighbours infos;
    ReadStatus status;
    do {
      status = raw_read([&](Raw& raw) {
        return raw.read_neighbours(t, ValueType::bytes_of(before), ValueType::bytes_of(after),
                                   infos);
      });
      check_leases();
    } while (status == ReadStatus::restarted);
    if (status == ReadStatus::not_yet) return py::none();
    if (status != ReadStatus::ok) raise(status, raw_->id(), "the neighbours of " + text_of(t));
    return py::make_tuple(make_sample(infos.before, values_.value_of(before, infos.before)),
                          make_sample(infos.after, values_.value_of(after, infos.after)));
  }

  // --- views of the ring

  // A view of the ring, which the reader unmaps when it restarts for the second time after it was
  // made: `restarts` of then.
  std::multiset<std::uint64_t>& leases() { return leases_; }
  const std::shared_ptr<Raw>& shared_raw() const { return raw_; }  // null: closed

  // Raises an exception if a read could unmap memory that a view shows.
  void check_leases() const {
    if (leases_.empty() || *leases_.begin() >= raw().restarts()) return;
    raise("in_use",
          "read '" + raw().id().str() +
              "': an array of a borrowed sample still shows a ring that the stream has not had "
              "since a restart; delete it, or copy it while it is borrowed");
  }

  // A read that may set the cursor or continue with another ring; `what` names it for errors.
  // Repeated until the deadline while the sample is `arriving`.
  template <class Read, class What>
  py::object read(Read read, What what, bool follows_restarts = true,
                  MonoTime arriving_until = MonoTime::min()) {
    check_leases();
    const py::object array = values_.new_array();
    SampleInfo info;
    ReadStatus status = ReadStatus::ok;
    do {
      status = raw_read([&](Raw& raw) { return read(raw, ValueType::bytes_of(array), info); });
      if (status == ReadStatus::restarted) {
        is_new_ = false;
        check_leases();
      }
    } while ((status == ReadStatus::restarted && follows_restarts) ||
             (status == ReadStatus::arriving && pause_while_arriving(arriving_until)));
    if (status == ReadStatus::not_yet) return py::none();
    if (status != ReadStatus::ok) raise(status, raw_->id(), what());
    is_new_ = false;
    return make_sample(info, values_.value_of(array, info));
  }

  bool wait(MonoTime deadline) requires(!kMayWait) {
    Raw& raw = this->raw();
    const Use use(in_use_);
    return wait_in_slices(deadline, [&](MonoTime end) { return raw.wait(end); });
  }

  // After a read whose sample is `arriving`: sleeps until it is worth another attempt. Nothing
  // notifies of a time whose sample has arrived, so the reads are repeated.
  //   returns  whether the deadline has not passed
  bool pause_while_arriving(MonoTime deadline) {
    constexpr Duration kPeriod = std::chrono::milliseconds(5);
    if (MonoClock::now() >= deadline) return false;
    {
      const Use use(in_use_);
      without_gil([&] { std::this_thread::sleep_until(std::min(deadline, deadline_in(kPeriod))); });
    }
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
    return true;
  }

  // For reads that set the cursor where Python's must keep it.
  bool& is_new() { return is_new_; }

  static std::string text_of(Time t) { return "time " + std::to_string(to_ns(t)) + " ns"; }

 private:
  template <class Read>
  py::object read_by_time(Read by_time, Time t, MonoTime arriving_until = MonoTime::min()) {
    const bool was_new = is_new_;  // reads by time keep the cursor
    const std::uint64_t restarts = raw().restarts();
    py::object sample = read(
        by_time, [&] { return text_of(t); }, true, arriving_until);
    is_new_ = was_new && raw_->restarts() == restarts;
    return sample;
  }

  template <class What>
  py::object checked(ReadStatus status, const SampleInfo& info, What what) const {
    if (status == ReadStatus::not_yet) return py::none();
    if (status != ReadStatus::ok) raise(status, raw_->id(), what());
    return py::cast(info);
  }

  template <class Read>
  ReadStatus raw_read(Read read) {
    Raw& raw = this->raw();
    if constexpr (kMayWait) {
      const Use use(in_use_);
      return without_gil([&] { return read(raw); });
    } else {
      return read(raw);
    }
  }

  std::shared_ptr<Raw> raw_;  // null: closed
  ValueType values_;
  bool is_new_ = true;  // the next sample in order is the newest one
  mutable bool in_use_ = false;
  std::multiset<std::uint64_t> leases_;
};

// The rows of a history while they are filled.
class Rows {
 public:
  Rows(const ValueType& values, std::size_t capacity)
      : array_(values.new_rows(capacity)),
        data_(ValueType::data_of(array_)),
        row_bytes_(values.row_bytes()) {}

  // Where the payload of the next row goes; then add() completes the row.
  std::span<std::byte> payload() const noexcept {
    return {data_ + size_ * row_bytes_ + ValueType::kRowHeaderBytes,
            row_bytes_ - ValueType::kRowHeaderBytes};
  }
  void add(const SampleInfo& info) noexcept {
    zero_rest(payload(), info);
    const std::int64_t header[] = {info.tid, to_ns(info.time), to_ns(info.clock_error),
                                   static_cast<std::int64_t>(info.payload_bytes)};
    static_assert(sizeof header == ValueType::kRowHeaderBytes);
    std::memcpy(data_ + size_++ * row_bytes_, header, sizeof header);
  }

  // The rows that were added, as a numpy.recarray.
  py::object result() const {
    const py::object rows = array_[py::slice(0, static_cast<py::ssize_t>(size_), 1)];
    return rows.attr("view")(py::module_::import("numpy").attr("recarray"));
  }

 private:
  py::object array_;
  std::byte* data_;
  std::size_t row_bytes_, size_ = 0;
};

// --- calls that are made for each sample

// Methods by Python's C interface, whose calls take 0.2 us less than those of pybind11.
template <class Reader>
class FastReads {
 public:
  static void define(py::class_<Reader, std::shared_ptr<Reader>>& type) {
    for (PyMethodDef& method : methods) {
      const auto descriptor = py::reinterpret_steal<py::object>(
          PyDescr_NewMethod(reinterpret_cast<PyTypeObject*>(type.ptr()), &method));
      if (!descriptor) throw py::error_already_set();
      type.attr(method.ml_name) = descriptor;
    }
  }

 private:
  // What pybind11's cast finds, without a search for the type: a method gets only objects of it.
  static Reader& reader_of(PyObject* self) {
    const auto* const object = reinterpret_cast<const py::detail::instance*>(self);
    void* const value = object->simple_layout ? object->simple_value_holder[0] : nullptr;
    return value ? *static_cast<Reader*>(value) : py::handle(self).cast<Reader&>();
  }

  // The result of `call`, or a null pointer with its exception set.
  template <class Call>
  static PyObject* guarded(Call call) noexcept {
    try {
      return call().release().ptr();
    } catch (py::error_already_set& error) {
      error.restore();
    } catch (const py::builtin_exception& error) {
      error.set_error();
    } catch (const std::bad_alloc&) {
      PyErr_NoMemory();
    } catch (const std::exception& error) {
      PyErr_SetString(PyExc_RuntimeError, error.what());
    }
    return nullptr;
  }

  // The arguments of a call, by position or by these names; a null pointer where one is missing.
  template <std::size_t N>
  static std::array<PyObject*, N> arguments(const char* function,
                                            const std::array<const char*, N>& names,
                                            std::size_t required, PyObject* const* given,
                                            Py_ssize_t count, PyObject* keywords) {
    std::array<PyObject*, N> found{};
    const auto fail = [&](const std::string& text) -> void {
      throw py::type_error(std::string(function) + "() " + text);
    };
    if (count > static_cast<Py_ssize_t>(N))
      fail("takes at most " + std::to_string(N) + " arguments");
    std::copy_n(given, count, found.begin());
    const Py_ssize_t named = keywords ? PyTuple_GET_SIZE(keywords) : 0;
    for (Py_ssize_t i = 0; i < named; ++i) {
      PyObject* const keyword = PyTuple_GET_ITEM(keywords, i);
      const auto name = std::ranges::find_if(names, [&](const char* each) {
        return PyUnicode_CompareWithASCIIString(keyword, each) == 0;
      });
      if (name == names.end() || found[static_cast<std::size_t>(name - names.begin())]) {
        fail("has no argument '" + py::handle(keyword).cast<std::string>() + "', or got it twice");
      }
      found[static_cast<std::size_t>(name - names.begin())] = given[count + i];
    }
    for (std::size_t i = 0; i < required; ++i) {
      if (!found[i]) fail(std::string("needs '") + names[i] + "'");
    }
    return found;
  }

  static PyObject* newest(PyObject* self, PyObject*) {
    return guarded([&] { return reader_of(self).reads.newest(); });
  }
  static PyObject* tid(PyObject* self, PyObject* tid) {
    return guarded([&] {
      if (!PyIndex_Check(tid)) throw py::type_error("tid() takes a whole number");
      return reader_of(self).reads.tid(py::handle(tid).cast<Tid>());
    });
  }
  static PyObject* at(PyObject* self, PyObject* const* given, Py_ssize_t count,
                      PyObject* keywords) {
    return guarded([&] {
      const auto [time, age, wait] =
          arguments<3>("at", {"time", "max_age", "wait"}, 1, given, count, keywords);
      return reader_of(self).reads.at(time, age ? age : Py_None, wait ? wait : Py_False);
    });
  }
  static PyObject* next(PyObject* self, PyObject* const* given, Py_ssize_t count,
                        PyObject* keywords) {
    return guarded([&] {
      const auto [wait] = arguments<1>("next", {"wait"}, 0, given, count, keywords);
      return reader_of(self).reads.next(wait ? wait : Py_False);
    });
  }

  static PyCFunction function(PyObject* (*call)(PyObject*, PyObject* const*, Py_ssize_t,
                                                PyObject*)) {
    return reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(call));
  }

  static inline PyMethodDef methods[] = {
      {"newest", &newest, METH_NOARGS,
       "newest($self)\n--\n\nThe newest sample; None while nothing is written."},
      {"tid", &tid, METH_O,
       "tid($self, tid, /)\n--\n\nSample number `tid`; None if it is not written yet. Raises "
       "TooOld, Lost, "
       "Arriving, Restarted."},
      {"at", function(&at), METH_FASTCALL | METH_KEYWORDS,
       "at($self, time, max_age=None, wait=False)\n--\n\n"
       "The newest sample that is not later than `time`, and at that time not older than "
       "`max_age`.\n\n"
       "None while nothing is written. Raises TooOld (all are later), Stale, ClockOutOfBounds, "
       "Arriving. "
       "Keeps the cursor.\n\n"
       "wait: for a sample that is on its way from another host, True waits without a limit, a "
       "duration at most so long; then Arriving is raised."},
      {"next", function(&next), METH_FASTCALL | METH_KEYWORDS,
       "next($self, wait=False)\n--\n\n"
       "The sample after the cursor; None if there is none yet. A new reader of a live stream "
       "begins with "
       "the newest one, one of a recording with the first.\n\n"
       "wait: of a live stream, True waits for it without a limit, a duration at most so long."},
  };
};

// Defines what Reads has; `Reader` has a member `reads`.
template <class Reader>
void define_reads(py::class_<Reader, std::shared_ptr<Reader>>& type) {
  FastReads<Reader>::define(type);
  const auto name = type.attr("__name__").template cast<std::string>();
  type.def(
          "previous", [](Reader& r) { return r.reads.previous(); },
          "The sample before the cursor; None if nothing was read before. Raises TooOld.")
      .def(
          "info", [](Reader& r, Tid tid) { return r.reads.info(tid); }, py::arg("tid"),
          "The SampleInfo of sample `tid`; keeps the cursor. Raises as tid().")
      .def(
          "at_or_after", [](Reader& r, py::handle time) { return r.reads.at_or_after(time); },
          py::arg("time"),
          "The first sample from which on all samples have at least that time; None if there is "
          "none "
          "yet. Keeps the cursor.")
      .def(
          "nearest", [](Reader& r, py::handle time) { return r.reads.nearest(time); },
          py::arg("time"),
          "The sample that is closest to `time`; None while nothing is written. Keeps the cursor.")
      .def(
          "neighbours", [](Reader& r, py::handle time) { return r.reads.neighbours(time); },
          py::arg("time"),
          "The samples before and after `time`, for interpolation; None if there is none after it "
          "yet. Raises TooOld. Keeps the cursor.")
      .def(
          "find", [](Reader& r, py::handle time) { return r.reads.find(time); }, py::arg("time"),
          "The SampleInfo of the sample that at(time) returns.")
      .def(
          "seek", [](Reader& r, Tid tid) { r.reads.seek(tid); }, py::arg("tid"),
          "Sets the cursor: next() returns the sample after `tid`; NO_TID: from the oldest one on.")
      .def(
          "clock_error_ns",
          [](Reader& r, const SampleInfo& info) { return to_ns(r.reads.raw().clock_error(info)); },
          py::arg("info"),
          "Bound on the distance of a sample's time from the reading PC's clock [ns]; "
          "UNKNOWN_CLOCK_ERROR.")
      .def(
          "close", [](Reader& r) { r.reads.close(); }, "Closes it; other calls then raise Closed.")
      .def("__repr__",
           [name](const Reader& r) {
             if (r.reads.is_closed()) return "<dssm." + name + " closed>";
             return repr_of(name, *r.reads.shared_raw());
           })
      .def("__enter__", [](py::object self) { return self; })
      .def("__exit__", [](Reader& r, const py::args&) { r.reads.close(); })
      .def_property_readonly(
          "closed", [](const Reader& r) { return r.reads.is_closed(); }, "Whether it is closed.")
      .def_property_readonly(
          "cursor", [](const Reader& r) { return r.reads.raw().cursor(); },
          "The tid of the last sample read by tid or in order; NO_TID.")
      .def_property_readonly(
          "newest_tid", [](const Reader& r) { return r.reads.raw().newest_tid(); },
          "The tid of the newest sample; NO_TID while nothing is written.")
      .def_property_readonly(
          "oldest_tid", [](const Reader& r) { return r.reads.raw().oldest_tid(); },
          "The tid of the oldest sample that can be read; NO_TID.")
      .def_property_readonly(
          "lost_samples", [](const Reader& r) { return r.reads.raw().lost_samples(); },
          "Samples that next() skipped because they were no longer there.")
      .def_property_readonly(
          "restarts", [](const Reader& r) { return r.reads.raw().restarts(); },
          "How often the stream got a new ring, whose tids begin at 0 again.")
      .def_property_readonly(
          "name", [](const Reader& r) { return r.reads.raw().id().str(); },
          "The stream: 'lidar:0@pc1'.")
      .def_property_readonly(
          "type", [](const Reader& r) { return r.reads.raw().type(); }, "The stream's description.")
      .def_property_readonly(
          "dtype", [](const Reader& r) { return r.reads.values().dtype(); },
          "The numpy.dtype of values.")
      .def_property_readonly(
          "payload_bytes", [](const Reader& r) { return r.reads.raw().payload_bytes(); },
          "Of a sample, at most.")
      .def_property_readonly(
          "depth", [](const Reader& r) { return r.reads.raw().depth(); },
          "The slots of the ring, which holds one sample less.")
      .def_property_readonly(
          "cycle", [](const Reader& r) { return to_seconds(r.reads.raw().cycle()); },
          "The expected time between two samples [s].")
      .def(
          "property",
          [](const Reader& r) -> py::object {
            Use::check(r.reads.in_use());
            const auto& raw = r.reads.raw();
            Result<std::vector<std::byte>> property = [&] {
              const Use use(r.reads.in_use());
              return without_gil([&] { return raw.property(); });
            }();
            if (!property && property.error().code == Errc::not_found) return py::none();
            const std::vector<std::byte> bytes = python::value_of(std::move(property));
            return py::bytes(reinterpret_cast<const char*>(bytes.data()), bytes.size());
          },
          "The stream's property as bytes; None if it has none.");
}

}  // namespace dssm::python
