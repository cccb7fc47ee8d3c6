// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_error_cache.hpp"

namespace dssm::clock {
namespace {

constexpr std::uint64_t kBillion = 1'000'000'000;
// A greater bound does not grow, so that the sum does not overflow.
constexpr std::int64_t kMaxGrowingNs = INT64_MAX - (std::int64_t{1} << 32);

}  // namespace

void ClockErrorCache::refresh(const ClockPage& page) noexcept {
  ClockPageState state;
  generation_ = page.state.load<ClockPageState::kStampBytes>(state);
  page_ = &page;
  wall_ns_ = to_ns(state.wall);
  const bool grows = to_ns(state.clock.bound) <= kMaxGrowingNs;
  bound_ns_ = grows ? to_ns(state.clock.bound) : INT64_MAX;
  // At most 10^6 * 2^32, and in find() 3.5e9 * 4.3e6, so neither overflows; rounds up.
  const auto ageing = static_cast<std::uint64_t>(grows ? state.clock.ageing_ppb : 0);
  growth_ = ((ageing << 32) + kBillion - 1) / kBillion;
}

}  // namespace dssm::clock
