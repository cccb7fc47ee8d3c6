// SPDX-License-Identifier: Apache-2.0
//
// Failures: a code for programs (Errc) and a sentence for people (Error). docs/errors.md describes
// when each code is used.
//
//   threads  any
#pragma once

#include <string>
#include <string_view>
#include <utility>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

enum class Errc {
  invalid_argument,     // the caller's input is wrong: a name, a size, a duration, a setting
  not_found,            // no such stream, or no property
  type_mismatch,        // the stream has another payload size, alignment or type
  limit_exceeded,       // a configured limit of dssmd, or one of the format
  no_memory,            // the PC has no memory for it
  no_permission,        // the operating system or dssmd refuses this user
  no_daemon,            // nothing listens at the socket or address
  unavailable,          // dssmd does not answer or disconnected; this process keeps reconnecting
  protocol,             // the other side has another protocol version, or sent invalid data
  conflict,             // two things have one name, e.g. a second dssmd in one folder
  clock_out_of_bounds,  // two hosts' clocks may be further apart than is allowed
  closed,               // the object was closed by this process
  system,               // the operating system failed; the message quotes it
};

// The code's name as in docs/errors.md, e.g. "not_found". Static storage.
std::string_view name_of(Errc code) noexcept;

// Whether the same request may succeed later, when something outside this process changes: the
// stream is created, dssmd answers again, memory is freed. The table in docs/errors.md lists it.
bool is_retryable(Errc code) noexcept;

// A value; copy and move freely.
struct Error {
  Errc code = Errc::system;
  std::string message;  // what was tried, on what, why it failed, what to do; no trailing newline

  // Puts "`what`: " before the message: what was tried comes first.
  [[nodiscard]] Error context(std::string_view what) && {
    message.insert(0, std::string(what) + ": ");
    return std::move(*this);
  }
};

// An Error from `errno_value` (default: errno): "`what`: No such file or directory".
// EACCES and EPERM become no_permission, ENOMEM and ENOSPC no_memory, all others system.
Error os_error(std::string_view what);
Error os_error(std::string_view what, int errno_value);

}  // namespace dssm
#pragma GCC visibility pop
