// SPDX-License-Identifier: Apache-2.0
//
// The Python module dssm._dssm, which the package `dssm` consists of. It uses only the public
// headers. dssm/_dssm.pyi has the types of all that is defined here; a test compares both.
#include <pybind11/pybind11.h>

#include <cmath>
#include <dssm/clock.hpp>
#include <limits>

#include "client/python/python.hpp"

namespace dssm::python {
namespace {

// `value` as a number of ns, if it is an integer or has a method `astype`, as numpy's times do.
std::int64_t as_int64(py::handle value, const char* what) {
  const std::int64_t ns = PyLong_AsLongLong(value.ptr());
  if (ns == -1 && PyErr_Occurred()) {
    PyErr_Clear();
    throw py::value_error(std::string(what) + " does not fit into 64 bits of nanoseconds");
  }
  return ns;
}

[[noreturn]] void raise_type(const std::string& text, py::handle value) {
  throw py::type_error(text + ", not " +
                       std::string(py::str(py::type::handle_of(value).attr("__name__"))));
}

// A numpy.datetime64 or timedelta64, as ns. numpy converts one that does not fit to a wrong one.
std::int64_t numpy_ns(py::handle value, const char* name, const char* unit) {
  const py::object ns = value.attr("astype")(unit);
  if (!ns.attr("astype")(value.attr("dtype")).equal(value) &&
      !py::module_::import("numpy").attr("isnat")(value).cast<bool>()) {
    throw py::value_error(std::string(name) +
                          " does not fit into 64 bits of nanoseconds, or is finer than these");
  }
  if (py::module_::import("numpy").attr("isnat")(ns).cast<bool>()) {
    throw py::value_error(std::string(name) + " is NaT (not a time)");
  }
  return ns.attr("astype")("int64").cast<std::int64_t>();
}

bool is_numpy(py::handle value, const char* type) {
  return py::isinstance(value, py::module_::import("numpy").attr(type));
}

struct ClockReading {
  clock::Reading reading;
};

}  // namespace

void raise(std::string_view code, const std::string& message) {
  const py::object errors = py::module_::import("dssm._errors");
  const py::object type = errors.attr("by_code")(py::str(std::string(code)));
  PyErr_SetObject(type.ptr(), py::str(message).ptr());
  throw py::error_already_set();
}

void Use::raise_in_use() {
  raise("in_use",
        "a call of another thread is using this object: give each thread a reader or writer of its "
        "own");
}

Time to_time(py::handle time) {
  if (PyLong_CheckExact(time.ptr())) return time_from_ns(as_int64(time, "the time"));
  if (PyBool_Check(time.ptr()) || PyFloat_Check(time.ptr())) {
    raise_type(
        "a time is an int of nanoseconds since 1970, as of time.time_ns(), or a numpy.datetime64",
        time);
  }
  if (PyIndex_Check(time.ptr())) {  // numpy's integers
    return time_from_ns(
        as_int64(py::reinterpret_steal<py::object>(PyNumber_Index(time.ptr())), "the time"));
  }
  if (is_numpy(time, "datetime64")) {
    return time_from_ns(numpy_ns(time, "the time", "datetime64[ns]"));
  }
  raise_type(
      "a time is an int of nanoseconds since 1970, as of time.time_ns(), or a numpy.datetime64",
      time);
}

Duration to_duration(py::handle duration) {
  double seconds = 0;
  if (PyFloat_Check(duration.ptr()) ||
      (PyIndex_Check(duration.ptr()) && !PyBool_Check(duration.ptr()))) {
    seconds = PyFloat_AsDouble(duration.ptr());
    if (PyErr_Occurred()) throw py::error_already_set();
  } else if (py::isinstance(duration, py::module_::import("datetime").attr("timedelta"))) {
    const auto microseconds =
        (duration / py::module_::import("datetime").attr("timedelta")(0, 0, 1));
    seconds = microseconds.cast<double>() / 1e6;
  } else if (is_numpy(duration, "timedelta64")) {
    seconds = static_cast<double>(numpy_ns(duration, "the duration", "timedelta64[ns]")) / 1e9;
  } else if (py::hasattr(duration, "__float__") && !PyBool_Check(duration.ptr())) {
    seconds = py::float_(py::reinterpret_borrow<py::object>(duration)).cast<double>();
  } else {
    raise_type("a duration is a number of seconds or a datetime.timedelta", duration);
  }
  if (std::isnan(seconds) || seconds < 0) {
    throw py::value_error("a duration is at least 0, not " + std::to_string(seconds) + " s");
  }
  constexpr double kMaxSeconds = 9e9;  // 285 years, which 64 bits of ns hold
  return seconds > kMaxSeconds ? Duration::max() : Duration(std::llround(seconds * 1e9));
}

Duration to_duration(py::handle duration, Duration none) {
  return duration.is_none() ? none : to_duration(duration);
}

MonoTime wait_deadline(py::handle wait) {
  if (wait.is(py::handle(Py_False))) return MonoTime::min();
  if (wait.is(py::handle(Py_True))) return kNever;
  return deadline_in(to_duration(wait));
}

Duration to_clock_error(py::handle ns) {
  if (PyFloat_Check(ns.ptr()) || PyBool_Check(ns.ptr()) || !PyIndex_Check(ns.ptr())) {
    raise_type("a clock error is an int of nanoseconds", ns);
  }
  const std::int64_t error =
      as_int64(py::reinterpret_steal<py::object>(PyNumber_Index(ns.ptr())), "the clock error");
  if (error < 0) throw py::value_error("a clock error is at least 0");
  return Duration(error);
}

StreamId to_stream_id(std::string_view text) { return value_of(StreamId::parse(text)); }

namespace {

void define_clock(py::module_& module) {
  py::class_<ClockReading>(module, "ClockReading",
                           "The time of this PC's clock, and how far it may be from the reference.")
      .def_property_readonly(
          "time_ns", [](const ClockReading& of) { return to_ns(of.reading.time); },
          "The time: ns since 1970.")
      .def_property_readonly(
          "clock_error_ns", [](const ClockReading& of) { return to_ns(of.reading.clock_error); },
          "Bound on the distance from the fleet's reference clock [ns]; "
          "UNKNOWN_CLOCK_ERROR when nothing is known.")
      .def_property_readonly(
          "status", [](const ClockReading& of) { return std::string(name_of(of.reading.status)); },
          "'synchronized', 'holdover', 'out of bounds' or 'unknown'.")
      .def("__repr__", [](const ClockReading& of) {
        return "ClockReading(time_ns=" + std::to_string(to_ns(of.reading.time)) + ", status='" +
               std::string(name_of(of.reading.status)) + "')";
      });
  module.def(
      "clock_now", [] { return ClockReading{clock::now()}; },
      "The time now, with its bound. The bound is known while this process has a Session.");
}

}  // namespace
}  // namespace dssm::python

PYBIND11_MODULE(_dssm, module) {
  using namespace dssm::python;
  module.doc() = "The parts of the package dssm that are written in C++; import dssm.";
  module.attr("__version__") = DSSM_VERSION;
  module.attr("NO_TID") = dssm::kNoTid;
  module.attr("UNKNOWN_CLOCK_ERROR") = dssm::to_ns(dssm::kUnknownClockError);
  module.attr("FOREIGN_CLOCK") = dssm::to_ns(dssm::kForeignClockError);
  define_clock(module);
  define_values(module);
  define_readers(module);
  define_writers(module);
  define_sessions(module);
  define_recordings(module);
}
