// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/rights.hpp"

#include <fmt/format.h>
#include <fnmatch.h>
#include <unistd.h>

#include <algorithm>
#include <cstddef>
#include <optional>
#include <string_view>

#include "core/base/text.hpp"
#include "daemon/service/config_values.hpp"

namespace dssm::daemon {
namespace {

// What an action needs one of; empty: it is allowed to all.
Verbs needed_for(Action action) noexcept {
  Verbs verbs;
  switch (action) {
    case Action::create:
      return Verb::create;
    case Action::open_for_reading:
    case Action::offer_for_reading:
    case Action::read:
    case Action::get_property:
      return Verb::read;
    case Action::open_for_writing:
    case Action::offer_for_writing:
    case Action::publish:
      return Verb::write;
    case Action::open_channel:
      for (const Verb verb : {Verb::read, Verb::write, Verb::property}) verbs |= verb;
      return verbs;
    case Action::remove:
      return Verb::remove;
    case Action::set_property:
    case Action::describe:
      return Verb::property;
    case Action::see:
      for (const Verb verb :
           {Verb::read, Verb::write, Verb::create, Verb::remove, Verb::property}) {
        verbs |= verb;
      }
      return verbs;
    case Action::open_clock:
      return Verb::clock;
    case Action::greet:
    case Action::close:
    case Action::list:
    case Action::open_clock_page:
    case Action::inspect:
    case Action::ping:
    case Action::set_users:
      return {};
  }
  return Verbs::all();
}

std::string_view words_for(Action action) noexcept {
  switch (action) {
    case Action::create:
      return "create";
    case Action::open_for_writing:
    case Action::offer_for_writing:
    case Action::publish:
      return "write into";
    case Action::remove:
      return "remove";
    case Action::set_property:
      return "set the property of";
    case Action::describe:
      return "describe";
    case Action::open_channel:
      return "open";
    case Action::see:
      return "see";
    default:
      return "read";
  }
}

bool is_certified(const Identity& identity, wire::CertifiedPeer::Kind kind,
                  const std::string& pattern) {
  return identity.certified && identity.certified->kind == kind &&
         !::fnmatch(pattern.c_str(), identity.certified->name.c_str(), 0);
}

bool is_for(const Right& right, const Identity& identity) {
  const bool is_local = identity.is_local();
  switch (right.who) {
    case Right::Who::everyone:
      return true;
    case Right::Who::local:
      return is_local;
    case Right::Who::user:
      return is_local && identity.uid == right.number;
    case Right::Who::group:
      return is_local && (identity.gid == right.number ||
                          std::find(identity.groups.begin(), identity.groups.end(), right.number) !=
                              identity.groups.end());
    case Right::Who::host:
      return is_certified(identity, wire::CertifiedPeer::Kind::host, right.name_pattern);
    case Right::Who::program:
      return is_certified(identity, wire::CertifiedPeer::Kind::program, right.name_pattern);
  }
  return false;
}

// As a line names it.
std::string who_of(const Identity& identity) {
  if (identity.is_local()) return fmt::format("user:{}", identity.uid);
  if (!identity.certified) return "everyone";
  const bool is_host = identity.certified->kind == wire::CertifiedPeer::Kind::host;
  return (is_host ? "host:" : "program:") + identity.certified->name;
}

constexpr bool is_plain(char c) noexcept {
  return is_letter_or_digit(c) || c == '_' || c == '-' || c == '.';
}

// Takes from `streams`, messages with an `id`, what `identity` may not see.
template <class Streams>
void hide_streams(const Rights& rights, const Identity& identity, Streams& streams) {
  const auto hidden =
      std::stable_partition(streams.begin(), streams.end(), [&](const auto& stream) {
        return rights.shows(identity, {stream.id().name(), stream.id().id(), stream.id().host()});
      });
  streams.erase(hidden, streams.end());
}

bool may_do_everything(const Identity& identity) noexcept {
  return identity.is_local() && (identity.uid == 0 || identity.uid == ::geteuid());
}

}  // namespace

Verbs Rights::verbs(const Identity& identity, const StreamId& stream) const {
  if (lines_.empty() || may_do_everything(identity)) return Verbs::all();
  Verbs verbs;
  for (const Right& line : lines_) {
    if (!is_for(line, identity)) continue;
    if (line.verbs.has(Verb::clock)) verbs |= Verb::clock;
    if (names_stream(line.streams, stream)) verbs |= line.verbs;
  }
  return verbs;
}

Result<void> Rights::check(const Identity& identity, Action action, const StreamId& stream) const {
  const Verbs needed = needed_for(action);
  if (needed.empty() || verbs(identity, stream).has_any(needed)) return {};
  std::string fix = "see docs/security.md \"Rights\"";
  const bool is_clock = action == Action::open_clock;
  // A name with other characters could be a pattern for more.
  if (is_clock || (!stream.name.empty() && std::all_of(stream.name.begin(), stream.name.end(),
                                                       [](char c) { return is_plain(c); }))) {
    fix = fmt::format("it takes a line such as \"{} {} {}\" (docs/security.md)", who_of(identity),
                      Verbs(needed.first()).str(), is_clock ? "*" : stream.name);
  }
  if (is_clock) {
    return Error{Errc::no_permission,
                 fmt::format("{} may not use the playback clock: dssmd's key 'rights' does not "
                             "allow it; {}",
                             identity.str(), fix)};
  }
  return Error{Errc::no_permission,
               fmt::format("{} may not {} stream {}: dssmd's key 'rights' does not allow it; {}",
                           identity.str(), words_for(action),
                           in_quotes(stream.str().substr(0, kMaxFullNameBytes)), fix)};
}

Result<void> Rights::check_create(const Identity& identity, const StreamId& stream, bool exists,
                                  Action write) const {
  Result<void> created = check(identity, Action::create, stream);
  if (!exists) return created;
  Result<void> written = check(identity, write, stream);
  return written || created ? written : created;
}

bool Rights::shows(const Identity& identity, const StreamId& stream) const {
  return lines_.empty() || verbs(identity, stream).has_any(needed_for(Action::see));
}

void Rights::hide(const Identity& identity, proto::StreamList& list) const {
  if (!lines_.empty()) hide_streams(*this, identity, *list.mutable_streams());
}

void Rights::hide(const Identity& identity, proto::NodeList& list) const {
  if (lines_.empty()) return;
  auto& nodes = *list.mutable_nodes();
  for (proto::Node& node : nodes) hide_streams(*this, identity, *node.mutable_streams());
  const auto hidden = std::stable_partition(nodes.begin(), nodes.end(), [](const auto& node) {
    return !node.streams().empty() || !node.error().empty();
  });
  nodes.erase(hidden, nodes.end());
}

}  // namespace dssm::daemon
