// SPDX-License-Identifier: Apache-2.0
//
// The protocol between dssm-view and its page, "dssm.view.v1" (docs/view.md): the page asks, and
// gets one answer for each request. So a browser that is slow, or does not read at all, delays
// itself only.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "client/view/saver.hpp"
#include "client/view/server.hpp"
#include "client/view/state.hpp"
#include "client/view/streams.hpp"

namespace dssm::view {

class PageConnection;

// All pages that are open. In the server's thread.
class Pages {
 public:
  // `streams` and `saver` outlive it.
  //   saver     null: ranges cannot be saved
  //   want_all  called when a page asks for a state: the next ones are to have all
  Pages(Streams& streams, Saver* saver, std::function<void()> want_all)
      : streams_(streams), saver_(saver), want_all_(std::move(want_all)) {}

  std::unique_ptr<Connection> connect(Peer& peer);

  // A new state, for the pages that wait for one.
  void on_state(const VehicleState& state);

 private:
  friend class PageConnection;
  Streams& streams_;
  Saver* const saver_;
  const std::function<void()> want_all_;
  std::string state_;  // the newest as JSON; empty: there is none with all that pages show
  std::uint64_t state_number_ = 0;
  std::map<std::uint64_t, PageConnection*> connections_;  // by their numbers
  std::uint64_t last_connection_ = 0;
};

}  // namespace dssm::view
