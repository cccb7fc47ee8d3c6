// SPDX-License-Identifier: Apache-2.0
#include "core/wire/clock_report.hpp"

#include <algorithm>
#include <cstring>

#include "core/wire/messages.hpp"

namespace dssm::wire {
namespace {

constexpr std::size_t kMaxBootIdBytes = 64;
constexpr std::size_t kMaxReferenceBytes = 63;
constexpr std::int64_t kMostAgeing = 10'000'000;  // a clock that loses a percent

Duration error_untrusted(std::int64_t ns) noexcept {
  return ns < 0 ? kUnknownClockError : Duration(ns);
}

// Ids and addresses alike.
bool take_16_untrusted(const std::string& bytes, std::array<std::uint8_t, 16>& id) noexcept {
  if (bytes.size() != id.size()) return false;
  std::memcpy(id.data(), bytes.data(), id.size());
  return true;
}

void take_standing_untrusted(const proto::ClockStatus& message, clock::SyncChain& out) {
  if (message.boot_id().size() <= kMaxBootIdBytes) out.boot_id = message.boot_id();
  if (message.ageing_ppb() < 0 || message.ageing_ppb() > kMostAgeing) return;
  out.ageing = message.ageing_ppb();
  out.root_bound = error_untrusted(message.root_bound_ns());
  out.root_is_utc = message.root_is_utc();
  if (static_cast<std::size_t>(message.chain_size()) > clock::SyncChain::kMostLinks) return;
  for (const proto::ClockLink& link : message.chain()) {
    clock::ClockId id{};
    if (!take_16_untrusted(link.host_id(), id)) continue;
    out.chain.push_back({id, error_untrusted(link.bound_ns())});
  }
  if (!take_16_untrusted(message.anchor(), out.anchor)) return;
  out.bound = error_untrusted(message.bound_ns());
  out.bound_is_root = message.bound_is_root();
}

}  // namespace

ClockReport ClockReport::at(MonoTime now) const {
  ClockReport later = *this;
  later.standing = standing.aged(now - heard);
  later.age += std::max(now - heard, Duration::zero());
  later.heard = now;
  return later;
}

void to_message(const ClockReport& report, proto::ClockStatus& out) {
  const clock::SyncChain& standing = report.standing;
  out.set_bound_ns(to_ns(standing.bound));
  out.set_boot_id(standing.boot_id);
  for (const clock::ClockLink& link : standing.chain) {
    proto::ClockLink& to = *out.add_chain();
    to.set_host_id(link.clock.data(), link.clock.size());
    to.set_bound_ns(to_ns(link.bound));
  }
  out.set_anchor(standing.anchor.data(), standing.anchor.size());
  out.set_bound_is_root(standing.bound_is_root);
  out.set_root_bound_ns(to_ns(standing.root_bound));
  out.set_root_is_utc(standing.root_is_utc);
  out.set_ageing_ppb(standing.ageing);
  out.set_status(static_cast<std::uint32_t>(report.status));
  out.set_trouble(static_cast<std::uint32_t>(report.trouble));
  out.set_basis(static_cast<std::uint32_t>(report.basis));
  out.set_offset_ns(to_ns(report.offset));
  out.set_update_interval_ns(to_ns(report.update_interval));
  out.set_age_ns(to_ns(report.age));
  out.set_reference(report.reference.substr(0, kMaxReferenceBytes));
  out.set_stratum(report.stratum);
  for (const IpBytes& address : report.addresses) {
    out.add_addresses(address.data(), address.size());
  }
  out.set_root_dispersion_ns(to_ns(report.root.dispersion));
  out.set_root_delay_ns(to_ns(report.root.delay));
}

ClockReport clock_report_untrusted(const proto::ClockStatus& message, MonoTime heard) {
  ClockReport report;
  report.heard = heard;
  take_standing_untrusted(message, report.standing);
  report.status = enum_untrusted(message.status(), ClockStatus::out_of_bounds);
  report.trouble = enum_untrusted(message.trouble(), ClockReason::too_far);
  report.basis = enum_untrusted(message.basis(), ClockBasis::own);
  report.offset = Duration(message.offset_ns());
  report.update_interval = Duration(std::max<std::int64_t>(message.update_interval_ns(), 0));
  report.age = Duration(std::max<std::int64_t>(message.age_ns(), 0));
  const auto is_shown = [](char c) { return c >= 0x20 && c < 0x7f; };
  if (message.reference().size() <= kMaxReferenceBytes &&
      std::all_of(message.reference().begin(), message.reference().end(), is_shown)) {
    report.reference = message.reference();
  }
  report.stratum = static_cast<std::uint16_t>(std::min(message.stratum(), 16U));
  for (const std::string& address : message.addresses()) {
    IpBytes bytes{};
    if (report.addresses.size() == ClockReport::kMostAddresses) break;
    if (take_16_untrusted(address, bytes)) report.addresses.push_back(bytes);
  }
  report.root = {error_untrusted(message.root_dispersion_ns()),
                 error_untrusted(message.root_delay_ns())};
  return report;
}

}  // namespace dssm::wire
