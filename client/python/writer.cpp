// SPDX-License-Identifier: Apache-2.0
#include "client/python/writer.hpp"

#include <cstring>
#include <vector>

namespace dssm::python {
namespace {

Tid write_sample(Writer& writer, py::handle value, py::handle time, py::handle clock_error_ns) {
  RawWriter& raw = writer.checked();
  py::object keeper;
  const std::span<const std::byte> payload = writer.values.payload_of(value, keeper);
  const Duration clock_error =
      clock_error_ns.is_none() ? kOwnClockError : to_clock_error(clock_error_ns);
  const Time t = time.is_none() ? WallClock::now() : to_time(time);
  const Use use(writer.in_use);
  const Tid tid = without_gil([&] { return raw.write(payload, t, clock_error); });
  if (tid == kNoTid) {
    raise("unavailable",
          "write to '" + raw.id().str() +
              "': another program has held the stream's lock for 2 s: it is stopped, or "
              "keeps a sample that it fills");
  }
  return tid;
}

}  // namespace

void define_writers(py::module_& module) {
  py::class_<Writer>(
      module, "Writer",
      "Writes a stream. For one thread at a time. Session.create() and Session.writer() "
      "make it.")
      .def("write", &write_sample, py::arg("value"), py::arg("time") = py::none(), py::kw_only(),
           py::arg("clock_error_ns") = py::none(),
           "Writes one sample and returns its tid.\n\n"
           "value: what reads return, a dict, a tuple, a dataclass, or what numpy makes the "
           "stream's "
           "dtype of; bytes for a stream without a description.\n"
           "time: when it was measured; None: now.\n"
           "clock_error_ns: bound on the error of `time`; None: it is of this PC's clock; "
           "FOREIGN_CLOCK: of another one.")
      .def(
          "set_property",
          [](Writer& w, const py::bytes& property) {
            RawWriter& raw = w.checked();
            const std::string_view text = property;
            const Use use(w.in_use);
            value_without_gil([&] {
              return raw.set_property(
                  std::as_bytes(std::span<const char>(text.data(), text.size())));
            });
          },
          py::arg("property"), "Replaces the stream's property; b'' removes it.")
      .def(
          "close",
          [](Writer& w) {
            Use::check(w.in_use);
            w.raw.reset();
          },
          "Closes it; other calls then raise Closed. The stream remains.")
      .def("__repr__",
           [](const Writer& w) {
             return w.raw ? repr_of("Writer", *w.raw) : std::string("<dssm.Writer closed>");
           })
      .def("__enter__", [](py::object self) { return self; })
      .def("__exit__",
           [](Writer& w, const py::args&) {
             Use::check(w.in_use);
             w.raw.reset();
           })
      .def_property_readonly(
          "closed", [](const Writer& w) { return !w.raw; }, "Whether it is closed.")
      .def_property_readonly(
          "newest_tid", [](Writer& w) { return w.checked().newest_tid(); },
          "The tid of the newest sample of any writer; NO_TID.")
      .def_property_readonly(
          "name", [](Writer& w) { return w.checked().id().str(); }, "The stream: 'lidar:0@pc1'.")
      .def_property_readonly(
          "type", [](Writer& w) { return w.checked().type(); }, "The stream's description.")
      .def_property_readonly(
          "dtype", [](const Writer& w) { return w.values.dtype(); }, "The numpy.dtype of values.")
      .def_property_readonly(
          "payload_bytes", [](Writer& w) { return w.checked().payload_bytes(); },
          "Of a sample, at most.")
      .def_property_readonly(
          "depth", [](Writer& w) { return w.checked().depth(); },
          "The slots of the ring, which holds one sample less.")
      .def_property_readonly(
          "cycle", [](Writer& w) { return to_seconds(w.checked().cycle()); },
          "The expected time between two samples [s].");
}

}  // namespace dssm::python
