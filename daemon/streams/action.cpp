// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/action.hpp"

#include <fmt/format.h>

#include "core/base/text.hpp"
#include "daemon/base/limit_use.hpp"

namespace dssm::daemon {
namespace {

// The requests that both protocols have.
template <class Request>
std::optional<Action> catalog_action(const Request& request) noexcept {
  switch (request.body_case()) {
    case Request::kHello:
      return Action::greet;
    case Request::kCreate:
      return Action::create;
    case Request::kRemove:
      return Action::remove;
    case Request::kSetProperty:
      return Action::set_property;
    case Request::kGetProperty:
      return Action::get_property;
    case Request::kDescribe:
      return Action::describe;
    case Request::kList:
    case Request::kWatch:
    case Request::kListNodes:
      return Action::list;
    case Request::kInfo:
      return Action::see;
    case Request::kListClockPairs:
      return Action::inspect;
    case Request::kFollowPlayback:
      return Action::open_clock;
    default:
      return std::nullopt;
  }
}

}  // namespace

std::string Identity::str() const {
  if (is_local()) return fmt::format("'{}' (pid {}, uid {})", program, pid, uid);
  return fmt::format("'{}' on host '{}' at '{}'", program, host, address);
}

std::string Identity::account() const {
  if (is_local()) return is_limited(uid) ? fmt::format("user {}", uid) : std::string();
  return account_of(address, certified ? &*certified : nullptr);
}

std::string account_of(const std::string& address, const wire::CertifiedPeer* certified) {
  if (certified) return certified->str();
  // A program may use each of 127.0.0.1 to 127.255.255.254, and ::1.
  const bool is_this_pc = address.starts_with("127.") || address.starts_with("[::ffff:127.") ||
                          address.starts_with("[::1]");
  return in_quotes(is_this_pc ? "127.0.0.1" : address.substr(0, address.rfind(':')));
}

std::optional<Action> action_of(const local::Request& request) noexcept {
  switch (request.body_case()) {
    case local::Request::kClose:
      return Action::close;
    case local::Request::kOpen:
      return request.open().for_writing() ? Action::open_for_writing : Action::open_for_reading;
    case local::Request::kOffer:
      return request.offer().for_writing() ? Action::offer_for_writing : Action::offer_for_reading;
    case local::Request::kListRights:
      return Action::see;
    case local::Request::kWantHistory:
      return Action::open_for_reading;
    case local::Request::kOpenClock:
      return Action::open_clock;
    case local::Request::kOpenClockPage:
      return Action::open_clock_page;
    case local::Request::kListClients:
    case local::Request::kListOpens:
    case local::Request::kGetDaemon:
    case local::Request::kListHosts:
      return Action::inspect;
    case local::Request::kPingHost:
      return Action::ping;
    default:
      return catalog_action(request);
  }
}

std::optional<Action> action_of(const net::Frame& request) noexcept {
  switch (request.body_case()) {
    case net::Frame::kOpen:
      return Action::open_channel;
    case net::Frame::kSubscribe:
    case net::Frame::kRead:
    case net::Frame::kGetRange:
      return Action::read;
    case net::Frame::kStartPublishing:
      return Action::publish;
    case net::Frame::kSetUsers:
      return Action::set_users;
    case net::Frame::kPing:
      return Action::ping;
    default:
      return catalog_action(request);
  }
}

}  // namespace dssm::daemon
