// SPDX-License-Identifier: Apache-2.0
#include "client/src/spin_budget.hpp"

#include <algorithm>
#include <cstdint>

namespace dssm::detail {
namespace {

constexpr std::size_t kBytesPerNs = 2;

}  // namespace

[[gnu::hot]] void SpinBudget::on_received(std::size_t bytes) noexcept {
  const Duration earned(static_cast<std::int64_t>(bytes / kBytesPerNs));
  budget_ = std::min(budget_ + earned, kMaxCostFactor * kMaxSpin);
}

[[gnu::hot]] Result<wire::IoResult> SpinBudget::receive(wire::Transport& transport,
                                                        std::span<const iovec> spaces) {
  if (!may_spin()) return transport.receive_waiting(spaces);
  const MonoTime begin = MonoClock::now();
  for (;;) {
    Result<wire::IoResult> received = transport.receive(spaces);
    const bool was_empty = received && received->status == wire::IoStatus::would_block;
    const Duration length = MonoClock::now() - begin;
    if (was_empty && length < kMaxSpin) continue;
    on_spun(length, was_empty);
    return was_empty ? transport.receive_waiting(spaces) : received;
  }
}

void SpinBudget::on_spun(Duration length, bool was_empty) noexcept {
  budget_ = was_empty ? Duration(0) : std::max(Duration(0), budget_ - length);
  cost_ = was_empty ? std::min(2 * cost_, kMaxCostFactor * kMaxSpin) : kMaxSpin;
}

}  // namespace dssm::detail
