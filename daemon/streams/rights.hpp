// SPDX-License-Identifier: Apache-2.0
//
// Who may do what: the lines of the configuration key `rights`, applied to who asks. Without lines
// every program and host may do everything. With lines, what none of them allows is refused; root
// and dssmd's own user may do everything in any case, because they can change dssmd itself.
//
//   Verb       allows
//   read       samples and the property
//   write      samples into streams that exist
//   create     to make streams, and to write into them
//   remove     streams
//   property   to set it
//   clock      the playback clock
//
// Who has any of read, write, create, remove and property on a stream sees it in lists. What
// concerns no stream is allowed to all: heartbeats, the state of hosts and clocks.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <string>
#include <vector>

#include "daemon/service/right.hpp"
#include "daemon/streams/action.hpp"

namespace dssm::daemon {

class Rights {
 public:
  Rights() = default;
  explicit Rights(std::vector<Right> lines) : lines_(std::move(lines)) {}
  Rights(const Rights&) = delete;
  Rights& operator=(const Rights&) = delete;
  virtual ~Rights() = default;

  // From now on. Who decided by the ones before decides again in on_new_rights().
  void set(std::vector<Right> lines) { lines_ = std::move(lines); }
  const std::vector<Right>& lines() const noexcept { return lines_; }

  // Whether `identity` may do `action`. Tests have rules of their own.
  //   stream   that it concerns, as the request names it: not checked, the host may be empty;
  //            without a name: none
  //   fails    no_permission
  virtual Result<void> check(const Identity& identity, Action action, const StreamId& stream) const;
  // The same for a request to create a stream. If the stream exists, the request opens it for
  // writing, which is the action `write`. Who may do neither gets the same failure in both cases,
  // and so does not learn whether the stream exists.
  Result<void> check_create(const Identity& identity, const StreamId& stream, bool exists,
                            Action write) const;

  // What all lines for `identity` together allow with `stream`.
  Verbs verbs(const Identity& identity, const StreamId& stream) const;

  // Whether lists show `stream` to `identity`; takes from `list` what they do not show, and
  // processes that use nothing else.
  bool shows(const Identity& identity, const StreamId& stream) const;
  void hide(const Identity& identity, proto::StreamList& list) const;
  void hide(const Identity& identity, proto::NodeList& list) const;

 private:
  std::vector<Right> lines_;
};

}  // namespace dssm::daemon
