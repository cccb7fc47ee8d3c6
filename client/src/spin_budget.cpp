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
  credit_ = std::min(credit_ + earned, kDearest * kLongest);
}

[[gnu::hot]] Result<wire::IoResult> SpinBudget::receive(wire::Transport& transport,
                                                        std::span<const iovec> spaces) {
  if (!is_earned()) return transport.receive_waiting(spaces);
  const MonoTime begin = MonoClock::now();
  for (;;) {
    Result<wire::IoResult> received = transport.receive(spaces);
    const bool in_vain = received && received->status == wire::IoStatus::would_block;
    const Duration length = MonoClock::now() - begin;
    if (in_vain && length < kLongest) continue;
    on_held(length, in_vain);
    return in_vain ? transport.receive_waiting(spaces) : received;
  }
}

void SpinBudget::on_held(Duration length, bool in_vain) noexcept {
  credit_ = in_vain ? Duration(0) : std::max(Duration(0), credit_ - length);
  price_ = in_vain ? std::min(2 * price_, kDearest * kLongest) : kLongest;
}

}  // namespace dssm::detail
