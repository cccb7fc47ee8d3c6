// SPDX-License-Identifier: Apache-2.0
//
// Lets a receiver that has taken all bytes poll for the next ones for a short time before it
// sleeps, where that pays.
//
// Sleeping costs the sender: it has to wake the receiver for each piece of a large sample, which
// can take longer than sending that piece. Polling costs this PC a processor. So spinning has a
// budget of time, which received bytes fill:
//
//   each byte adds 0.5 ns          spinning all the time at 2 GB/s, 6 % of the time at 1 Gbit/s,
//                                  0.05 % at 1,000 samples of 1 KiB a second
//   a spin that receives nothing   empties the budget and doubles what the next spin requires, up
//                                  to 64 times, until a spin receives something: where the sender
//                                  needs this very processor, hardly any time is spent
#pragma once

#include <cstddef>
#include <dssm/time.hpp>
#include <span>

#include "core/wire/transport.hpp"

namespace dssm::detail {

// A value; one thread.
class SpinBudget {
 public:
  // 60 KiB at 2 GB/s: enough for the next packet of a sender that is sending, and short enough not
  // to delay other programs.
  static constexpr Duration kMaxSpin{30'000};
  static constexpr int kMaxCostFactor = 64;  // times kMaxSpin

  // Bytes were received, by any function.
  void on_received(std::size_t bytes) noexcept;

  // As Transport::receive_waiting(), after a spin if may_spin(). A signal during the spin does not
  // interrupt. The caller reports received bytes to on_received().
  Result<wire::IoResult> receive(wire::Transport& transport, std::span<const iovec> spaces);

  bool may_spin() const noexcept { return budget_ >= cost_; }

 private:
  void on_spun(Duration length, bool was_empty) noexcept;

  Duration budget_{0}, cost_ = kMaxSpin;  // cost_: what the next spin requires
};

}  // namespace dssm::detail
