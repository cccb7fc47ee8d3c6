// SPDX-License-Identifier: Apache-2.0
//
// Knows whether anybody uses the rings of a mirror or a remote writer. Its keeper holds a stream
// for itself and lends it out; who borrowed it (the OpenTable, mostly) keeps it as any other
// stream. When the last one lets go, the keeper is told.
#pragma once

#include <functional>
#include <memory>
#include <utility>

#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class Lender {
 public:
  // on_returned: called when nobody has anything borrowed any more, from wherever the last one let
  // go, so it may do no more than note it. Not after the lender is gone; what is lent outlives it.
  explicit Lender(std::function<void()> on_returned)
      : state_(std::make_shared<State>(State{std::move(on_returned)})) {}

  std::shared_ptr<Stream> lend(const std::shared_ptr<Stream>& stream) {
    ++state_->lent;
    return {stream.get(), [stream, state = std::weak_ptr<State>(state_)](Stream*) {
              const std::shared_ptr<State> lender = state.lock();
              if (lender && --lender->lent == 0) lender->on_returned();
            }};
  }

  bool any_lent() const noexcept { return state_->lent > 0; }

 private:
  struct State {
    std::function<void()> on_returned;
    std::size_t lent = 0;
  };
  std::shared_ptr<State> state_;
};

}  // namespace dssm::daemon
