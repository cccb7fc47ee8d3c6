// SPDX-License-Identifier: Apache-2.0
#include "core/clock/error_cache.hpp"

namespace dssm::clock {
namespace {

constexpr std::uint64_t kBillion = 1'000'000'000;
// What is beyond it does not grow, lest it overflow.
constexpr std::int64_t kGreatestNs = INT64_MAX - (std::int64_t{1} << 32);

}  // namespace

void ErrorCache::look(const ClockPage& page) noexcept {
  const StatedBound seen = stated_bound(page);
  page_ = &page;
  generation_ = seen.generation;
  wall_ns_ = seen.wall_ns;
  const bool is_bound = seen.bound_ns <= kGreatestNs;
  bound_ns_ = is_bound ? seen.bound_ns : INT64_MAX;
  // At most 10^6 * 2^32, and in find() 3.5e9 * 4.3e6, so neither overflows; rounds up.
  const auto ageing = static_cast<std::uint64_t>(is_bound ? seen.ageing_ppb : 0);
  growth_ = ((ageing << 32) + kBillion - 1) / kBillion;
}

}  // namespace dssm::clock
