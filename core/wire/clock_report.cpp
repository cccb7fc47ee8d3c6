// SPDX-License-Identifier: Apache-2.0
#include "core/wire/clock_report.hpp"

#include <algorithm>
#include <cstring>

#include "core/base/text.hpp"
#include "core/clock/clock_bound.hpp"
#include "core/wire/messages.hpp"

namespace dssm::wire {
namespace {

constexpr std::size_t kMaxBootIdBytes = 64;
constexpr std::size_t kMaxReferenceBytes = 63;
constexpr std::int64_t kMaxAgeing = 10'000'000;  // a clock that loses a percent
constexpr std::uint32_t kMaxStratum = 16;
constexpr std::int64_t kMaxTimeNs = std::int64_t{1} << 62;  // sums and differences do not overflow

Duration error_untrusted(std::int64_t ns) noexcept {
  return ns < 0 ? kUnknownClockError : Duration(ns);
}

Duration length_untrusted(std::int64_t ns) noexcept {
  return Duration(std::max<std::int64_t>(ns, 0));
}

// Ids and addresses alike.
bool take_16_untrusted(const std::string& bytes, std::array<std::uint8_t, 16>& id) noexcept {
  if (bytes.size() != id.size()) return false;
  std::memcpy(id.data(), bytes.data(), id.size());
  return true;
}

bool is_printable_ascii(const std::string& text) noexcept {
  return std::all_of(text.begin(), text.end(),
                     [](unsigned char c) { return c >= 0x20 && c < 0x7f; });
}

ClockSnapshot snapshot_untrusted(const proto::ClockReport& message) noexcept {
  ClockSnapshot clock;
  clock.status = enum_untrusted(message.status(), ClockStatus::out_of_bounds);
  clock.reason = enum_untrusted(message.reason(), ClockReason::too_far);
  clock.basis = enum_untrusted(message.basis(), ClockBasis::own);
  clock.stratum = std::min(message.stratum(), kMaxStratum);
  clock.root = {error_untrusted(message.root_dispersion_ns()),
                error_untrusted(message.root_delay_ns())};
  clock.offset = Duration(message.offset_ns());
  clock.update_interval = length_untrusted(message.update_interval_ns());
  clock.age = length_untrusted(message.age_ns());
  return clock;
}

// The bounds, which mean nothing without a credible ageing and chain.
void take_bounds_untrusted(const proto::ClockReport& message, ClockReport& out) {
  if (message.ageing_ppb() < 0 || message.ageing_ppb() > kMaxAgeing) return;
  out.clock.ageing_ppb = message.ageing_ppb();
  out.clock.root_bound = error_untrusted(message.root_bound_ns());
  out.root_is_utc = message.root_is_utc();
  if (static_cast<std::size_t>(message.chain_size()) > ClockReport::kMaxLinks) return;
  for (const proto::ClockLink& link : message.chain()) {
    HostId host{};
    if (take_16_untrusted(link.host_id(), host)) {
      out.chain.push_back({host, error_untrusted(link.bound_ns())});
    }
  }
  if (!take_16_untrusted(message.anchor(), out.anchor)) return;
  out.clock.bound = error_untrusted(message.bound_ns());
  out.bound_is_root = message.bound_is_root();
}

std::string host_untrusted(const std::string& name) {
  return check_host_name(name) ? name : std::string();
}

bool is_time(std::int64_t ns) noexcept { return ns > 0 && ns < kMaxTimeNs; }

void take_line_untrusted(const proto::ClockLine& message, ClockReport& out) {
  const std::int64_t rate = message.rate_ppb();
  if (!is_time(message.raw_ns()) || !is_time(message.wall_ns()) || message.setting() == 0 ||
      rate < -clock::ClockLine::kMaxRate || rate > clock::ClockLine::kMaxRate ||
      !is_time(message.tolerance_ns())) {
    return;
  }
  out.line = {RawTime(Duration(message.raw_ns())), time_from_ns(message.wall_ns()), rate,
              Duration(message.tolerance_ns())};
  out.setting = message.setting();
  out.setting_from = time_from_ns(message.setting_from_ns());
  out.settled_from = time_from_ns(message.settled_from_ns());
}

}  // namespace

Duration ClockReport::distance_from(const HostId& host) const noexcept {
  const auto link = std::find_if(chain.begin(), chain.end(),
                                 [&](const ClockLink& one) { return one.host == host; });
  return link == chain.end() ? kUnknownClockError : link->bound;
}

ClockReport ClockReport::at(MonoTime now) const {
  ClockReport later = *this;
  const Duration grown = clock::growth(now - as_of, clock.ageing_ppb);
  for (ClockLink& link : later.chain) link.bound = sum(link.bound, grown);
  later.clock.bound = sum(clock.bound, grown);
  later.clock.root_bound = sum(clock.root_bound, grown);
  later.clock.age += std::max(now - as_of, Duration::zero());
  later.as_of = now;
  return later;
}

void to_message(const ClockReport& report, proto::ClockReport& out) {
  const ClockSnapshot& clock = report.clock;
  out.set_bound_ns(to_ns(clock.bound));
  out.set_boot_id(report.boot_id);
  for (const ClockLink& link : report.chain) {
    proto::ClockLink& to = *out.add_chain();
    to.set_host_id(link.host.data(), link.host.size());
    to.set_bound_ns(to_ns(link.bound));
  }
  out.set_anchor(report.anchor.data(), report.anchor.size());
  out.set_bound_is_root(report.bound_is_root);
  out.set_root_bound_ns(to_ns(clock.root_bound));
  out.set_root_is_utc(report.root_is_utc);
  out.set_ageing_ppb(clock.ageing_ppb);
  out.set_status(static_cast<std::uint32_t>(clock.status));
  out.set_reason(static_cast<std::uint32_t>(clock.reason));
  out.set_basis(static_cast<std::uint32_t>(clock.basis));
  out.set_offset_ns(to_ns(clock.offset));
  out.set_update_interval_ns(to_ns(clock.update_interval));
  out.set_age_ns(to_ns(clock.age));
  out.set_reference(report.reference.substr(0, kMaxReferenceBytes));
  out.set_stratum(clock.stratum);
  for (const IpAddress& address : report.addresses) {
    out.add_addresses(address.bytes.data(), address.bytes.size());
  }
  if (report.line.exists()) {
    proto::ClockLine& line = *out.mutable_line();
    line.set_raw_ns(to_ns(report.line.raw));
    line.set_wall_ns(to_ns(report.line.wall));
    line.set_rate_ppb(report.line.rate);
    line.set_tolerance_ns(to_ns(report.line.tolerance));
    line.set_setting(report.setting);
    line.set_setting_from_ns(to_ns(report.setting_from));
    line.set_settled_from_ns(to_ns(report.settled_from));
  }
  out.set_corrected_ns(to_ns(report.corrected));
  out.set_root_dispersion_ns(to_ns(clock.root.dispersion));
  out.set_root_delay_ns(to_ns(clock.root.delay));
}

ClockReport clock_report_untrusted(const proto::ClockReport& message, MonoTime as_of) {
  ClockReport report;
  report.as_of = as_of;
  report.clock = snapshot_untrusted(message);
  take_bounds_untrusted(message, report);
  report.corrected = length_untrusted(message.corrected_ns());
  if (message.has_line()) take_line_untrusted(message.line(), report);
  if (message.boot_id().size() <= kMaxBootIdBytes) report.boot_id = message.boot_id();
  if (message.reference().size() <= kMaxReferenceBytes && is_printable_ascii(message.reference())) {
    report.reference = message.reference();
  }
  for (const std::string& address : message.addresses()) {
    if (report.addresses.size() == ClockReport::kMaxAddresses) break;
    IpAddress taken;
    if (take_16_untrusted(address, taken.bytes)) report.addresses.push_back(taken);
  }
  return report;
}

void to_message(const ClockPair& pair, proto::ClockPair& out) {
  out.set_reader(pair.reader);
  out.set_owner(pair.owner);
  out.set_refused(pair.refused);
  out.set_reason(pair.reason);
  out.set_bound_ns(to_ns(pair.bound));
  out.set_basis(static_cast<std::uint32_t>(pair.basis));
  out.set_chain_ns(to_ns(pair.chain));
  out.set_measured_ns(to_ns(pair.measured));
  out.set_round_trip_ns(to_ns(pair.round_trip));
  out.set_limit_ns(to_ns(pair.limit));
  out.set_error(pair.error);
}

ClockPair clock_pair_untrusted(const proto::ClockPair& message) {
  ClockPair pair;
  pair.reader = host_untrusted(message.reader());
  pair.owner = host_untrusted(message.owner());
  pair.refused = message.refused();
  pair.reason = text_untrusted(message.reason(), kMaxSentenceBytes);
  pair.bound = error_untrusted(message.bound_ns());
  pair.basis = enum_untrusted(message.basis(), DistanceBasis::one_clock);
  pair.chain = error_untrusted(message.chain_ns());
  pair.measured = error_untrusted(message.measured_ns());
  pair.round_trip = length_untrusted(message.round_trip_ns());
  pair.limit = length_untrusted(message.limit_ns());
  pair.error = text_untrusted(message.error(), kMaxSentenceBytes);
  return pair;
}

}  // namespace dssm::wire
