// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/recorder.hpp"

#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Of sample `tid`, or of the next one that is there; empty: there is none yet.
std::optional<Time> time_from_tid(const RawReader& reader, Tid tid) {
  SampleInfo info;
  for (tid = std::max(tid, reader.oldest_tid()); tid <= reader.newest_tid(); ++tid) {
    if (reader.read_info(tid, info) == ReadStatus::ok) return info.time;
  }
  return std::nullopt;
}

// The first sample after the cursor that is there and not before `from`, or else the next one that
// is written; kNoTid: that is not known, because the network has yet to bring what is there.
Tid first_wanted(const RawReader& reader, std::optional<Time> from) {
  SampleInfo info;
  const Tid newest = reader.newest_tid();
  for (Tid tid = reader.cursor() + 1; tid <= newest; ++tid) {
    tid = std::max(tid, reader.oldest_tid());
    const ReadStatus status = reader.read_info(tid, info);
    if (status == ReadStatus::arriving) return kNoTid;
    if (status == ReadStatus::ok && (!from || info.time >= *from)) return tid;
  }
  return newest == kNoTid ? kNoTid : newest + 1;
}

// Puts the cursor before the sample of that time, unless it is beyond. To read over the samples
// before it would copy each.
void skip_to(RawReader& reader, Time time) {
  SampleInfo info;
  if (reader.find(time, info) == ReadStatus::ok && info.tid - 1 > reader.cursor()) {
    reader.seek(info.tid - 1);
  }
}

Time after(Time time) { return saturating_add(time, Duration(1)); }

}  // namespace

bool RecorderPlan::takes(const StreamInfo& stream) const {
  const auto fits = [&](const std::string& type) {
    return ::fnmatch(type.c_str(), stream.type.name.c_str(), 0) == 0;
  };
  return filter.takes(stream.id) && (types.empty() || std::ranges::any_of(types, fits));
}

// --- opening

// The time `past` before `now`, by the stamps of the stream.
Time Recorder::past_of(const Source& source, Time now, Duration past) {
  SampleInfo info;
  const bool is_known = source.reader.read_info(source.reader.newest_tid(), info) == ReadStatus::ok;
  return saturating_add(source.is_of_now || !is_known ? now : info.time, -past);
}

Recorder::Opener::Opener(Session session, RecorderPlan plan)
    : session_(std::move(session)),
      plan_(std::move(plan)),
      started_(WallClock::now()),
      unused_patterns_(plan_.filter.patterns()) {}

void Recorder::Opener::end() {
  watch_.reset();
  {
    const std::lock_guard lock(mutex_);
    if (!stop_at_) stop_at_ = deadline_in(kEndingTime);
  }
  changed_.notify_one();
  if (thread_.joinable()) thread_.join();
}

Result<void> Recorder::Opener::begin() {
  watch_ = DSSM_TRY(session_.watch([this](const StreamEvent& event) { on_event(event); }));
  {
    const std::lock_guard lock(mutex_);
    is_beginning_ = false;
  }
  thread_ = std::thread([this] { run(); });
  return {};
}

void Recorder::Opener::on_event(const StreamEvent& event) {
  const std::string name = event.stream.id.str();
  const std::lock_guard lock(mutex_);
  // It was created again. That is opened at once, and not when its reader has read the ring before
  // and follows: until then this ring may be overwritten, or be replaced, too.
  std::optional<std::uint64_t> replaced_incarnation;
  bool is_open = false;
  bool is_other_type = false;  // than its reader can continue with
  if (event.kind == StreamEvent::Kind::added && plan_.takes(event.stream)) {
    std::erase_if(unused_patterns_, [&](const std::string& pattern) {
      return fits_pattern(event.stream.id, pattern);
    });
    const auto known = known_.find(name);
    is_open = known != known_.end() && known->second.is_open;
    if (event.property_set) {
      want_property({event.stream, event.property_after, MonoClock::now()});
    } else if (is_open && !event.described && event.stream.property_bytes > 0) {
      // It was created again, or its host is there again. Its reader continues.
      const bool is_new = known->second.incarnation != event.stream.incarnation;
      want_property(
          {event.stream, is_new ? std::optional(kNoTid) : std::nullopt, MonoClock::now()});
    }
    if (known != known_.end()) {
      Known& before = known->second;
      if (before.incarnation != event.stream.incarnation) {
        replaced_incarnation = before.incarnation;
        is_other_type = is_open && !event.stream.type.check_usable_as(before.type);
      } else if (before.type.is_less_described_than(event.stream.type)) {
        before.type = event.stream.type;  // the reader continues only with such ones then
      }
    }
  }
  if (event.described) {
    described_[name] = {event.stream.incarnation, event.stream.type};
    newly_described_.push_back(event.stream.id);
  }
  const auto is_same_stream = [&](const Wanted& wanted) {
    return wanted.stream.id == event.stream.id;
  };
  std::erase_if(removed_, [&](const Removed& removed) { return removed.id == event.stream.id; });
  if (event.kind == StreamEvent::Kind::added) std::erase(gone_, event.stream.id);
  if (event.kind == StreamEvent::Kind::removed) {
    described_.erase(name);
    const bool is_opening = std::ranges::any_of(wanted_, [&](const Wanted& wanted) {
      return is_same_stream(wanted) && wanted.is_opening;  // its reader may be there soon
    });
    const auto known = known_.find(name);
    if ((known != known_.end() && known->second.is_open) || is_opening) {
      removed_.push_back({event.stream.id, deadline_in(plan_.keep_removed)});
      changed_.notify_one();
    }
    untried_ -= static_cast<std::size_t>(
        std::count_if(wanted_.begin(), wanted_.end(), [&](const Wanted& wanted) {
          return is_same_stream(wanted) && wanted.from_start && !wanted.reported;
        }));
    std::erase_if(wanted_, [&](const Wanted& wanted) {
      if (!is_same_stream(wanted)) return false;
      if (!wanted.reported && !wanted.is_opening) notice_missed(wanted.stream.id);
      return true;
    });
    return;
  }
  if (!plan_.takes(event.stream) || (is_open && !replaced_incarnation) ||
      std::any_of(wanted_.begin(), wanted_.end(), is_same_stream)) {
    return;
  }
  if (plan_.range && !is_beginning_) return;
  // One that fits since it was described was there, too.
  const bool was_there = is_beginning_ || event.described;
  untried_ += was_there;
  if (is_other_type) notice_reopening(event.stream.id, "its samples are of another type now");
  wanted_.push_back({event.stream, MonoClock::now(), was_there, false, replaced_incarnation});
  changed_.notify_one();
}

void Recorder::Opener::notice_reopening(const StreamId& id, const std::string& reason) {
  notices_.push_back(fmt::format("'{}' is opened again: {}", escaped(id.str()), reason));
}

void Recorder::Opener::notice_missed(const StreamId& id) {
  notices_.push_back(
      fmt::format("'{}' was removed, or its host lost, before it could be opened: samples that it "
                  "had by then may be missing, and do not count as lost",
                  escaped(id.str())));
}

void Recorder::Opener::want_property(SetProperty wanted) {
  std::erase_if(set_properties_,
                [&](const SetProperty& earlier) { return earlier.stream.id == wanted.stream.id; });
  set_properties_.push_back(std::move(wanted));
  changed_.notify_one();
}

void Recorder::Opener::fetch_property(std::unique_lock<std::mutex>& lock,
                                      const SetProperty& wanted) {
  lock.unlock();
  const StreamInfo& stream = wanted.stream;
  NewProperty property{stream.incarnation, wanted.after, {}, {}, {}};
  std::optional<Error> error;
  if (stream.property_bytes > 0) {
    Result<std::vector<std::byte>> bytes = session_.property(stream.id);
    if (bytes) {
      property.bytes = *std::move(bytes);
    } else {
      error = std::move(bytes).error();
    }
  }
  lock.lock();
  // One that was set meanwhile may be what dssmd has answered, for the earlier samples.
  const bool is_last = std::ranges::none_of(
      set_properties_, [&](const SetProperty& later) { return later.stream.id == stream.id; });
  if (!is_last) return;
  if (!error) {
    properties_.emplace_back(stream.id, std::move(property));
  } else if (is_retryable(error->code) && !stop_at_) {
    want_property({stream, wanted.after, deadline_in(kRetryPeriod)});
  }
}

std::vector<Recorder::Opener::Wanted>::iterator Recorder::Opener::next_wanted() {
  auto next = wanted_.end();
  for (auto wanted = wanted_.begin(); wanted != wanted_.end(); ++wanted) {
    const bool is_recorded = wanted->from_start || wanted->replaced_incarnation;
    if (stop_at_ && (!is_recorded || wanted->reported)) continue;
    if (next == wanted_.end() || wanted->due < next->due) next = wanted;
  }
  return next;
}

std::vector<StreamId> Recorder::Opener::take_removed() {
  const std::lock_guard lock(mutex_);
  return std::exchange(gone_, {});
}

// dssmd reports a stream as removed also when its host is lost. While it is, dssmd answers with
// what it knows itself; soon afterwards the host may not have the stream again yet.
void Recorder::Opener::check_removed(std::unique_lock<std::mutex>& lock, const Removed& removed) {
  bool is_missing = false;
  if (!plan_.on_demand) {
    lock.unlock();
    const Result<StreamInfo> now = session_.stream_info(removed.id);
    is_missing = !now && now.error().code == Errc::not_found;
    lock.lock();
  }
  const auto entry = std::ranges::find_if(
      removed_, [&](const Removed& one) { return one.id == removed.id && one.due == removed.due; });
  if (entry == removed_.end()) return;  // it came again meanwhile
  const bool is_taken = std::ranges::none_of(
      opened_, [&](const Source& source) { return source.reader.id() == removed.id; });
  if (is_taken && (plan_.on_demand || (is_missing && removed.is_missing))) {
    gone_.push_back(removed.id);
    if (const auto known = known_.find(removed.id.str()); known != known_.end()) {
      // Its next ring has to be told from this one. A black box, which may run for ever, does
      // without that.
      if (plan_.on_demand) {
        known_.erase(known);
      } else {
        known->second.is_open = false;
      }
    }
    removed_.erase(entry);
    return;
  }
  entry->is_missing = is_missing;
  entry->due = deadline_in(kRetryPeriod);
}

void Recorder::Opener::reopen(const RawReader& ended, const Error& error) {
  const std::lock_guard lock(mutex_);
  if (stop_at_) return;
  const StreamId& id = ended.id();
  const bool is_wanted =
      std::ranges::any_of(wanted_, [&](const Wanted& wanted) { return wanted.stream.id == id; });
  const bool is_opened =
      std::ranges::any_of(opened_, [&](const Source& source) { return source.reader.id() == id; });
  if (is_opened) return;
  known_.erase(id.str());  // `ended` is dropped: it continues with none that comes
  if (is_wanted) return;
  notice_reopening(id, error.code == Errc::type_mismatch ? "its samples are of another type now"
                                                         : escaped_message(error.message));
  Wanted wanted;
  wanted.stream.id = id;
  wanted.due = MonoClock::now();
  wanted.replaced_incarnation = ended.incarnation();
  wanted_.push_back(std::move(wanted));
  changed_.notify_one();
}

void Recorder::Opener::run() {
  std::unique_lock lock(mutex_);
  while (true) {
    const auto next = next_wanted();
    const auto property = std::ranges::min_element(set_properties_, {}, &SetProperty::due);
    const auto removed = std::ranges::min_element(removed_, {}, &Removed::due);
    const bool is_stream = next != wanted_.end();
    const bool is_property =
        property != set_properties_.end() && (!stop_at_ || property->due <= *stop_at_);
    const bool is_removed = removed != removed_.end() && !stop_at_;
    if (stop_at_ && ((!is_stream && !is_property) || MonoClock::now() >= *stop_at_)) return;
    if (!is_stream && !is_property && !is_removed) {
      changed_.wait(lock);
      continue;
    }
    const MonoTime due = std::min({is_stream ? next->due : MonoTime::max(),
                                   is_property ? property->due : MonoTime::max(),
                                   is_removed ? removed->due : MonoTime::max()});
    if (due > MonoClock::now()) {
      changed_.wait_until(lock, due);
      continue;
    }
    if (is_property && property->due == due) {
      const SetProperty wanted_property = std::move(*property);
      set_properties_.erase(property);
      fetch_property(lock, wanted_property);
      continue;
    }
    if (is_removed && removed->due == due) {
      const Removed checked = *removed;
      check_removed(lock, checked);
      continue;
    }
    next->is_opening = true;
    const Wanted wanted = *next;
    lock.unlock();
    Result<Source> opened = open(wanted);
    lock.lock();
    // It may have been removed meanwhile, and created again.
    auto entry = std::find_if(wanted_.begin(), wanted_.end(), [&](const Wanted& other) {
      return other.stream.id == wanted.stream.id;
    });
    const std::uint64_t incarnation = wanted.stream.incarnation;  // 0: not known
    if (entry != wanted_.end() && entry->stream.incarnation != incarnation) {
      const bool is_opened = opened && opened->reader.incarnation() == entry->stream.incarnation;
      if (!is_opened) {  // that one has its turn
        if (opened) entry->replaced_incarnation = opened->reader.incarnation();
        entry = wanted_.end();
      }
    }
    // The network has yet to bring what the ring before this one had.
    if (opened && entry != wanted_.end() && incarnation != 0 &&
        opened->reader.incarnation() == entry->replaced_incarnation) {
      entry->is_opening = false;
      if (entry->late_at == MonoTime()) entry->late_at = deadline_in(kReopenTime);
      const bool is_late = MonoClock::now() >= entry->late_at;
      entry->due = deadline_in(is_late ? kRetryPeriod : kReopenPeriod);
      if (!is_late || entry->reported) continue;
      notices_.push_back(
          fmt::format("'{}' is not recorded yet: it was created again, and this PC still has its "
                      "earlier ring; see `dssmctl info {}`",
                      escaped(wanted.stream.id.str()), escaped(wanted.stream.id.str())));
      if (entry->from_start) --untried_;
      entry->reported = true;
      continue;
    }
    const bool is_wanted = entry != wanted_.end();
    if (is_wanted && entry->from_start && !entry->reported) --untried_;
    const bool is_missed =
        incarnation != 0 && (opened ? opened->reader.incarnation() != incarnation : !is_wanted);
    if (is_missed && !wanted.reported) notice_missed(wanted.stream.id);
    if (opened) {  // the reader has the samples of its ring, and follows a new one of its type
      const RawReader& reader = opened->reader;
      known_[wanted.stream.id.str()] = {reader.incarnation(), reader.type()};
      if (is_wanted) wanted_.erase(entry);
      opened_.push_back(*std::move(opened));
      continue;
    }
    if (!is_wanted) continue;
    entry->is_opening = false;
    const Error& error = opened.error();
    // One that was recorded may be read again after the next reload of dssmd's configuration.
    const bool is_to_retry = is_retryable(error.code) ||
                             (wanted.replaced_incarnation && error.code == Errc::no_permission);
    if (!wanted.reported) {
      notices_.push_back(fmt::format("'{}' is not recorded{}: {}", escaped(wanted.stream.id.str()),
                                     is_to_retry ? " yet" : "", escaped_message(error.message)));
    }
    entry->reported = true;
    entry->due = deadline_in(kRetryPeriod);
    if (!is_to_retry) wanted_.erase(entry);
  }
}

Result<Recorder::Source> Recorder::Opener::open(const Wanted& wanted) const {
  // A stream that comes later is new, or its host is: all of it is wanted.
  const bool with_history = plan_.past || plan_.range || plan_.on_demand || !wanted.from_start;
  Session session = session_;
  // Before there is a reader: what is set from then on is reported, with the sample. Empty when
  // there is none, or its host does not answer.
  Result<std::vector<std::byte>> property = session.property(wanted.stream.id);
  RawReader reader = DSSM_TRY(
      session.open_raw_reader(wanted.stream.id, nullptr, 0,
                              with_history ? FetchHistory::at_once : FetchHistory::when_read));
  Source source{std::move(reader)};
  source.is_property_known = property.has_value();
  if (property) source.property = *std::move(property);
  const Tid newest = source.reader.newest_tid();
  Tid newest_there = newest;  // at its owner: on a slow network no sample may be here yet
  const StreamInfo& then = wanted.stream;  // as dssmd reported it
  const std::uint64_t incarnation = source.reader.incarnation();
  // The stamps of a recording that is being played are of another time than now. What lists say of
  // another host's stream is without its state.
  if (then.state == StreamState::unknown) {
    const Result<StreamInfo> now = session.stream_info(then.id);
    source.is_of_now = !now || now->state != StreamState::unknown;
    if (now && now->incarnation == incarnation) newest_there = std::max(newest, now->newest);
  }
  const bool is_known = then.incarnation == incarnation &&
                        (then.newest != kNoTid || then.state == StreamState::empty);
  if (!with_history) {
    // What was written since the recording began, if dssmd said what was there then.
    const Tid before = is_known ? std::min(then.newest, newest_there) : newest_there;
    source.reader.seek(before);
    source.next = before + 1;
  } else {
    source.reader.seek(kNoTid);
    source.past_until = newest;
    if (plan_.past && wanted.from_start) source.from = past_of(source, started_, *plan_.past);
    if (plan_.range) {
      source.from = plan_.range->first;
      source.until = plan_.range->last;
      SampleInfo info;
      if (source.reader.find(*source.until, info) == ReadStatus::ok) source.last_wanted = info.tid;
    }
    if (source.from) skip_to(source.reader, *source.from);
    // What is there now counts, also if it is overwritten before it is read; of a new ring all.
    const bool was_empty = is_known && then.newest == kNoTid;
    const bool is_again = wanted.replaced_incarnation.value_or(incarnation) != incarnation;
    source.next = was_empty || is_again ? source.reader.cursor() + 1
                                        : first_wanted(source.reader, source.from);
  }
  return source;
}

std::vector<Recorder::Source> Recorder::Opener::take_opened() {
  const std::lock_guard lock(mutex_);
  return std::exchange(opened_, {});
}

std::vector<std::pair<StreamId, Recorder::NewProperty>> Recorder::Opener::take_properties() {
  const std::lock_guard lock(mutex_);
  return std::exchange(properties_, {});
}

std::optional<TypeInfo> Recorder::Opener::described(const StreamId& id,
                                                    std::uint64_t incarnation) const {
  const std::lock_guard lock(mutex_);
  const auto found = described_.find(id.str());
  if (found == described_.end() || found->second.first != incarnation) return std::nullopt;
  return found->second.second;
}

std::vector<StreamId> Recorder::Opener::take_described() {
  const std::lock_guard lock(mutex_);
  return std::exchange(newly_described_, {});
}

std::vector<std::string> Recorder::Opener::take_notices() {
  const std::lock_guard lock(mutex_);
  return std::exchange(notices_, {});
}

bool Recorder::Opener::has_tried_all() const {
  const std::lock_guard lock(mutex_);
  return untried_ == 0 && opened_.empty();
}

std::vector<std::string> Recorder::Opener::unused_patterns() const {
  const std::lock_guard lock(mutex_);
  return unused_patterns_;
}

// --- recording

Result<std::unique_ptr<Recorder>> Recorder::start(Session session,
                                                  std::optional<RecordingWriter> file,
                                                  const RecorderPlan& plan) {
  const MonoTime all_by = plan.past || plan.range ? deadline_in(kOpeningTime) : MonoTime();
  std::unique_ptr<Recorder> recorder(new Recorder(std::move(session), std::move(file), plan));
  recorder->all_by_ = all_by;
  DSSM_TRY(recorder->opener_.begin());
  return recorder;
}

Result<void> Recorder::begin(RecordingWriter file, Duration before) {
  file_ = std::move(file);
  is_recording_ = true;
  kept_.clear();
  numbers_.clear();
  for (Source& source : sources_) source.number = UINT32_MAX;  // also if the file takes not all
  newest_time_ = Time::min();
  wanted_from_ = WallClock::now();
  before_ = before;
  past_moved_ = MonoClock::now();
  period_ = kMinPeriod;
  for (Source& source : sources_) {
    want_past(source, false);
    if (Result<void> added = add_to_file(source); !added) {
      is_recording_ = false;
      return added;
    }
  }
  return {};
}

// Of what its ring holds, the samples from wanted_from_ on that no file has.
void Recorder::want_past(Source& source, bool is_new) const {
  RawReader& reader = source.reader;
  source.from = past_of(source, wanted_from_, before_);
  skip_to(reader, *source.from);
  // An earlier file has these, if the stream was opened again since.
  const auto found = recorded_.find(reader.id().str());
  if (found != recorded_.end() && found->second.first == reader.incarnation() &&
      found->second.second > reader.cursor()) {
    reader.seek(found->second.second);
  }
  const Tid newest = reader.newest_tid();
  source.past_until = newest > reader.cursor() ? newest : kNoTid;
  source.next = is_new ? reader.cursor() + 1 : first_wanted(reader, source.from);
}

Result<void> Recorder::end() {
  Result<void> completed = complete();
  for (const Source& source : sources_) remember(source);
  is_recording_ = false;
  return completed;
}

Result<void> Recorder::take() { return take_until(WallClock::now() - kHeldFor); }

Result<void> Recorder::take_until(Time held_from) {
  auto properties = opener_.take_properties();
  // All, also when the file cannot take them, because its disk is full: the next file will.
  Result<void> added;
  for (Source& opened : opener_.take_opened()) {
    if (Result<void> one = add(std::move(opened)); !one && added) added = std::move(one);
  }
  for (auto& [id, property] : properties) add_property(id, std::move(property));
  DSSM_TRY(std::move(added));
  if (!is_recording_) {
    (void)opener_.take_described();  // begin() asks for the descriptions of all
    check_readers();
    next_take_ = deadline_in(kMaxPeriod);
    return {};
  }
  if (!opener_.has_tried_all() && MonoClock::now() < all_by_) {
    next_take_ = deadline_in(kMinPeriod);
    return {};
  }
  for (const StreamId& id : opener_.take_described()) DSSM_TRY(describe(id));
  filled_ = 0;
  std::optional<Time> until;
  for (const Source& source : sources_) {
    const std::optional<Time> time = is_of_past(source) ? next_time(source) : std::nullopt;
    if (time && (!until || *time < *until)) until = time;
  }
  if (until) until = saturating_add(*until, kPastPart);
  is_more_ = false;
  DSSM_TRY(take_in_order(until, held_from));
  check_readers();
  end_sources();
  for (Source& source : sources_) DSSM_TRY(write_properties(source, source.is_over));
  drop_ended();
  next_take_ = is_more_ ? MonoClock::now() : deadline_in(next_period());
  return {};
}

// Programs give a cycle that is far from the real one, so how much was new counts, too: quickly to
// a shorter period, slowly to a longer one.
Duration Recorder::next_period() {
  const double factor = filled_ > 0 ? std::min(kFilled / filled_, kGrowth) : kGrowth;
  Duration limit = kMaxPeriod;
  for (const Source& source : sources_) {
    const Duration life =
        static_cast<std::int64_t>(source.reader.depth() - 1) * source.reader.cycle();
    if (life > Duration::zero()) {
      limit = std::min(limit, std::chrono::duration_cast<Duration>(kFilled * life));
    }
  }
  period_ = std::clamp(std::chrono::duration_cast<Duration>(factor * period_), kMinPeriod,
                       std::max(limit, kMinPeriod));
  return period_;
}

Result<void> Recorder::add(Source source) {
  period_ = kMinPeriod;  // how quickly its ring fills is not known yet
  // The reader of an earlier source may have gone there by itself, or its stream was removed, and
  // has come again with what it had.
  const auto same = std::ranges::find_if(
      sources_, [&](const Source& earlier) { return have_same_ring(earlier, source); });
  if (same != sources_.end()) {
    if (std::exchange(same->is_removed, false) && source.is_property_known) {
      add_property(source.reader.id(),
                   {source.reader.incarnation(), {}, std::move(source.property), {}, {}});
    }
    return {};
  }
  Source& added = sources_.emplace_back(std::move(source));
  if (!is_recording_) return {};
  if (is_on_demand_) want_past(added, added.next == 0);
  return add_to_file(added);
}

Result<void> Recorder::add_to_file(Source& source) {
  const RawReader& reader = source.reader;
  // It may have been described since it was opened.
  TypeInfo type = opener_.described(reader.id(), reader.incarnation()).value_or(reader.type());
  if (type.fields.empty()) {
    const auto found = types_of_programs_.find({reader.id().str(), reader.incarnation()});
    if (found != types_of_programs_.end()) type = found->second;
  }
  source.number = DSSM_TRY(file_->add_stream(
      {reader.id(), type, reader.depth(), reader.cycle(), reader.incarnation(), source.property}));
  numbers_[reader.id().str()] = source.number;
  // What is not wanted of it now is not later, either.
  if (source.number == kept_.size()) {
    kept_.push_back({reader.incarnation(), source.next - 1, source.property});
  }
  // It was recorded before, and could not be read for a while.
  const Kept& kept = kept_[source.number];
  if (kept.newest > reader.cursor()) {
    source.reader.seek(kept.newest);
    source.next = kept.newest + 1;
  }
  // It has another property since.
  if (source.property != kept.property) {
    std::vector<std::byte> now = std::exchange(source.property, kept.property);
    if (source.is_property_known) {
      add_property(reader.id(), {reader.incarnation(), {}, std::move(now), {}, {}});
    }
  }
  return {};
}

Result<void> Recorder::describe(const StreamId& id) {
  for (Source& source : sources_) {
    if (source.reader.id() == id) DSSM_TRY(add_to_file(source));
  }
  return {};
}

void Recorder::add_property(const StreamId& id, NewProperty property) {
  // The one with that ring, else the last one, which may have yet to follow to it.
  Source* source = nullptr;
  for (Source& one : sources_) {
    if (one.reader.id() != id) continue;
    source = &one;
    if (one.reader.incarnation() == property.incarnation) break;
  }
  if (source == nullptr) return;
  if (!property.after) {
    const bool is_here = property.incarnation == source->reader.incarnation();
    property.after = is_here ? source->reader.newest_tid() : kNoTid;
  }
  if (source->is_of_now) property.newest_time = newest_time_;
  property.came = MonoClock::now();
  std::vector<NewProperty>& all = source->new_properties;
  // Its ring has been replaced since.
  std::erase_if(all, [&](const NewProperty& earlier) {
    return earlier.incarnation != property.incarnation &&
           earlier.incarnation != source->reader.incarnation();
  });
  // Set again before there was another sample: the last one counts.
  const bool is_same_place = !all.empty() && all.back().incarnation == property.incarnation &&
                             all.back().after == property.after;
  if (is_same_place) all.pop_back();
  all.push_back(std::move(property));
}

Result<void> Recorder::write_properties(Source& source, bool all) {
  const RawReader& reader = source.reader;
  std::vector<NewProperty>& properties = source.new_properties;
  while (!properties.empty()) {
    NewProperty& next = properties.front();
    if (next.incarnation != reader.incarnation()) {
      // The reader has yet to follow to that ring, or has left it.
      const bool is_old = std::ranges::any_of(properties, [&](const NewProperty& later) {
        return later.incarnation == reader.incarnation();
      });
      if (!is_old) break;
      properties.erase(properties.begin());
      continue;
    }
    Time from = Time::min();
    if (*next.after != kNoTid) {
      const std::optional<Time> first = time_from_tid(reader, *next.after + 1);
      if (!first && !all && MonoClock::now() - next.came < kPropertyWait) break;
      const std::optional<Time> last = time_from_tid(reader, reader.newest_tid());
      from = first ? *first : std::max(next.newest_time, last ? after(*last) : Time::min());
    }
    if (next.bytes != source.property) {
      DSSM_TRY(file_->set_property(source.number, next.bytes, from));
      kept_[source.number].property = next.bytes;
      source.property = std::move(next.bytes);
    }
    properties.erase(properties.begin());
  }
  return {};
}

std::optional<Time> Recorder::next_time(const Source& source) {
  SampleInfo info;
  const RawReader& reader = source.reader;
  Tid next = std::max(reader.cursor() + 1, reader.oldest_tid());
  ReadStatus status = reader.read_info(next, info);
  // Reads skip those that the network did not carry.
  for (const Tid newest = reader.newest_tid(); status == ReadStatus::lost && next < newest;) {
    status = reader.read_info(++next, info);
  }
  if (status != ReadStatus::ok) return std::nullopt;
  return info.time;
}

// A reader opens the new ring of a stream that restarted when it reads, which nothing else does
// while there is no file.
void Recorder::follow_restart(Source& source) {
  RawReader& reader = source.reader;
  const Tid cursor = reader.cursor();
  BorrowedSample newest;
  if (reader.borrow(reader.newest_tid(), newest) == ReadStatus::restarted) {
    on_restarted(source);
  } else {
    reader.seek(cursor);
  }
}

void Recorder::on_restarted(Source& source) {
  source.is_removed = false;
  source.property.clear();  // dssmd reports the one that it has
  source.is_over = is_duplicate(source);
  if (source.is_over) source.new_properties.clear();  // the other one has them
}

bool Recorder::have_same_ring(const Source& a, const Source& b) {
  return a.reader.id() == b.reader.id() && a.reader.incarnation() == b.reader.incarnation();
}

bool Recorder::is_duplicate(const Source& source) const {
  return std::ranges::any_of(sources_, [&](const Source& other) {
    return &other != &source && have_same_ring(other, source);
  });
}

void Recorder::end_sources() {
  for (Source& source : sources_) {
    const std::optional<Error> error = source.reader.restart_error();
    if (!error) continue;
    source.is_over = true;
    const bool is_followed = std::ranges::any_of(sources_, [&](const Source& other) {
      return other.reader.id() == source.reader.id() && !other.is_over &&
             !other.reader.restart_error();
    });
    if (!is_followed) opener_.reopen(source.reader, *error);
  }
}

void Recorder::remember(const Source& source) {
  if (!is_on_demand_ || source.number >= kept_.size()) return;
  const std::pair now(source.reader.incarnation(), kept_[source.number].newest);
  if (kept_[source.number].incarnation != now.first) return;  // it has left that ring since
  auto& before = recorded_[source.reader.id().str()];
  if (before.first != now.first || before.second < now.second) before = now;
}

void Recorder::drop_ended() {
  for (const Source& source : sources_) {
    if (!source.is_over) continue;
    remember(source);
    if (source.is_removed) recorded_.erase(source.reader.id().str());
  }
  std::erase_if(sources_, [](const Source& source) { return source.is_over; });
}

// Those that all samples in the ring have are the past of it.
void Recorder::forget_properties(Source& source) {
  std::vector<NewProperty>& properties = source.new_properties;
  while (!properties.empty() && properties.front().incarnation == source.reader.incarnation() &&
         (*properties.front().after < source.reader.oldest_tid() ||
          properties.size() > kMaxKeptProperties)) {
    source.property = std::move(properties.front().bytes);
    properties.erase(properties.begin());
  }
}

void Recorder::check_readers() {
  const MonoTime now = MonoClock::now();
  if (now < next_check_) return;
  next_check_ = now + kCheckPeriod;
  // Their rings would take memory for ever.
  for (const StreamId& removed : opener_.take_removed()) {
    for (Source& source : sources_) source.is_removed |= source.reader.id() == removed;
  }
  for (Source& source : sources_) source.is_over |= source.is_removed && is_taken(source);
  if (is_recording_) return;  // take() drops them
  for (Source& source : sources_) {
    if (source.is_over) continue;
    follow_restart(source);
    forget_properties(source);
  }
  end_sources();
  drop_ended();
}

bool Recorder::is_taken(const Source& source) const {
  return !is_recording_ || source.reader.cursor() >= source.reader.newest_tid();
}

Result<void> Recorder::take_in_order(std::optional<Time> past_until, Time held_from) {
  constexpr auto kLaterLast = [](const Turn& a, const Turn& b) { return a.next > b.next; };
  turns_.clear();
  for (Source& source : sources_) {
    turns_.push_back({&source, next_time(source).value_or(Time::max())});
  }
  std::ranges::make_heap(turns_, kLaterLast);
  while (!turns_.empty()) {
    std::ranges::pop_heap(turns_, kLaterLast);
    Turn& turn = turns_.back();
    Source& source = *turn.source;
    if (turn.next == Time::max()) turn.next = next_time(source).value_or(Time::max());
    const bool is_known = turn.next != Time::max();
    const bool is_later = is_known && past_until && is_of_past(source) && turn.next > *past_until;
    const bool is_much = turn.bytes >= kTurnBytes;
    if (is_later || is_much) is_more_ = true;
    const bool must_wait = is_later || is_much || (is_known && is_held(turn, held_from));
    if (!must_wait && DSSM_TRY(take_next(turn))) {
      turn.next = next_time(source).value_or(Time::max());
      std::ranges::push_heap(turns_, kLaterLast);
      continue;
    }
    const auto slots = static_cast<double>(source.reader.depth() - 1);
    filled_ = std::max(filled_, static_cast<double>(turn.samples) / slots);
    turns_.pop_back();
  }
  return {};
}

// Samples do not wait if they take too much of their ring, or if their times are not of now.
bool Recorder::is_held(const Turn& turn, Time held_from) {
  if (turn.next <= held_from || turn.next - held_from > 2 * kHeldFor) return false;
  const RawReader& reader = turn.source->reader;
  const auto waiting = static_cast<double>(reader.newest_tid() - reader.cursor());
  return waiting <= kMaxHeld * static_cast<double>(reader.depth() - 1);
}

Result<bool> Recorder::take_next(Turn& turn) {
  Source& source = *turn.source;
  payload_.resize(source.reader.payload_bytes());
  SampleInfo info;
  const ReadStatus status = source.reader.read_next(payload_, info);
  if (status == ReadStatus::restarted) {
    on_restarted(source);
    if (source.is_over) return false;
    source.next = 0;
    DSSM_TRY(add_to_file(source));
    source.past_until = source.last_wanted = kNoTid;
    source.from.reset();
    return true;
  }
  if (status != ReadStatus::ok) return false;
  turn.bytes += payload_.size();
  ++turn.samples;
  if ((source.from && info.time < *source.from) || (source.until && info.time > *source.until)) {
    if (source.next != kNoTid) {
      DSSM_TRY(add_gap(source, std::min(info.tid, source.last_wanted + 1)));
    }
    source.next = info.tid + 1;
    return true;
  }
  DSSM_TRY(write(source, info));
  return true;
}

// Those that were wanted and not read, before sample `end`.
Result<void> Recorder::add_gap(const Source& source, Tid end) {
  if (end <= source.next) return {};
  return file_->add_gap(source.number, source.next, static_cast<std::uint64_t>(end - source.next));
}

Result<void> Recorder::write(Source& source, const SampleInfo& info) {
  if (source.next != kNoTid) DSSM_TRY(add_gap(source, info.tid));
  source.next = info.tid + 1;
  DSSM_TRY(file_->write(source.number, info, source.reader.clock_error(info),
                        std::span(payload_).first(info.payload_bytes)));
  kept_[source.number].newest = info.tid;
  newest_time_ = std::max(newest_time_, info.time);
  return {};
}

bool Recorder::is_past_late() {
  std::uint64_t progress = sources_.size();
  for (const Source& source : sources_) {
    progress += static_cast<std::uint64_t>(std::min(source.next, source.past_until + 1) + 1);
  }
  const MonoTime now = MonoClock::now();
  if (std::exchange(past_progress_, progress) != progress) past_moved_ = now;
  return now - past_moved_ >= kMaxPastWait;
}

bool Recorder::has_past() const {
  const auto has_its_past = [](const Source& source) {
    if (source.next > source.past_until) return true;
    SampleInfo info;
    const ReadStatus status = source.reader.read_info(source.past_until, info);
    return status == ReadStatus::lost || status == ReadStatus::too_old;
  };
  return opener_.has_tried_all() && std::all_of(sources_.begin(), sources_.end(), has_its_past);
}

std::vector<std::string> Recorder::streams_without_fields() const {
  std::vector<std::string> names;
  for (const auto& [name, number] : numbers_) {
    if (!file_->has_fields(number)) names.push_back(name);
  }
  return names;
}

std::vector<std::string> Recorder::take_notices() { return opener_.take_notices(); }

Result<void> Recorder::complete() {
  const MonoTime end = deadline_in(kEndingTime);
  Result<void> taken;
  do {
    taken = take_until(Time::max());
  } while (taken && is_more_ && MonoClock::now() < end);  // writers may be faster
  // One that was set just now is not reported yet.
  for (Source& source : sources_) {
    if (!taken) break;
    const RawReader& reader = source.reader;
    // A host that is lost must not keep the next file waiting.
    if (!is_on_demand_ || MonoClock::now() < end) {
      if (Result<std::vector<std::byte>> property = reader.property()) {
        source.new_properties.push_back({reader.incarnation(),
                                         reader.newest_tid(),
                                         *std::move(property),
                                         source.is_of_now ? newest_time_ : Time::min(),
                                         {}});
      }
    }
    taken = write_properties(source, true);
  }
  Result<void> finished = file_->finish();
  return taken ? finished : taken;
}

Result<void> Recorder::finish() {
  opener_.end();  // what is just being opened is taken, too
  all_by_ = {};
  return complete();
}

}  // namespace dssm::ctl
