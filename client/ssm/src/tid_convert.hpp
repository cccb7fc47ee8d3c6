// SPDX-License-Identifier: Apache-2.0
//
// SSM's tids are ints, the ring's have 64 bits. A program sees the lower 31 bits: after 2147483647
// comes 0 again, and a stream written at 1 kHz lives on after 24.8 days. While a stream is younger
// than that, both are the same number.
#pragma once

#include <cstdint>
#include <dssm/sample.hpp>
#include <limits>

namespace dssm::ssm {

inline constexpr Tid kTidMask = std::numeric_limits<std::int32_t>::max();

inline int ssm_tid(Tid tid) noexcept { return tid < 0 ? -1 : static_cast<int>(tid & kTidMask); }

// The ring's tid that a program means by `tid` >= 0 while the newest is `newest`: the one of those
// with these 31 bits that is closest to it.
inline Tid ring_tid(int tid, Tid newest) noexcept {
  if (newest <= kTidMask) return tid;
  const Tid behind = (newest - tid) & kTidMask;
  return behind <= kTidMask / 2 ? newest - behind : newest + (kTidMask + 1 - behind);
}

}  // namespace dssm::ssm
