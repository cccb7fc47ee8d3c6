// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/fleet_clock.hpp"

#include <ifaddrs.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <algorithm>
#include <cstring>
#include <utility>

namespace dssm::daemon {
namespace {

constexpr Duration kAddressesPeriod = std::chrono::seconds(5);

std::string in_microseconds(Duration d) {
  if (d == kUnknownClockError) return "unknown";
  return std::to_string((to_ns(d) + 999) / 1000) + " us";
}

std::vector<wire::IpBytes> own_addresses() {
  std::vector<wire::IpBytes> addresses;
  ifaddrs* all = nullptr;
  if (::getifaddrs(&all)) return addresses;
  for (const ifaddrs* one = all; one; one = one->ifa_next) {
    if (!one->ifa_addr) continue;
    const int family = one->ifa_addr->sa_family;
    if (family != AF_INET && family != AF_INET6) continue;
    wire::SocketAddress address;
    address.length = family == AF_INET ? sizeof(sockaddr_in) : sizeof(sockaddr_in6);
    std::memcpy(&address.storage, one->ifa_addr, address.length);
    if (address.is_loopback() || addresses.size() == wire::ClockReport::kMostAddresses) continue;
    if (const std::optional<SourceAddress> bytes = SourceAddress::of(address)) {
      addresses.push_back(bytes->bytes);
    }
  }
  ::freeifaddrs(all);
  return addresses;
}

bool is_good(ClockStatus status) noexcept {
  return status == ClockStatus::synchronized || status == ClockStatus::holdover;
}

// Whether other hosts have to know of the change before they get another sample.
bool is_new_generation(const wire::ClockReport& before, const wire::ClockReport& after) {
  const auto is_known = [](const wire::ClockReport& report) {
    return report.standing.bound != kUnknownClockError;
  };
  return before.status != after.status || is_known(before) != is_known(after) ||
         before.standing.anchor != after.standing.anchor;
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
  own_->standing.boot_id = clock::boot_id();
  own_->standing.anchor = self_;
  if (page_.has_history()) {
    const clock::ClockRecord before = clock::load(page_.page());
    watch_.resume(before.base);
    was_in_bounds_ = is_good(before.state.status);
  }
  catalog_.add_observer(*this);
}

FleetClock::~FleetClock() { catalog_.remove_observer(*this); }

void FleetClock::set(const clock::ClockPolicies& policies, clock::PartsPerBillion max_drift) {
  policies_ = policies;
  watch_.set({policies.general.limit, max_drift});
  refresh();
}

void FleetClock::on_clock() { refresh(); }

void FleetClock::on_host_clock(const KnownHost& host) {
  // The others are heard often enough by the tick of our own watch.
  if (source_ && host.greeting.host_id == source_->id) refresh();
  poll_if_due();
}

void FleetClock::on_host_down(const KnownHost& host, const Error&) {
  log_.forget(host.greeting.host_id);
  if (source_ && host.greeting.host_id == source_->id) refresh();
}

[[gnu::hot]] std::uint64_t FleetClock::clock_generation() {
  if (!watch_.may_differ()) return generation_;
  const bool is_known = watch_.state().bound != kUnknownClockError;
  if (is_known != (own_->standing.bound != kUnknownClockError)) refresh();
  return generation_;
}

// --- where this clock stands

void FleetClock::refresh() {
  const clock::Instant instant = clock::Instant::now();
  const MonoTime now = instant.mono;
  find_source(now);
  const clock::ClockState state = watch_.state();
  const wire::ClockReport before = *own_;
  look_up_addresses(now);
  update_chain(state, now);
  update_status(state);
  publish(state, instant);
  log_others(now);
  was_in_bounds_ |= is_good(own_->status);
  if (is_new_generation(before, *own_)) {
    ++generation_;
    if (on_new_generation_) on_new_generation_();
  }
  if (on_change_) on_change_();
}

const KnownHost* FleetClock::host_at(const SourceAddress& address) const {
  for (const auto& [id, host] : catalog_.hosts()) {
    if (!host.greeting.clock) continue;
    const std::vector<wire::IpBytes>& theirs = host.greeting.clock->addresses;
    if (std::find(theirs.begin(), theirs.end(), address.bytes) != theirs.end()) return &host;
  }
  return nullptr;
}

// Whom chronyd follows. One that is away is still known for as long as chronyd names its address.
void FleetClock::find_source(MonoTime now) {
  const std::optional<SourceAddress> address = watch_.source();
  if (address != source_address_) source_.reset();
  source_address_ = address;
  const KnownHost* host = address ? host_at(*address) : nullptr;
  const std::vector<wire::IpBytes>& own = own_->addresses;
  const bool is_own = address && std::find(own.begin(), own.end(), address->bytes) != own.end();
  if (host && !is_own) {
    source_ = Source{host->greeting.host_id, host->greeting.host, host->greeting.clock, {}};
    watch_.on_reference(clock::ReferenceReport{watch_.state().reference_id, source_->report->root});
  } else if (!source_) {
    watch_.on_reference(std::nullopt);
  } else if (!source_->away_since) {
    source_->away_since = now;
  }
}

bool FleetClock::is_followed() const {
  return std::any_of(catalog_.hosts().begin(), catalog_.hosts().end(), [this](const auto& entry) {
    const auto& clock = entry.second.greeting.clock;
    if (!clock || entry.first == self_) return false;
    const std::vector<clock::ClockLink>& chain = clock->standing.chain;
    return chain.size() > 1 && chain[1].clock == self_;
  });
}

void FleetClock::look_up_addresses(MonoTime now) {
  if (!own_->addresses.empty() && now - addresses_read_ < kAddressesPeriod) return;
  addresses_read_ = now;
  own_->addresses = own_addresses();
}

void FleetClock::update_chain(const clock::ClockState& state, MonoTime now) {
  clock::SyncChain& own = own_->standing;
  own_->heard = now;
  own.chain.clear();
  own.ageing = state.ageing;
  own.root_bound = state.root_bound;
  own.root_is_utc = state.basis != ClockBasis::own;
  if (state.bound != kUnknownClockError) {
    own.chain.push_back({self_, state.own_bound});
    if (source_) {
      const clock::SyncChain theirs = source_->report->at(now).standing;
      own.root_is_utc = theirs.root_is_utc;
      own.chain.push_back({source_->id, state.bound});
      for (std::size_t i = 1; i < theirs.chain.size(); ++i) {
        const clock::ClockLink& link = theirs.chain[i];
        if (own.chain.size() == clock::SyncChain::kMostLinks) break;
        if (own.distance_from(link.clock) != kUnknownClockError) break;  // a loop
        own.chain.push_back({link.clock, clock::sum(state.bound, link.bound)});
      }
    }
  }
  choose_anchor(state, now);
}

// What our samples are stamped against: the first host of the chain, as long as it is there.
void FleetClock::choose_anchor(const clock::ClockState& state, MonoTime now) {
  clock::SyncChain& own = own_->standing;
  own.bound_is_root = false;
  own.anchor = self_;
  own.bound = state.own_bound;
  if (state.bound == kUnknownClockError || state.basis == ClockBasis::own) {
    own_->basis = state.basis;
    return;
  }
  const bool is_gone =
      source_ && source_->away_since && now - *source_->away_since > kPatience && is_followed();
  if (source_ && !is_gone) {
    const clock::ClockId& theirs = source_->report->standing.anchor;
    const Duration to_theirs = own.distance_from(theirs);
    own.anchor = theirs == self_ || to_theirs == kUnknownClockError ? source_->id : theirs;
    own.bound = own.distance_from(own.anchor);
    own_->basis = ClockBasis::reference;
    return;
  }
  own_->basis = is_followed() ? ClockBasis::own : ClockBasis::root;
  if (own_->basis == ClockBasis::own) return;
  own.bound = state.root_bound;
  own.bound_is_root = true;
}

// The watch judges the distance from the source; what counts is the one from the anchor.
void FleetClock::update_status(const clock::ClockState& state) {
  own_->status = state.status;
  own_->trouble = state.trouble;
  if (state.bound != kUnknownClockError) {
    const bool is_within = own_->standing.bound <= policies_.general.limit;
    if (is_within && state.status == ClockStatus::out_of_bounds) {
      own_->status = ClockStatus::synchronized;
      own_->trouble = ClockReason::none;
    } else if (!is_within) {
      own_->status = ClockStatus::out_of_bounds;
      own_->trouble = ClockReason::too_far;
    }
  }
  own_->offset = state.offset;
  own_->stratum = state.stratum;
  own_->root = state.root;
  own_->update_interval = watch_.update_interval();
  own_->age = state.updated == MonoTime{} ? Duration{} : own_->heard - state.updated;
  own_->reference = source_           ? source_->name
                    : source_address_ ? source_address_->str()
                                      : std::string();
}

void FleetClock::publish(const clock::ClockState& state, const clock::Instant& now) {
  const Duration bound = own_->standing.bound;
  if (bound == kUnknownClockError) {
    stated_.clear();  // what was stated before a step holds for no time that is read now
  } else {
    stated_.push_back({now.wall, bound});
    while (stated_.front().wall < now.wall - kReach) stated_.pop_front();
  }
  clock::ClockRecord record;
  record.wall = now.wall;
  record.mono = now.mono;
  record.state = state;
  record.state.status = own_->status;
  record.state.trouble = own_->trouble;
  record.state.basis = own_->basis;
  record.state.bound = bound;
  record.limit = policies_.general.limit;
  record.reference = own_->reference;
  record.base = watch_.base();
  record.earlier_from = now.wall;
  for (const Stated& stated : stated_) {
    record.earlier_from = std::min(record.earlier_from, stated.wall);
    // It grew until the next one was stated.
    record.earlier_bound =
        std::max(record.earlier_bound,
                 clock::sum(stated.bound, clock::growth(clock::kLongestUse, state.ageing)));
  }
  page_.store(record);
}

// While this clock is not good, nobody's is here; the log says that of this clock.
void FleetClock::log_others(MonoTime now) {
  if (policies_.general.policy == ClockPolicy::off || !is_good(own_->status)) return;
  for (const auto& [id, host] : catalog_.hosts()) {
    if (id == self_) continue;
    log_.look(id, host.greeting.host,
              reason_against(host.greeting.clock.get(), policies_.general.limit), now);
  }
}

std::string FleetClock::str() const {
  std::string text = "clock " + std::string(name_of(own_->status));
  if (own_->trouble != ClockReason::none) text += ": " + std::string(name_of(own_->trouble));
  if (own_->standing.bound == kUnknownClockError) return text;
  text += " within " + in_microseconds(own_->standing.bound);
  switch (own_->basis) {
    case ClockBasis::nothing:
      break;
    case ClockBasis::root:
      text += " of UTC";
      break;
    case ClockBasis::reference:
      text += " of '" + own_->reference + "'";
      break;
    case ClockBasis::own:
      text += ", is the reference";
      break;
  }
  return text;
}

// --- what others' samples are worth here

Duration FleetClock::distance_to(const wire::ClockReport& other) const {
  const MonoTime now = MonoClock::now();
  return clock::distance(own_->at(now).standing, other.at(now).standing);
}

Result<void> FleetClock::check_serving(const StreamId& id, const wire::Greeting& them) const {
  if (policies_.demand_for(id).policy != ClockPolicy::enforce) return {};
  if (them.clock && clock::share_clock(own_->standing, them.clock->standing)) return {};
  // A dssmd judges for itself, once this clock was ever known; a program cannot.
  const bool is_dssmd = them.clock && !them.clock->standing.chain.empty();
  if (is_good(own_->status) || (is_dssmd && was_in_bounds_)) return {};
  return Error{Errc::clock_out_of_bounds,
               "stream '" + id.str() + "': the " + str() +
                   " on the host that has it, so the times of its samples mean nothing on other "
                   "PCs; look at `dssmctl clock` there, try again once it is synchronized, or set "
                   "its key clock_policy to \"mark\" or \"off\""};
}

ring::ClockAssessment FleetClock::assess_mirror(const StreamId& id,
                                                const wire::ClockReport* owner) const {
  if (owner && clock::share_clock(own_->standing, owner->standing)) return {};
  const MonoTime now = MonoClock::now();
  if (!owner || owner->standing.bound == kUnknownClockError) {
    return assessment(id, now, kUnknownClockError, 0);
  }
  const clock::SyncChain own = own_->at(now).standing, theirs = owner->at(now).standing;
  return assessment(id, now, clock::distance_from_anchor(theirs, own), own.ageing + theirs.ageing);
}

ring::ClockAssessment FleetClock::assess_own(const StreamId& id) const {
  const MonoTime now = MonoClock::now();
  const clock::SyncChain own = own_->at(now).standing;
  return assessment(id, now, own.bound, own.ageing);
}

// Of samples whose times may be `added` further from this clock than their clock errors say.
ring::ClockAssessment FleetClock::assessment(const StreamId& id, MonoTime now, Duration added,
                                             clock::PartsPerBillion ageing) const {
  const clock::ClockDemand demand = policies_.demand_for(id);
  ring::ClockAssessment assessment = ring::ClockAssessment::unknown_clock(demand.policy);
  assessment.assessed = now;
  if (added == kUnknownClockError) return assessment;
  assessment.added = added;
  assessment.ageing_ppb = static_cast<std::uint32_t>(ageing);
  if (added <= demand.limit) assessment.limit = demand.limit - added;
  return assessment;
}

// Why the times of that host's samples are not good here; empty: they are.
std::string FleetClock::reason_against(const wire::ClockReport* owner, Duration limit) const {
  if (!owner) return "nothing is known of its host's clock";
  if (clock::share_clock(own_->standing, owner->standing)) return {};
  if (own_->standing.bound == kUnknownClockError) return "the " + str() + " on this PC";
  if (owner->standing.bound == kUnknownClockError) {
    return "the clock of its host is " + std::string(name_of(owner->status)) + " (" +
           std::string(name_of(owner->trouble)) + ")";
  }
  const Duration distance = distance_to(*owner);
  if (distance == kUnknownClockError) {
    return "the clocks of its host and of this PC follow different references";
  }
  if (distance <= limit) return {};
  return "the clocks of its host and of this PC may be " + in_microseconds(distance) +
         " apart, and " + in_microseconds(limit) + " are allowed (key clock_limit)";
}

Error FleetClock::refusal(const StreamId& id, const wire::ClockReport* owner) const {
  const std::string trouble = reason_against(owner, policies_.demand_for(id).limit);
  const std::string why = trouble.empty() ? "its host's clock was not known just now" : trouble;
  return Error{Errc::clock_out_of_bounds,
               "stream '" + id.str() + "': " + why +
                   "; look at `dssmctl clock` and at `chronyc tracking` on both, or set the key "
                   "clock_policy to \"mark\" or \"off\""};
}

}  // namespace dssm::daemon
