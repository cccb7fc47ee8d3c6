// SPDX-License-Identifier: Apache-2.0
//
// Readers of live streams: waiting, history, and samples in place (borrow()).
//
// A view of the ring is an array whose base is a capsule with a Lease, which keeps the reader and
// so the mapping. The C++ reader unmaps a ring when the stream restarts for the second time after
// borrow(); reads that could do so are refused while such an array exists (Reads::check_leases()).
#include "client/python/reader.hpp"

#include <pybind11/stl.h>

namespace dssm::python {
namespace {

// Keeps a reader, and notes in it that a view of its ring exists.
struct Lease {
  std::shared_ptr<Reader> reader;
  std::shared_ptr<RawReader> raw;  // also after reader->reads.close()
  std::multiset<std::uint64_t>::iterator entry;
};

py::object make_lease(const std::shared_ptr<Reader>& reader) {
  Reads<RawReader>& reads = reader->reads;
  auto lease = std::make_unique<Lease>(
      Lease{reader, reads.shared_raw(), reads.leases().insert(reads.raw().restarts())});
  py::capsule capsule(lease.get(), [](void* data) {
    const std::unique_ptr<Lease> ended(static_cast<Lease*>(data));
    ended->reader->reads.leases().erase(ended->entry);
  });
  (void)lease.release();
  return capsule;
}

// A sample in its slot, while a `with` block runs.
class Borrowed {
 public:
  Borrowed(const std::shared_ptr<Reader>& reader, const BorrowedSample& sample)
      : name_(reader->reads.raw().id().str()),
        values_(reader->reads.values()),
        payload_bytes_(reader->reads.raw().payload_bytes()),
        sample_(sample),
        lease_(make_lease(reader)) {}

  const SampleInfo& info() const { return sample().info(); }

  py::object value() {
    if (info().payload_bytes < payload_bytes_) {
      if (values_.is_bytes()) return payload();
      raise("too_short", "sample " + std::to_string(info().tid) + " of '" + name_ + "' has " +
                             std::to_string(info().payload_bytes) + " of " +
                             std::to_string(payload_bytes_) +
                             " bytes: use payload, or a read that copies");
    }
    if (!value_) value_ = values_.view(sample().payload(), lease_);
    return value_;
  }
  py::object payload() const { return ValueType::bytes_view(sample().payload(), lease_); }
  bool still_valid() const { return sample().still_valid(); }

  // Ends the loan. Raises Overwritten, also in place of an exception that torn data may have
  // caused.
  void exit(py::handle exception) {
    const bool is_valid = still_valid();
    const Tid tid = info().tid;
    lease_ = py::object();
    value_ = py::object();
    const bool replaces =
        exception.is_none() || py::isinstance(exception, py::handle(PyExc_Exception));
    if (is_valid || !replaces) return;
    raise("overwritten",
          "sample " + std::to_string(tid) + " of '" + name_ +
              "' was overwritten while it was borrowed: what was computed with it is void. "
              "Copy it, or give the stream more history");
  }

 private:
  const BorrowedSample& sample() const {
    if (!lease_)
      raise("closed", "the sample is no longer borrowed: use it inside of the with block");
    return sample_;
  }
  std::string name_;
  ValueType values_;
  std::uint64_t payload_bytes_;
  BorrowedSample sample_;
  py::object lease_, value_;
};

Borrowed borrow(const std::shared_ptr<Reader>& reader, std::optional<Tid> tid) {
  Reads<RawReader>& reads = reader->reads;
  reads.check_leases();
  RawReader& raw = reads.raw();
  BorrowedSample sample;
  ReadStatus status;
  do {  // without a tid the newest one, which a writer may have overwritten since newest_tid()
    status = raw.borrow(tid ? *tid : std::max<Tid>(raw.newest_tid(), 0), sample);
    if (status == ReadStatus::restarted) reads.is_new() = false, reads.check_leases();
  } while (!tid && (status == ReadStatus::too_old || status == ReadStatus::restarted));
  if (status != ReadStatus::ok) {
    raise(status, raw.id(), tid ? "sample " + std::to_string(*tid) : "the newest sample");
  }
  reads.is_new() = false;
  return {reader, sample};
}

// The samples from the first one from which on all have time >= t0 up to the first one with
// time >= t1, copied once.
py::object history(Reader& reader, py::handle from, py::handle to, py::handle wait) {
  const Time t0 = to_time(from), t1 = to_time(to);
  const MonoTime arriving_until = wait_deadline(wait);
  Reads<RawReader>& reads = reader.reads;
  const py::object scratch = reads.values().new_array();
  const auto text = [&](Time t) { return "the history, " + Reads<RawReader>::text_of(t); };
  while (t0 < t1) {
    reads.check_leases();
    RawReader& raw = reads.raw();  // another thread may have closed it during a pause
    SampleInfo first, last;
    ReadStatus status = raw.read_at_or_after(t0, ValueType::bytes_of(scratch), first);
    if (status == ReadStatus::restarted) {
      reads.is_new() = false;
      continue;
    }
    if (status == ReadStatus::not_yet) break;
    if (status == ReadStatus::arriving && reads.pause_while_arriving(arriving_until)) continue;
    if (status != ReadStatus::ok) raise(status, raw.id(), text(t0));
    status = raw.find(t1 - Duration(1), last);
    if (status == ReadStatus::not_yet || status == ReadStatus::too_old) break;
    if (status == ReadStatus::arriving && reads.pause_while_arriving(arriving_until)) continue;
    if (status != ReadStatus::ok) raise(status, raw.id(), text(t1));
    if (last.tid < first.tid) break;

    Rows rows(reads.values(), static_cast<std::size_t>(last.tid - first.tid + 1));
    Tid tid = first.tid;
    {
      const Use use(reads.in_use());
      status = without_gil([&] {
        const Tid cursor = raw.cursor();
        ReadStatus read = ReadStatus::ok;
        for (; tid <= last.tid; ++tid) {
          SampleInfo info;
          read = raw.read_tid(tid, rows.payload(), info);
          if (read == ReadStatus::restarted || read == ReadStatus::arriving) break;
          if (read != ReadStatus::ok) continue;  // lost, or overwritten since find()
          if (info.time >= t1) break;
          rows.add(info);
        }
        if (read != ReadStatus::restarted) raw.seek(cursor);
        return read;
      });
    }
    if (status == ReadStatus::arriving) {
      const Use use(reads.in_use());
      const bool is_here = wait_in_slices(
          arriving_until, [&](MonoTime end) { return raw.wait_for_sample(tid, end); });
      if (!is_here) raise(status, raw.id(), text(t1));
      continue;
    }
    if (status != ReadStatus::restarted) return rows.result();
    reads.is_new() = false;
  }
  return Rows(reads.values(), 0).result();
}

int fileno(Reader& reader) {
  RawReader& raw = reader.reads.raw();
  return value_of(raw.ready_fd());
}

// What `readers` is a list of, each marked as in use until the result is destroyed.
struct InUse {
  std::vector<std::shared_ptr<Reader>> readers;
  std::vector<std::unique_ptr<Use>> uses;
  std::vector<RawReader*> raws;
};
InUse use_all(const std::vector<std::shared_ptr<Reader>>& readers) {
  InUse all;
  for (const auto& reader : readers) {
    all.raws.push_back(&reader->reads.raw());
    all.uses.push_back(std::make_unique<Use>(reader->reads.in_use()));
  }
  all.readers = readers;
  return all;
}

bool wait_any(const std::vector<std::shared_ptr<Reader>>& readers, py::handle timeout) {
  if (readers.empty() || readers.size() > kMaxWaitAny) {
    throw py::value_error("wait_any() takes 1 to " + std::to_string(kMaxWaitAny) + " readers");
  }
  const MonoTime deadline = to_deadline(timeout);
  InUse all = use_all(readers);
  return wait_in_slices(deadline, [&](MonoTime end) { return dssm::wait_any(all.raws, end); });
}

}  // namespace

void raise(ReadStatus status, const StreamId& id, const std::string& what) {
  const char* reason = "";
  switch (status) {
    case ReadStatus::ok:
      break;
    case ReadStatus::not_yet:
      reason = "it is not written yet";
      break;
    case ReadStatus::too_old:
      reason = "it is older than all samples that the stream still has";
      break;
    case ReadStatus::lapped:
      reason = "the writer overtook each of 1,000 attempts: give the stream more history";
      break;
    case ReadStatus::restarted:
      reason = "the stream has a new ring, whose tids begin at 0 again";
      break;
    case ReadStatus::clock_out_of_bounds:
      reason =
          "the clocks of this PC and of the stream's host may differ by more than dssmd's key "
          "clock_limit allows; `dssmctl hosts` shows them";
      break;
    case ReadStatus::arriving:
      reason =
          "it is on its way from the stream's host: read it again a little later, or with wait=";
      break;
    case ReadStatus::lost:
      reason = "it is lost: the network could not carry it, or it was not recorded";
      break;
    case ReadStatus::stale:
      reason = "the sample of that time is older than max_age";
      break;
  }
  raise(name_of(status), "read " + what + " of '" + id.str() + "': " + reason);
}

void define_readers(py::module_& module) {
  py::class_<Borrowed>(module, "Borrowed",
                       "A sample in its slot, without a copy; for a `with` block.")
      .def_property_readonly(
          "value", &Borrowed::value,
          "Its value, read-only, in the memory of the ring. A writer may overwrite "
          "it at any moment: then the end of the block raises Overwritten.")
      .def_property_readonly("payload", &Borrowed::payload, "Its bytes, as a read-only array.")
      .def_property_readonly("info", &Borrowed::info, "Its SampleInfo.")
      .def_property_readonly(
          "tid", [](const Borrowed& b) { return b.info().tid; }, "Its tid.")
      .def_property_readonly(
          "time_ns", [](const Borrowed& b) { return to_ns(b.info().time); },
          "When it was measured: ns since 1970.")
      .def("still_valid", &Borrowed::still_valid, "Whether it was not overwritten until now.")
      .def("__enter__", [](py::object self) { return self; })
      .def("__exit__",
           [](Borrowed& b, py::handle, py::handle exception, py::handle) { b.exit(exception); });

  py::class_<Reader, std::shared_ptr<Reader>> type(
      module, "Reader",
      "Reads a stream. It has a cursor for next() and previous(); reads by time leave it.\n\n"
      "For one thread at a time. Session.reader() makes it.");
  define_reads(type);
  type.def("history", &history, py::arg("t0"), py::arg("t1"), py::kw_only(),
           py::arg("wait") = false,
           "The samples with t0 <= time < t1 that the ring still has, as one numpy.recarray with "
           "the "
           "fields tid, time_ns, clock_error_ns, payload_bytes and value. Keeps the cursor.\n\n"
           "If times run backwards: from the first sample from which on all are at least t0, up to "
           "the "
           "first one that is at least t1.\n\n"
           "wait: for samples that are on their way from another host, True waits without a limit, "
           "a duration at most so long; then Arriving is raised.")
      .def("borrow", &borrow, py::arg("tid") = py::none(),
           "Sample `tid`, or the newest one, without a copy: `with reader.borrow() as sample:`.\n\n"
           "The end of the block raises Overwritten if a writer has overwritten it. Raises NotYet, "
           "TooOld, Lost, Arriving, Restarted.")
      .def(
          "wait", [](Reader& r, py::handle timeout) { return r.reads.wait(to_deadline(timeout)); },
          py::arg("timeout") = py::none(),
          "Waits until there is a sample after the cursor; whether there is one.")
      .def(
          "wait_for_tid",
          [](Reader& r, Tid tid, py::handle timeout) {
            RawReader& raw = r.reads.raw();
            const MonoTime deadline = to_deadline(timeout);
            const Use use(r.reads.in_use());
            return wait_in_slices(deadline,
                                  [&](MonoTime end) { return raw.wait_for_tid(tid, end); });
          },
          py::arg("tid"), py::arg("timeout") = py::none(),
          "Waits until newest_tid is at least `tid`; whether it is.")
      .def(
          "wait_for_sample",
          [](Reader& r, Tid tid, py::handle timeout) {
            RawReader& raw = r.reads.raw();
            const MonoTime deadline = to_deadline(timeout);
            const Use use(r.reads.in_use());
            return wait_in_slices(deadline,
                                  [&](MonoTime end) { return raw.wait_for_sample(tid, end); });
          },
          py::arg("tid"), py::arg("timeout") = py::none(),
          "Waits until sample `tid` is here or never will be, so that tid() does not raise "
          "Arriving; whether it is so.")
      .def("fileno", &fileno,
           "A descriptor for select and asyncio: readable when there may be samples newer than at "
           "the "
           "last clear_ready(). The reader owns it.")
      .def(
          "clear_ready", [](Reader& r) { r.reads.raw().clear_ready(); },
          "After the descriptor was readable, before next() until that returns None.")
      .def(
          "in_bounds",
          [](Reader& r, const SampleInfo& info) { return r.reads.raw().clock_in_bounds(info); },
          py::arg("info"), "Whether reads by time accept the sample: see ClockOutOfBounds.")
      .def_property_readonly(
          "restart_error",
          [](const Reader& r) -> std::optional<std::string> {
            const auto error = r.reads.raw().restart_error();
            return error ? std::optional(error->message) : std::nullopt;
          },
          "Why it cannot continue with the stream's new ring; None if it can.")
      .def("__iter__", [](py::object self) { return self; })
      .def("__next__", [](Reader& r) {
        for (;;) {
          if (py::object sample = r.reads.next(py::cast(true)); !sample.is_none()) return sample;
        }
      });

  module.def("wait_any", &wait_any, py::arg("readers"), py::arg("timeout") = py::none(),
             "Waits until one of the readers has a sample after its cursor; whether one has.");
  module.def("_read_joint", [](py::handle time, const std::vector<std::shared_ptr<Reader>>& readers,
                               py::handle max_error, py::handle max_age, py::handle wait) {
    return read_joint<JointSample>(time, readers, max_error, max_age, wait);
  });
}

}  // namespace dssm::python
