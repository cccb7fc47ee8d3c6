// SPDX-License-Identifier: Apache-2.0
//
// What all parts of the Python module share: errors as exceptions, times and durations, and calls
// without the interpreter's lock (GIL).
//
//   errors   pybind11 turns C++ exceptions into Python's, so this folder throws: each function here
//            may throw py::error_already_set with the Python exception that it names
//   threads  all functions need the GIL; only what runs inside without_gil() does not have it
#pragma once

#include <cxxabi.h>
#include <pybind11/pybind11.h>
#include <unistd.h>

#include <algorithm>
#include <dssm/error.hpp>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <string>
#include <string_view>
#include <utility>

namespace dssm::python {

namespace py = pybind11;

// Raises the exception of dssm._errors for a code's name, such as "not_found".
[[noreturn]] void raise(std::string_view code, const std::string& message);
[[noreturn]] inline void raise(const Error& error) { raise(name_of(error.code), error.message); }

template <class T>
T value_of(Result<T> result) {
  if (!result) raise(result.error());
  if constexpr (!std::is_void_v<T>) return *std::move(result);
}

// While it exists, this thread does not have the GIL.
//
// At the end of the process Python ends a thread that asks for the GIL, by pthread_exit(). With
// pybind11's class of that purpose this ends the process with an error; here the thread sleeps
// until the process has ended, as in later versions of Python.
class GilRelease {
 public:
  GilRelease() : state_(PyEval_SaveThread()) {}
  GilRelease(const GilRelease&) = delete;
  GilRelease& operator=(const GilRelease&) = delete;
  ~GilRelease() {
    try {
      PyEval_RestoreThread(state_);
    } catch (const abi::__forced_unwind&) {
      for (;;) ::pause();
    }
  }

 private:
  PyThreadState* state_;
};

// Calls `call` without the GIL.
template <class Call>
auto without_gil(Call call) -> decltype(call()) {
  const GilRelease released;
  return call();
}
// The same for a function that returns a Result: its value, or an exception.
template <class Call>
auto value_without_gil(Call call) {
  return value_of(without_gil(std::move(call)));
}

// How long a wait runs at most before Python's signal handlers do: Ctrl-C may arrive in another
// thread, or between two waits, and then interrupts neither.
inline constexpr Duration kMaxWaitSlice = std::chrono::milliseconds(100);

// Calls `wait(end)`, which returns a WaitStatus, without the GIL until it is ready or the deadline
// has passed. Between two calls signal handlers run, whose exceptions (KeyboardInterrupt) leave.
//   returns  whether it is ready
template <class Wait>
bool wait_in_slices(MonoTime deadline, Wait wait) {
  for (;;) {
    const MonoTime end = std::min(deadline, deadline_in(kMaxWaitSlice));
    if (without_gil([&] { return wait(end); }) == WaitStatus::ready) return true;
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
    if (MonoClock::now() >= deadline) return false;
  }
}

// --- arguments

// A time: an int of ns since 1970, or a numpy.datetime64.
//   raises  TypeError (also for a float, which cannot hold ns), ValueError
Time to_time(py::handle time);

// A duration: seconds as an int or float, a datetime.timedelta, or a numpy.timedelta64.
//   raises  TypeError, ValueError (negative, or not a number)
Duration to_duration(py::handle duration);
// The same; `none` for None.
Duration to_duration(py::handle duration, Duration none);

// When a wait of that duration ends; None: never.
inline MonoTime to_deadline(py::handle timeout) {
  return timeout.is_none() ? kNever : deadline_in(to_duration(timeout));
}
// For arguments named `wait`: False does not wait, True waits without a limit, else a duration.
MonoTime wait_deadline(py::handle wait);

// An int of ns [>= 0].
Duration to_clock_error(py::handle ns);

StreamId to_stream_id(std::string_view text);

inline double to_seconds(Duration duration) {
  return std::chrono::duration<double>(duration).count();
}

// --- objects that are used by one thread at a time

// Marks an object as in use while a call on it runs without the GIL. Another thread that uses the
// object meanwhile gets dssm.InUse. The GIL guards the flag.
class Use {
 public:
  explicit Use(bool& in_use) : in_use_(in_use) {
    check(in_use);
    in_use = true;
  }
  Use(const Use&) = delete;
  Use& operator=(const Use&) = delete;
  ~Use() { in_use_ = false; }

  static void check(bool in_use) {
    if (in_use) raise_in_use();
  }

 private:
  [[noreturn]] static void raise_in_use();
  bool& in_use_;
};

// --- parts of the module, in the order in which they are defined

void define_values(py::module_& module);
void define_readers(py::module_& module);
void define_writers(py::module_& module);
void define_sessions(py::module_& module);
void define_recordings(py::module_& module);

}  // namespace dssm::python
