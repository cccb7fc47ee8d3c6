// SPDX-License-Identifier: Apache-2.0
//
// Names of the codes and enumerators, and which errors are retryable.
#include <array>
#include <cerrno>
#include <cstddef>
#include <dssm/clock_status.hpp>
#include <dssm/error.hpp>
#include <dssm/host_state.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <system_error>

namespace dssm {
namespace {

// Values may come from another process or PC.
template <class Enum, std::size_t n>
std::string_view name_in(const std::array<std::string_view, n>& names, Enum value) noexcept {
  const auto index = static_cast<std::size_t>(value);
  return index < n ? names[index] : "?";
}

}  // namespace

std::string_view name_of(Errc code) noexcept {
  switch (code) {
    case Errc::invalid_argument:
      return "invalid_argument";
    case Errc::not_found:
      return "not_found";
    case Errc::type_mismatch:
      return "type_mismatch";
    case Errc::limit_exceeded:
      return "limit_exceeded";
    case Errc::no_memory:
      return "no_memory";
    case Errc::no_permission:
      return "no_permission";
    case Errc::no_daemon:
      return "no_daemon";
    case Errc::unavailable:
      return "unavailable";
    case Errc::protocol:
      return "protocol";
    case Errc::conflict:
      return "conflict";
    case Errc::clock_out_of_bounds:
      return "clock_out_of_bounds";
    case Errc::closed:
      return "closed";
    case Errc::system:
      return "system";
  }
  return "system";
}

bool is_retryable(Errc code) noexcept {
  switch (code) {
    case Errc::not_found:
    case Errc::limit_exceeded:
    case Errc::no_memory:
    case Errc::no_daemon:
    case Errc::unavailable:
    case Errc::clock_out_of_bounds:
    case Errc::system:
      return true;
    case Errc::invalid_argument:
    case Errc::type_mismatch:
    case Errc::no_permission:
    case Errc::protocol:
    case Errc::conflict:
    case Errc::closed:
      return false;
  }
  return false;
}

std::string_view name_of(ReadStatus status) noexcept {
  switch (status) {
    case ReadStatus::ok:
      return "ok";
    case ReadStatus::not_yet:
      return "not_yet";
    case ReadStatus::too_old:
      return "too_old";
    case ReadStatus::arriving:
      return "arriving";
    case ReadStatus::lost:
      return "lost";
    case ReadStatus::lapped:
      return "lapped";
    case ReadStatus::restarted:
      return "restarted";
    case ReadStatus::clock_out_of_bounds:
      return "clock_out_of_bounds";
    case ReadStatus::stale:
      return "stale";
  }
  return "lapped";
}

Error os_error(std::string_view what) { return os_error(what, errno); }

Error os_error(std::string_view what, int errno_value) {
  Errc code = Errc::system;
  if (errno_value == EACCES || errno_value == EPERM) code = Errc::no_permission;
  if (errno_value == ENOMEM || errno_value == ENOSPC) code = Errc::no_memory;
  return Error{code, std::string(what) + ": " + std::generic_category().message(errno_value)};
}

std::string_view name_of(ClockStatus status) noexcept {
  static constexpr std::array<std::string_view, 4> kNames = {"unknown", "synchronized", "holdover",
                                                             "out of bounds"};
  return name_in(kNames, status);
}

std::string_view name_of(ClockReason reason) noexcept {
  static constexpr std::array<std::string_view, 6> kNames = {
      "none", "no chronyd", "chronyd is silent", "not synchronised", "stepped", "too far"};
  return name_in(kNames, reason);
}

std::string_view name_of(HostState state) noexcept {
  static constexpr std::array<std::string_view, 7> kNames = {
      "unknown", "self", "up", "connecting", "down", "refused", "closed"};
  return name_in(kNames, state);
}

std::string_view name_of(HostReason reason) noexcept {
  static constexpr std::array<std::string_view, 12> kNames = {
      "none",        "name not found", "connection refused", "no answer",
      "no greeting", "not accepted",   "no address",         "closed there",
      "closed here", "spare address",  "duplicate",          "namesake"};
  return name_in(kNames, reason);
}

std::string_view name_of(MdnsPhase phase) noexcept {
  static constexpr std::array<std::string_view, 3> kNames = {"off", "waiting", "running"};
  return name_in(kNames, phase);
}

std::string_view name_of(MirrorState state) noexcept {
  static constexpr std::array<std::string_view, 6> kNames = {
      "unknown", "connecting", "filling", "live", "owner unavailable", "removed"};
  return name_in(kNames, state);
}

std::string_view name_of(StreamVia via) noexcept {
  static constexpr std::array<std::string_view, 4> kNames = {"local", "mirror", "remote writer",
                                                             "connection"};
  return name_in(kNames, via);
}

std::string_view name_of(StreamState state) noexcept {
  static constexpr std::array<std::string_view, 5> kNames = {"unknown", "empty", "live", "stalled",
                                                             "no writer"};
  return name_in(kNames, state);
}

std::string_view name_of(ClockBasis basis) noexcept {
  static constexpr std::array<std::string_view, 4> kNames = {"nothing", "root", "reference", "own"};
  return name_in(kNames, basis);
}

std::string_view name_of(ClockPolicy policy) noexcept {
  static constexpr std::array<std::string_view, 3> kNames = {"enforce", "mark", "off"};
  return name_in(kNames, policy);
}

std::string_view name_of(DistanceBasis basis) noexcept {
  static constexpr std::array<std::string_view, 4> kNames = {"nothing", "chain", "measured",
                                                             "one clock"};
  return name_in(kNames, basis);
}

}  // namespace dssm
