// SPDX-License-Identifier: Apache-2.0
//
// Lets a receiver that has taken all there was stay awake for what comes next, where that pays.
//
// To sleep costs the sender: it has to wake the receiver for each piece of a large sample, which
// can take it longer than to send that piece. To stay awake costs this PC a processor. So a spin_budget
// has to be earned by what was received, and is short:
//
//   each byte earns half a nanosecond   all of the time at 2 GB/s, 6 % of it at 1 Gbit/s, 0.05 % at
//                                       1,000 samples of 1 KiB a second
//   one in vain costs all that is left  and the next is twice as dear, up to 64 times, until one is
//                                       not in vain: where the sender needs this very processor,
//                                       hardly any is held
#pragma once

#include <cstddef>
#include <dssm/time.hpp>
#include <span>

#include "core/wire/transport.hpp"

namespace dssm::detail {

// A value; one thread.
class SpinBudget {
 public:
  // 60 KiB at 2 GB/s: enough for the next packet of a sender that is at it, and too little to be
  // missed by anybody else.
  static constexpr Duration kLongest{30'000};
  static constexpr int kDearest = 64;  // times kLongest

  // Bytes came, by whatever way.
  void on_received(std::size_t bytes) noexcept;

  // As Transport::receive_waiting(), after a spin_budget if one is earned. A signal during the spin_budget does
  // not interrupt. What it brings is to be told by on_received().
  Result<wire::IoResult> receive(wire::Transport& transport, std::span<const iovec> spaces);

  bool is_earned() const noexcept { return credit_ >= price_; }

 private:
  void on_held(Duration length, bool in_vain) noexcept;

  Duration credit_{0}, price_ = kLongest;
};

}  // namespace dssm::detail
