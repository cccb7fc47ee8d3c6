// SPDX-License-Identifier: Apache-2.0
//
// refresh() runs after each answer of chronyd, each report of the host that this one follows, and
// each step. It derives this host's report in one order: whom chronyd follows (find_source), the
// chain through that host and the anchor of our samples (update_chain), and the status against the
// anchor (update_status). Then it publishes the report, and notifies who depends on it.
#include "daemon/clock/fleet_clock.hpp"

#include <fmt/format.h>
#include <ifaddrs.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <algorithm>
#include <cstring>
#include <utility>

#include "core/base/text.hpp"
#include "core/base/time.hpp"
#include "core/clock/clock_bound.hpp"

namespace dssm::daemon {
namespace {

constexpr Duration kAddressesPeriod = std::chrono::seconds(5);

// A line is replaced before it is too old for others.
constexpr Duration kLineAge = clock::ClockLine::kMaxAge / 4;

std::string in_microseconds(Duration d) {
  return d == kUnknownClockError ? "unknown" : fmt::format("{} us", (to_ns(d) + 999) / 1000);
}

std::vector<wire::IpAddress> own_addresses() {
  std::vector<wire::IpAddress> addresses;
  ifaddrs* all = nullptr;
  if (::getifaddrs(&all)) return addresses;
  for (const ifaddrs* one = all; one; one = one->ifa_next) {
    if (!one->ifa_addr) continue;
    const int family = one->ifa_addr->sa_family;
    if (family != AF_INET && family != AF_INET6) continue;
    wire::SocketAddress address;
    address.length = family == AF_INET ? sizeof(sockaddr_in) : sizeof(sockaddr_in6);
    std::memcpy(&address.storage, one->ifa_addr, address.length);
    if (address.is_loopback() || addresses.size() == wire::ClockReport::kMaxAddresses) continue;
    if (const auto ip = wire::IpAddress::of(address)) addresses.push_back(*ip);
  }
  ::freeifaddrs(all);
  return addresses;
}

std::uint32_t ppb(clock::PartsPerBillion ageing) noexcept {
  return static_cast<std::uint32_t>(
      std::clamp<clock::PartsPerBillion>(ageing, 0, ring::ClockAssessment::kMaxAgeingPpb));
}

// What the log adds to the reason against one host's clock: it shows whether that clock differs
// from all others, or this PC's does. good: the hosts whose clocks are good here.
std::string others_text(const std::vector<std::string>& good) {
  if (good.empty()) return "; those of no other host are good here either";
  if (good.size() == 1) return "; those of " + in_quotes(good[0]) + " are good";
  return fmt::format("; those of {} other hosts are good", good.size());
}

// "out of bounds (stepped)"
std::string status_text(const ClockSnapshot& clock) {
  if (clock.reason == ClockReason::none) return std::string(name_of(clock.status));
  return fmt::format("{} ({})", name_of(clock.status), name_of(clock.reason));
}

bool is_good(ClockStatus status) noexcept {
  return status == ClockStatus::synchronized || status == ClockStatus::holdover;
}

// Whether other hosts have to know of the change before they get another sample.
bool is_new_generation(const wire::ClockReport& before, const wire::ClockReport& after) {
  return before.clock.status != after.clock.status || before.has_bound() != after.has_bound() ||
         before.anchor != after.anchor || !after.line.is_within(before.line) ||
         before.setting != after.setting || before.settled_from != after.settled_from ||
         before.corrected != after.corrected;
}

}  // namespace

FleetClock::FleetClock(const EventLoop& loop, const Options& options, clock::ClockPageWriter page,
                       std::shared_ptr<wire::ClockReport> own, wire::HostId self, Catalog& catalog,
                       Logger& logger)
    : catalog_(catalog),
      page_(std::move(page)),
      own_(std::move(own)),
      self_(self),
      policies_(options.policies),
      log_(logger),
      watch_(loop, options.watch, *this, logger) {
  own_->boot_id = clock::boot_id();
  if (own_->boot_id.empty()) {
    logger.warning(
        "/proc/sys/kernel/random/boot_id cannot be read: how far other PCs' clocks are is not "
        "measured, and a step of this one while no dssmd runs is not noticed; does the unit have "
        "ProcSubset=?");
  }
  own_->anchor = self_;
  if (page_.has_history()) {
    clock::ClockPageState before;
    page_.page().state.load(before);
    watch_.resume({before.base_mono, before.base_wall, before.base_width, {}}, before.setting_from);
  }
  catalog_.add_observer(*this);
}

FleetClock::~FleetClock() { catalog_.remove_observer(*this); }

void FleetClock::set(const ClockPolicies& policies, clock::PartsPerBillion max_drift) {
  policies_ = policies;
  watch_.set({policies.general.limit, max_drift});
  refresh();
}

void FleetClock::on_clock() { refresh(); }

void FleetClock::on_host_up(const KnownHost& host) { on_host_clock(host); }

void FleetClock::on_host_clock(const KnownHost& host) {
  if (host.greeting.clock) {
    // First whether this clock was set since the heartbeat was sent. Not for other reports: two
    // hosts must not make each other report for ever.
    if (host.greeting.clock->heartbeat) clock_generation();
    measure(*host.greeting.clock);
  }
  const bool is_good = reason_against(host.greeting.clock.get()).empty();
  if (log_.is_changed(host.greeting.host_id, is_good)) log_others(MonoClock::now());
  // The reports of others are used at the latest with the next answer of chronyd.
  if (source_ && host.greeting.host_id == source_->id) refresh();
  poll_if_due();
}

void FleetClock::on_host_down(const KnownHost& host, const Error&) {
  log_.forget(host.greeting.host_id);
  if (source_ && host.greeting.host_id == source_->id) refresh();
}

[[gnu::hot]] std::uint64_t FleetClock::clock_generation() {
  const bool is_on_line = own_->line.holds();
  if (!watch_.may_differ() && is_on_line) return generation_;
  const bool has_bound = watch_.state().bound != kUnknownClockError;
  if (has_bound != own_->has_bound() || !is_on_line) refresh();
  return generation_;
}

// --- this host's report

void FleetClock::refresh() {
  const clock::Instant instant = watch_.now();
  const MonoTime now = instant.mono;
  const wire::ClockReport before = *own_;
  find_source(now);
  update_addresses(now);
  update_chain(now);
  update_status();
  update_setting(instant);
  update_line(instant.raw);
  for (const auto& [id, host] : catalog_.hosts()) {
    if (host.greeting.clock) measure(*host.greeting.clock);
  }
  publish(instant);
  watch_.log_change(own_->clock);
  log_others(now);
  if (is_new_generation(before, *own_)) {
    ++generation_;
    if (on_new_generation_) on_new_generation_();
  }
  if (on_change_) on_change_();
}

const KnownHost* FleetClock::host_at(const wire::IpAddress& address) const {
  for (const auto& [id, host] : catalog_.hosts()) {
    if (!host.greeting.clock) continue;
    const std::vector<wire::IpAddress>& theirs = host.greeting.clock->addresses;
    if (std::find(theirs.begin(), theirs.end(), address) != theirs.end()) return &host;
  }
  return nullptr;
}

// Whom chronyd follows. A host that becomes unavailable stays the source for as long as chronyd
// names its address.
void FleetClock::find_source(MonoTime now) {
  const std::optional<wire::IpAddress> address = watch_.source();
  if (address != source_address_) source_.reset();
  source_address_ = address;
  const KnownHost* host = address ? host_at(*address) : nullptr;
  const std::vector<wire::IpAddress>& own = own_->addresses;
  const bool is_own = address && std::find(own.begin(), own.end(), *address) != own.end();
  if (host && !is_own) {
    if (source_ && source_->id == host->greeting.host_id) compare_source(*host);
    source_ = Source{host->greeting.host_id, host->greeting.host, host->greeting.clock, {}};
    watch_.on_reference(clock::ReferenceReport{watch_.reference_id(), source_->report->clock.root});
  } else if (!source_) {
    watch_.on_reference(std::nullopt);
  } else if (!source_->unavailable_since) {
    source_->unavailable_since = now;
  }
}

// What its clock was subject to since its last report. Its time may be another one after a boot.
void FleetClock::compare_source(const KnownHost& host) {
  const wire::ClockReport& before = *source_->report;
  const wire::ClockReport& after = *host.greeting.clock;
  if (before.boot_id != after.boot_id || (before.setting != 0 && before.setting != after.setting)) {
    watch_.on_source_step(host.greeting.host);
  }
  // The sum starts from zero when dssmd does.
  if (after.corrected > before.corrected) {
    watch_.on_source_correction(after.corrected - before.corrected);
  }
}

bool FleetClock::is_followed() const {
  return std::any_of(catalog_.hosts().begin(), catalog_.hosts().end(), [this](const auto& entry) {
    const auto& clock = entry.second.greeting.clock;
    return clock && entry.first != self_ && clock->chain.size() > 1 &&
           clock->chain[1].host == self_;
  });
}

void FleetClock::update_addresses(MonoTime now) {
  if (!own_->addresses.empty() && now - addresses_read_ < kAddressesPeriod) return;
  addresses_read_ = now;
  own_->addresses = own_addresses();
}

// Bounds of the watch are distances from the source; those of the report are from the anchor.
void FleetClock::update_chain(MonoTime now) {
  const ClockSnapshot watched = watch_.state();
  own_->as_of = now;
  own_->clock = watched;
  own_->corrected = watch_.corrected();
  own_->chain.clear();
  own_->root_is_utc = watched.basis != ClockBasis::own;
  if (watched.bound != kUnknownClockError) {
    own_->chain.push_back({self_, watch_.own_bound()});
    if (source_) {
      const wire::ClockReport theirs = source_->report->at(now);
      own_->root_is_utc = theirs.root_is_utc;
      own_->chain.push_back({source_->id, watched.bound});
      for (std::size_t i = 1; i < theirs.chain.size(); ++i) {
        const wire::ClockLink& link = theirs.chain[i];
        if (own_->chain.size() == wire::ClockReport::kMaxLinks) break;
        if (own_->distance_from(link.host) != kUnknownClockError) break;  // a loop
        own_->chain.push_back({link.host, sum(watched.bound, link.bound)});
      }
    }
  }
  choose_anchor(watched, now);
}

// What our samples are stamped against: the last host of the chain while it is available.
void FleetClock::choose_anchor(const ClockSnapshot& watched, MonoTime now) {
  wire::ClockReport& own = *own_;
  own.bound_is_root = false;
  own.anchor = self_;
  if (watched.bound == kUnknownClockError) return;
  own.clock.bound = watch_.own_bound();
  if (watched.basis == ClockBasis::own) return;
  const bool has_successor = source_ && source_->unavailable_since &&
                             now - *source_->unavailable_since > kSuccessionDelay && is_followed();
  if (source_ && !has_successor) {
    const wire::HostId& theirs = source_->report->anchor;
    const bool in_chain = own.distance_from(theirs) != kUnknownClockError;
    own.anchor = theirs == self_ || !in_chain ? source_->id : theirs;
    own.clock.bound = own.distance_from(own.anchor);
    own.clock.basis = ClockBasis::reference;
    return;
  }
  own.clock.basis = is_followed() ? ClockBasis::own : ClockBasis::root;
  if (own.clock.basis == ClockBasis::own) return;
  own.clock.bound = watched.root_bound;
  own.bound_is_root = true;
}

// The watch compares the distance from the source with the limit; the one from the anchor decides.
void FleetClock::update_status() {
  ClockSnapshot& clock = own_->clock;
  if (own_->has_bound()) {
    const bool is_within = clock.bound <= policies_.general.limit;
    if (is_within && clock.status == ClockStatus::out_of_bounds) {
      clock.status = ClockStatus::synchronized;
      clock.reason = ClockReason::none;
    } else if (!is_within) {
      clock.status = ClockStatus::out_of_bounds;
      clock.reason = ClockReason::too_far;
    }
  }
  own_->reference = source_           ? source_->name
                    : source_address_ ? source_address_->str()
                                      : std::string();
}

void FleetClock::publish(const clock::Instant& now) {
  const ClockSnapshot& clock = own_->clock;
  if (!own_->has_bound()) {
    stated_.clear();  // what was stated before a step holds for no time that is read now
  } else {
    stated_.push_back({now.wall, clock.bound});
    while (stated_.front().wall < now.wall - kReach) stated_.pop_front();
  }
  clock::ClockPageState state;
  state.wall = now.wall;
  state.mono = now.mono;
  state.clock = clock;
  state.limit = policies_.general.limit;
  own_->reference.copy(state.reference, clock::ClockPageState::kMaxReferenceBytes);
  const clock::Instant base = watch_.base();
  state.base_mono = base.mono;
  state.base_wall = base.wall;
  state.base_width = base.width;
  state.setting_from = watch_.setting_from();
  state.earlier_from = now.wall;
  for (const clock::StatedBound& stated : stated_) {
    state.earlier_from = std::min(state.earlier_from, stated.wall);
    // It grew until the next one was stated.
    state.earlier_bound = std::max(
        state.earlier_bound, sum(stated.bound, clock::growth(clock::kMaxUse, clock.ageing_ppb)));
  }
  page_.store(state);
}

// A clock that was set back will show times again that it showed before. kWrittenWithin later, no
// program writes samples of the earlier setting any more: from then on tids tell them apart.
void FleetClock::update_setting(const clock::Instant& now) {
  wire::ClockReport& own = *own_;
  if (const std::int64_t setting = watch_.setting();
      setting != std::exchange(own.setting, setting)) {
    for (auto& [boot_id, pair] : pairs_) pair.await_heartbeat();
    pairs_since_ = now.raw;
    set_at_ = now.mono;
    own.setting_from = watch_.setting_from();
    own.settled_from = {};
    rate_from_ = clock::ClockReading::now();
    own.line = clock::ClockLine::through(rate_from_, own.line.rate);
  } else if (own.settled_from == Time() && now.wall < own.setting_from &&
             now.mono - set_at_ >= kWrittenWithin) {
    own.settled_from = now.wall;
  }
}

// The next line has the rate since an earlier reading: after two or three lines that is the present
// rate of the clock.
void FleetClock::update_line(RawTime now) {
  wire::ClockReport& own = *own_;
  clock::ClockLine& line = own.line;
  const clock::ClockReading reading = clock::ClockReading::now();
  if ((line.shows(reading) || line.holds()) && now - line.raw < kLineAge) {
    // One that was drawn while reading the clocks took long would stay all the longer. Other hosts
    // get the better one with the next heartbeat: the one that they have holds as well.
    const clock::ClockLine better = clock::ClockLine::through(reading, line.rate);
    if (better.tolerance < line.tolerance * 3 / 4 && better.is_within(line)) line = better;
    return;
  }
  if (!line.exists()) rate_from_ = reading;
  line = clock::ClockLine::after(line, rate_from_, reading);
  watch_.poll_now();
}

void FleetClock::log_others(MonoTime now) {
  if (policies_.general.policy == ClockPolicy::off) return;
  std::vector<std::pair<const KnownHost*, std::string>> reasons;
  std::vector<std::string> good;
  for (const auto& [id, host] : catalog_.hosts()) {
    if (id == self_) continue;
    std::string reason = reason_against(host.greeting.clock.get(), policies_.general.limit);
    if (reason.empty()) good.push_back(host.greeting.host);
    reasons.emplace_back(&host, std::move(reason));
  }
  for (auto& [host, reason] : reasons) {
    if (!reason.empty() && reasons.size() > 1) reason += others_text(good);
    log_.update(host->greeting.host_id, host->greeting.host, reason, now);
  }
}

std::string FleetClock::str() const {
  const ClockSnapshot& clock = own_->clock;
  std::string text = fmt::format("clock {}", name_of(clock.status));
  if (clock.reason != ClockReason::none) text += fmt::format(": {}", name_of(clock.reason));
  if (!own_->has_bound()) return text;
  text += " within " + in_microseconds(clock.bound);
  switch (clock.basis) {
    case ClockBasis::nothing:
      break;
    case ClockBasis::root:
      text += " of UTC";
      break;
    case ClockBasis::reference:
      text += fmt::format(" of '{}'", own_->reference);
      break;
    case ClockBasis::own:
      text += ", is the reference";
      break;
  }
  return text;
}

// --- what other hosts' samples are worth here

void FleetClock::measure(const wire::ClockReport& theirs) {
  if (!theirs.line.exists() || theirs.boot_id.empty() || own_->shares_clock_with(theirs)) return;
  if (pairs_.size() == kMaxPairs && !pairs_.contains(theirs.boot_id)) {
    pairs_.erase(std::min_element(pairs_.begin(), pairs_.end(), [](const auto& a, const auto& b) {
      return a.second.measured_at < b.second.measured_at;
    }));
  }
  const auto [found, is_new] = pairs_.try_emplace(theirs.boot_id);
  Pair& pair = found->second;
  if (std::exchange(pair.setting, theirs.setting) != theirs.setting) {
    pair.await_heartbeat();
    // A heartbeat that brings a new setting may have been under way while that PC slept.
    if (theirs.heartbeat && !is_new) pair.since = theirs.heartbeat->answered;
  }
  if (theirs.heartbeat && theirs.heartbeat->asked > std::max(pairs_since_, pair.since) &&
      pair.raws.add_untrusted(*theirs.heartbeat)) {
    pair.is_confirmed = true;
  }
  if (pair.is_confirmed) state(pair, theirs);
}

void FleetClock::add_returned_untrusted(const wire::HostId& host,
                                        const clock::HeartbeatTimes& times) {
  const KnownHost* known = catalog_.find(host);
  if (!known || !known->greeting.clock) return;
  const wire::ClockReport& theirs = *known->greeting.clock;
  const auto pair = pairs_.find(theirs.boot_id);
  if (pair == pairs_.end() || !pair->second.is_confirmed ||
      pair->second.setting != theirs.setting ||
      times.asked <= std::max(pairs_since_, pair->second.since)) {
    return;
  }
  pair->second.raws.add_returned_untrusted(times);
  state(pair->second, theirs);
}

// Remembers what is measured at this moment.
void FleetClock::state(Pair& pair, const wire::ClockReport& theirs) {
  const auto walls = walls_of(pair, theirs);
  if (!walls) return;
  pair.last = *walls;
  pair.measured_at = MonoClock::now();
  pair.stated.add(WallClock::now(), walls->bound());
}

// At this moment.
std::optional<clock::WallDifference> FleetClock::walls_of(const Pair& pair,
                                                          const wire::ClockReport& theirs) const {
  const clock::ClockReading now = clock::ClockReading::now();
  const auto raws = pair.raws.at(now.raw);
  return raws ? clock::wall_difference(*raws, theirs.line, own_->line, now) : std::nullopt;
}

std::optional<FleetClock::Measured> FleetClock::measured(const wire::ClockReport& theirs,
                                                         MonoTime now, Duration limit) const {
  const auto found = pairs_.find(theirs.boot_id);
  if (found == pairs_.end()) return std::nullopt;
  const Pair& pair = found->second;
  if (pair.stated.empty() || pair.setting != theirs.setting) return std::nullopt;
  Measured measured{pair.last, now - pair.measured_at <= kMeasuredFor, {}};
  if (measured.is_fresh) {
    const auto walls = walls_of(pair, theirs);
    if (!walls) return std::nullopt;
    measured.now = *walls;
  } else {
    // No sample comes from there any more: those that are here were stamped while it was fresh.
    const Duration aged =
        clock::growth(now - pair.measured_at,
                      own_->clock.ageing_ppb + theirs.clock.ageing_ppb + pair.last.ageing);
    measured.now.least -= aged;
    measured.now.greatest += aged;
  }
  // As far back as the clocks were close enough: good samples are not to suffer from earlier ones.
  clock::PastBounds& past = measured.past;
  past = pair.stated.past(measured.now.bound(), WallClock::now(), limit);
  // Their clock may be ahead of this one, which the times of `stated` are of.
  const Time from = theirs.settled_from == Time() ? theirs.setting_from : theirs.settled_from;
  past.from = std::max(from, past.from + past.greatest);
  past.recent_from = std::max(from, past.recent_from + past.recent);
  return measured;
}

// By this PC's clock as it was before it was set: only a reference stays where it was set to.
bool FleetClock::is_outdated(const wire::ClockReport& theirs) const noexcept {
  return own_->clock.basis == ClockBasis::own && theirs.as_of < set_at_;
}

Duration FleetClock::chain_distance(const wire::ClockReport& theirs, MonoTime now) const {
  if (is_outdated(theirs) && !own_->shares_clock_with(theirs)) return kUnknownClockError;
  return clock::distance(own_->at(now), theirs.at(now));
}

Duration FleetClock::distance_to(const wire::ClockReport& other) const {
  const MonoTime now = MonoClock::now();
  const Duration chain = chain_distance(other, now);
  if (own_->shares_clock_with(other)) return chain;
  const std::optional<Measured> found = measured(other, now, policies_.general.limit);
  if (!found) return chain;
  if (found->is_fresh && found->now.excludes(chain)) return kUnknownClockError;
  return std::min(chain, found->now.bound());
}

Result<void> FleetClock::check_serving(const StreamId& id, const wire::Greeting& them) const {
  if (policies_.demand_for(id).policy != ClockPolicy::enforce) return {};
  if (them.clock && own_->shares_clock_with(*them.clock)) return {};
  // A dssmd assesses for itself; a program cannot.
  if (is_good(own_->clock.status) || them.has_feature(wire::kFeatureClock)) return {};
  return Error{Errc::clock_out_of_bounds,
               fmt::format("stream '{}': the {} on the host that owns it, so the times of its "
                           "samples mean nothing on other PCs; run `dssmctl clock` there, retry "
                           "once it is synchronized, or set its key clock_policy to \"mark\" or "
                           "\"off\"",
                           id.str(), str())};
}

ring::ClockAssessment FleetClock::assess_mirror(const StreamId& id,
                                                const wire::ClockReport* owner) const {
  if (owner && own_->shares_clock_with(*owner)) return {};
  const MonoTime now = MonoClock::now();
  ring::ClockAssessment found = assessment(id, now);
  if (!owner) return found;
  const std::optional<Measured> by_heartbeats = measured(*owner, now, found.limit);
  if (by_heartbeats && by_heartbeats->is_fresh &&
      by_heartbeats->now.excludes(chain_distance(*owner, now))) {
    return found;  // one of the two is wrong, and it is not known which
  }
  if (owner->has_bound() && !is_outdated(*owner)) {
    const wire::ClockReport own = own_->at(now), theirs = owner->at(now);
    found.added = clock::distance_from_anchor(theirs, own);
    found.ageing_ppb = ppb(own.clock.ageing_ppb + theirs.clock.ageing_ppb);
  }
  if (by_heartbeats) {
    found.measured = by_heartbeats->past.greatest;
    found.measured_from = by_heartbeats->past.from;
    found.recent = by_heartbeats->past.recent;
    found.recent_from = by_heartbeats->past.recent_from;
    found.measured_ageing_ppb = ppb(by_heartbeats->now.ageing);
  }
  return found;
}

ring::ClockAssessment FleetClock::assess_own(const StreamId& id) const {
  const MonoTime now = MonoClock::now();
  const ClockSnapshot own = own_->at(now).clock;
  ring::ClockAssessment found = assessment(id, now);
  found.added = own.bound;
  found.ageing_ppb = ppb(own.ageing_ppb);
  return found;
}

// Of samples of which nothing is known yet.
ring::ClockAssessment FleetClock::assessment(const StreamId& id, MonoTime now) const {
  const ClockDemand demand = policies_.demand_for(id);
  ring::ClockAssessment assessment = ring::ClockAssessment::unknown_clock(demand.policy);
  assessment.assessed = now;
  assessment.limit = demand.limit;
  return assessment;
}

// Why the times of that host's samples are not good here; empty: they are.
std::string FleetClock::reason_against(const wire::ClockReport* owner, Duration limit) const {
  if (!owner) return "nothing is known of its host's clock";
  if (own_->shares_clock_with(*owner)) return {};
  const Duration distance = distance_of_samples(*owner);
  if (distance <= limit) return {};
  const MonoTime now = MonoClock::now();
  const Duration chain = chain_distance(*owner, now);
  const std::optional<Measured> by_heartbeats = measured(*owner, now, limit);
  if (by_heartbeats && by_heartbeats->is_fresh && by_heartbeats->now.excludes(chain)) {
    return fmt::format(
        "the heartbeats show that the clocks of its host and of this PC are {} apart or more, but "
        "by what chronyd states there and here they are at most {} apart: one of them follows a "
        "clock that was set or is wrong",
        in_microseconds(std::max(by_heartbeats->now.least, -by_heartbeats->now.greatest)),
        in_microseconds(chain));
  }
  if (distance != kUnknownClockError) {
    return fmt::format(
        "its samples' times may be {} from this PC's clock, and {} are allowed (key clock_limit)",
        in_microseconds(distance), in_microseconds(limit));
  }
  if (!own_->has_bound()) return "this PC's clock is " + status_text(own_->clock);
  if (!owner->has_bound()) return "the clock of its host is " + status_text(owner->clock);
  return "the clocks of its host and of this PC follow different references";
}

std::string FleetClock::reason_against(const wire::ClockReport* owner) const {
  if (policies_.general.policy == ClockPolicy::off) return {};
  return reason_against(owner, policies_.general.limit);
}

// Of one that the host writes now, as readers compute it. It may be more than distance_to(): a
// sample's clock error is against the anchor, which may be further away than its writer.
Duration FleetClock::distance_of_samples(const wire::ClockReport& owner) const {
  const MonoTime now = MonoClock::now();
  // After measured_from, except on a clock that was set back and shows times from before it.
  const Time wall = WallClock::now();
  const bool is_before = owner.settled_from == Time() && owner.setting_from > wall;
  const SampleInfo latest{0, is_before ? wall : Time::max(), owner.at(now).clock.bound};
  return assess_mirror({}, &owner).distance(latest, now);
}

std::vector<ClockPair> FleetClock::clock_pairs() {
  clock_generation();  // so that what was measured is about this clock as it is now
  std::vector<ClockPair> pairs;
  for (const auto& [id, host] : catalog_.hosts()) {
    if (pairs.size() == wire::kMaxClockPairs) break;
    if (id != self_) pairs.push_back(pair_with(host.greeting));
  }
  return pairs;
}

ClockPair FleetClock::pair_with(const wire::Greeting& owner) const {
  const wire::ClockReport* const theirs = owner.clock.get();
  ClockPair pair;
  pair.owner = owner.host;
  pair.limit = policies_.general.limit;
  pair.reason = reason_against(theirs);
  pair.refused = !pair.reason.empty() && refuses();
  if (!theirs) return pair;
  pair.bound = distance_of_samples(*theirs);
  if (own_->shares_clock_with(*theirs)) {
    pair.basis = DistanceBasis::one_clock;
    return pair;
  }
  // Both statements, also when they exclude each other.
  const MonoTime now = MonoClock::now();
  const wire::ClockReport latest = theirs->at(now);
  pair.chain = sum(latest.clock.bound, clock::distance_from_anchor(latest, own_->at(now)));
  if (const auto by_heartbeats = measured(*theirs, now, policies_.general.limit)) {
    pair.measured = by_heartbeats->past.recent;
    pair.round_trip = pairs_.at(theirs->boot_id).raws.best_round_trip();
  }
  if (pair.bound != kUnknownClockError) {
    pair.basis = pair.measured <= pair.chain ? DistanceBasis::measured : DistanceBasis::chain;
  }
  return pair;
}

Error FleetClock::refusal(const StreamId& id, const wire::ClockReport* owner) const {
  std::string reason = reason_against(owner, policies_.demand_for(id).limit);
  if (reason.empty()) reason = "its host's clock was not known a moment ago";
  return Error{Errc::clock_out_of_bounds,
               fmt::format("stream '{}': {}; run `dssmctl clock` and `chronyc tracking` on both, "
                           "or set the key clock_policy to \"mark\" or \"off\"",
                           id.str(), reason)};
}

}  // namespace dssm::daemon
