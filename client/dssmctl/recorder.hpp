// SPDX-License-Identifier: Apache-2.0
//
// From live streams into a recording. It reads rings as every reader does, so that no writer waits
// for it: what a ring overwrites before it was taken is a gap in the recording, with its tids.
//
// The rings are looked at so often that none of them is filled more than by a part in between:
// which costs less than a wake-up for each sample, and a recording is in no hurry. Streams are
// opened and their properties asked for by a thread of its own, so that a host that does not answer
// costs no samples of the others. dssmd reports that a property was set, with the tid of the newest
// sample then: so the recording has it from the right sample on, whichever it reads first.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "client/dssmctl/names.hpp"

namespace dssm::ctl {

// What to record, of all streams there are or will be.
struct RecorderPlan {
  StreamFilter filter;
  std::vector<std::string> types;  // shell patterns, one of which its type's name fits; empty: all
  bool takes(const StreamInfo& stream) const;  // by filter and types
  // From so long before now: what the rings hold still. Empty: from now on.
  std::optional<Duration> past;
  // Instead of `past`: samples of these times only, first and last included, by their stamps.
  struct Range {
    Time first, last;
  };
  std::optional<Range> range;
  // Nothing is recorded before begin(); until then streams are only kept open, with what their
  // rings hold, also of other hosts.
  bool on_demand = false;
  // Streams that were removed stay open for about so long. On demand, also those that left with
  // their host, and it is not less than what begin() is to have of the past. Otherwise these stay
  // open, and their readers continue when the host is there again.
  Duration keep_removed = std::chrono::seconds(3);
  // Of streams that are not described: their types in the programs' debug information, by name and
  // incarnation.
  std::map<std::pair<std::string, std::uint64_t>, TypeInfo> types_of_programs = {};
};

class Recorder {
 public:
  // `session` is used by a thread until the recorder is destroyed.
  //   file  empty if and only if `plan.on_demand`
  static Result<std::unique_ptr<Recorder>> start(Session session,
                                                 std::optional<RecordingWriter> file,
                                                 const RecorderPlan& plan);
  Recorder(const Recorder&) = delete;
  Recorder& operator=(const Recorder&) = delete;
  ~Recorder() = default;

  // On demand: from now on records in `file`, first what the rings hold of so long before now and
  // the file before has not.
  //   fails  as RecordingWriter::add_stream(); then there is no file
  Result<void> begin(RecordingWriter file, Duration before);
  // Completes that file, with what has come until now, or after a failure with what it has. Streams
  // stay open for the next one.
  //   fails  as RecordingWriter::finish()
  Result<void> end();
  bool is_recording() const { return is_recording_; }

  // Records what has come since the last call.
  //   fails  as RecordingWriter::write(); what was recorded before stays
  Result<void> take();

  // What the file has.
  Result<void> add_trigger(const RecordedTrigger& trigger) { return file_->add_trigger(trigger); }

  // When take() is to be called again.
  MonoTime next_take() const { return next_take_; }

  // Whether there is nothing more of the past to come, of the plan or of begin(): all streams that
  // there were are recorded up to their newest sample of then, or could not be opened.
  bool has_past() const;
  // Whether nothing of it came for so long that another host must be slow or silent.
  bool is_past_late();

  // That the file has, also those that were removed since.
  std::size_t streams() const { return numbers_.size(); }
  // The plan's patterns that no stream has fitted; "*" if it has none, and no stream was wanted.
  std::vector<std::string> unused_patterns() const { return opener_.unused_patterns(); }
  // Those of which the file has only bytes: they were not described.
  std::vector<std::string> streams_without_fields() const;
  // Of the file, or of the last one; there was one.
  RecordingProgress progress() const { return file_->progress(); }
  // Why streams are not recorded, for people; each only once.
  std::vector<std::string> take_notices();

  // Takes the last samples and properties, and completes the file.
  //   fails  as RecordingWriter::finish()
  Result<void> finish();

 private:
  // How far the rings may fill between two calls of take(), and how often it is called at least and
  // at most.
  static constexpr double kFilled = 0.25;
  static constexpr double kGrowth = 1.25;
  static constexpr Duration kMinPeriod = std::chrono::milliseconds(1);
  static constexpr Duration kMaxPeriod = std::chrono::milliseconds(50);
  static constexpr Duration kRetryPeriod = std::chrono::seconds(1);
  // A ring that is to be replaced is opened again each kReopenPeriod, after kReopenTime each
  // kRetryPeriod.
  static constexpr Duration kReopenPeriod = std::chrono::milliseconds(50);
  static constexpr Duration kReopenTime = std::chrono::seconds(2);
  static constexpr Duration kEndingTime = std::chrono::seconds(1);
  // So long the past waits for streams to be opened.
  static constexpr Duration kOpeningTime = std::chrono::seconds(1);
  // Another host that sends nothing more is not waited for longer than that.
  static constexpr Duration kMaxPastWait = std::chrono::seconds(10);
  static constexpr Duration kCheckPeriod = std::chrono::seconds(1);  // of readers
  // The past is recorded in parts of this length, each of all streams, so that the recording is
  // about in the order of times.
  static constexpr Duration kPastPart = std::chrono::milliseconds(100);
  // So long a sample waits in its ring, because one with an earlier time may still come: a sensor
  // needs time to measure, and the network to send. So the recording is in the order of times.
  static constexpr Duration kHeldFor = std::chrono::milliseconds(100);
  // The part of a ring that samples which wait may take.
  static constexpr double kMaxHeld = 0.1;
  // What one stream may have taken before the others have their turn.
  static constexpr std::uint64_t kTurnBytes = 4U << 20;
  // So long a property waits for its first sample, whose time is its own in the file.
  static constexpr Duration kPropertyWait = std::chrono::seconds(1);
  // Of one stream, while there is no file.
  static constexpr std::size_t kMaxKeptProperties = 64;

  // What a stream got as its property while it was open.
  struct NewProperty {
    std::uint64_t incarnation = 0;
    // The newest sample when it was set; kNoTid: there was none. Empty: that is not known.
    std::optional<Tid> after;
    std::vector<std::byte> bytes;    // none: it has none any more
    Time newest_time = Time::min();  // of all samples in the file when it came here
    MonoTime came{};
  };

  // A stream that is recorded.
  struct Source {
    RawReader reader;
    std::uint32_t number = UINT32_MAX;  // in the file; UINT32_MAX: in none
    Tid next = kNoTid;  // what was before it is recorded, or known as lost; kNoTid: not known yet
    Tid past_until = kNoTid;          // the newest at its opening, if history is wanted
    std::optional<Time> from, until;  // samples before and after these are not wanted
    Tid last_wanted = kNoTid;         // with `until`: of those that there were when it was opened
    bool is_of_now = true;            // its stamps are of this time, and not of one that is played
    std::vector<std::byte> property;  // that the file has, or gets at its beginning
    bool is_property_known = false;   // its host has answered when it was opened
    std::vector<NewProperty> new_properties;  // the file has not yet
    // Its reader cannot continue, or another source has the ring that it would continue with.
    bool is_over = false;
    bool is_removed = false;  // the stream; it ends when what its ring still has is taken
  };
  static Time past_of(const Source& source, Time now, Duration past);

  // Opens streams and fetches properties. What the thread and take() share is behind a lock.
  class Opener {
   public:
    Opener(Session session, RecorderPlan plan);
    Opener(const Opener&) = delete;
    Opener& operator=(const Opener&) = delete;
    ~Opener() { end(); }

    // All that exists, then all that comes.
    Result<void> begin();
    // Opens nothing more, but those that there were at begin() or that have another type now, for a
    // second at most; waits for that.
    void end();
    // Streams that were removed, since the last call; they are opened again if they come again.
    std::vector<StreamId> take_removed();
    // Opens it again, unless that is being done: `ended` cannot continue, because of `error`.
    void reopen(const RawReader& ended, const Error& error);

    std::vector<Source> take_opened();
    // To be called before take_opened(), which then has their streams.
    std::vector<std::pair<StreamId, NewProperty>> take_properties();
    // The stream's type, if it was described since begin().
    std::optional<TypeInfo> described(const StreamId& id, std::uint64_t incarnation) const;
    // The streams that were described since the last call. To be called after take_opened().
    std::vector<StreamId> take_described();
    std::vector<std::string> take_notices();
    bool has_tried_all() const;  // of the streams that there were at begin()
    std::vector<std::string> unused_patterns() const;

   private:
    struct Wanted {
      StreamInfo stream;
      MonoTime due{};
      bool from_start = false;  // it was there at begin()
      bool reported = false;
      // The incarnation before, which was opened: all samples of this one are wanted.
      std::optional<std::uint64_t> replaced_incarnation = {};
      bool is_opening = false;
      MonoTime late_at{};  // when to say that there is still the ring before
    };
    // Of a name: the incarnation that was opened last, and the type that the next one needs so that
    // its reader can continue with it.
    struct Known {
      std::uint64_t incarnation = 0;
      TypeInfo type;
      bool is_open = true;  // false: it was removed
    };
    // A stream that was removed, as dssmd has reported.
    struct Removed {
      StreamId id;
      MonoTime due{};           // when to look whether it still is
      bool is_missing = false;  // at the last look its host had no such stream
    };
    // A property to be fetched, of a stream as the event describes it.
    struct SetProperty {
      StreamInfo stream;
      std::optional<Tid> after;  // as in NewProperty
      MonoTime due{};
    };
    void want_property(SetProperty wanted);
    void fetch_property(std::unique_lock<std::mutex>& lock, const SetProperty& wanted);
    void check_removed(std::unique_lock<std::mutex>& lock, const Removed& removed);
    // The one to try next; the end: none.
    std::vector<Wanted>::iterator next_wanted();
    void notice_reopening(const StreamId& id, const std::string& reason);
    void notice_missed(const StreamId& id);
    void on_event(const StreamEvent& event);
    void run();
    Result<Source> open(const Wanted& wanted) const;

    Session session_;
    RecorderPlan plan_;
    Time started_{};

    mutable std::mutex mutex_;
    std::condition_variable changed_;
    bool is_beginning_ = true;  // begin() runs: what comes is there already
    std::vector<std::string> unused_patterns_;
    std::vector<Wanted> wanted_;
    std::map<std::string, Known> known_;  // by name; on demand only those that are open
    std::vector<Removed> removed_;
    std::vector<StreamId> gone_;  // for take_removed()
    std::size_t untried_ = 0;
    std::vector<Source> opened_;
    std::vector<SetProperty> set_properties_;                   // the last change of each stream
    std::vector<std::pair<StreamId, NewProperty>> properties_;  // fetched
    // Incarnations and types, by the streams' names.
    std::map<std::string, std::pair<std::uint64_t, TypeInfo>> described_;
    std::vector<StreamId> newly_described_;
    std::vector<std::string> notices_;
    std::optional<MonoTime> stop_at_;

    std::thread thread_;
    std::optional<Session::Watch> watch_;  // the first to end: it calls on_event()
  };

  Recorder(Session session, std::optional<RecordingWriter> file, const RecorderPlan& plan)
      : is_on_demand_(plan.on_demand),
        is_recording_(!plan.on_demand),
        types_of_programs_(plan.types_of_programs),
        file_(std::move(file)),
        opener_(std::move(session), plan) {}

  Duration next_period();
  Result<void> add(Source source);
  Result<void> add_to_file(Source& source);
  // Its description counts from the next file on.
  Result<void> describe(const StreamId& id);
  //   is_new  all of its ring counts, also what was overwritten
  void want_past(Source& source, bool is_new) const;
  // take(); samples that are later than `held_from` may wait for earlier ones of other streams.
  Result<void> take_until(Time held_from);
  // A stream in a turn of take().
  struct Turn {
    Source* source = nullptr;
    Time next;  // the time of its next sample; max(): it has none, as far as is known
    std::uint64_t bytes = 0, samples = 0;  // that were taken
  };
  // Takes the samples of all streams in the order of their times.
  //   past_until  samples of the past that are later than this wait
  Result<void> take_in_order(std::optional<Time> past_until, Time held_from);
  // Its next sample. Whether there may be another one.
  Result<bool> take_next(Turn& turn);
  static bool is_held(const Turn& turn, Time held_from);
  static bool is_of_past(const Source& source) { return source.next <= source.past_until; }
  // The time of the next sample; empty: there is none, or it is not here.
  static std::optional<Time> next_time(const Source& source);
  // Ends those of removed streams; while nothing is recorded, also follows restarts.
  void check_readers();
  // Whether its ring has nothing more for the file.
  bool is_taken(const Source& source) const;
  void follow_restart(Source& source);
  // To be called when the reader has gone to another ring.
  void on_restarted(Source& source);
  static bool have_same_ring(const Source& a, const Source& b);
  // Whether another source has the same ring.
  bool is_duplicate(const Source& source) const;
  // Marks those whose readers cannot continue; their streams are opened again.
  void end_sources();
  void drop_ended();
  // What a file has of it, for the files that follow.
  void remember(const Source& source);
  static void forget_properties(Source& source);
  void add_property(const StreamId& id, NewProperty property);
  // Those whose time is known.
  //   all  the others, too
  Result<void> write_properties(Source& source, bool all);
  Result<void> add_gap(const Source& source, Tid end);
  Result<void> write(Source& source, const SampleInfo& info);
  // Takes what there is until now and completes the file.
  Result<void> complete();

  const bool is_on_demand_;
  bool is_recording_;  // in file_, which is not finished
  const std::map<std::pair<std::string, std::uint64_t>, TypeInfo> types_of_programs_;
  std::optional<RecordingWriter> file_;
  // What file_ has of a ring.
  struct Kept {
    std::uint64_t incarnation = 0;
    Tid newest = kNoTid;
    std::vector<std::byte> property;  // the last one
  };
  std::vector<Kept> kept_;                        // by the streams' numbers in file_
  std::map<std::string, std::uint32_t> numbers_;  // in file_, of each stream's last ring
  // On demand: the newest ring of each open stream, and the newest sample of it that a file has. A
  // stream that was removed stays open for longer than the past that a file has of it, so none of
  // its samples is wanted twice.
  std::map<std::string, std::pair<std::uint64_t, Tid>> recorded_;
  Time wanted_from_{};  // on demand: of the file's samples
  Duration before_{};   // the same, before begin()
  Opener opener_;
  std::vector<Source> sources_;
  std::vector<Turn> turns_;  // in take_in_order(), the earliest next one first
  std::vector<std::byte> payload_;
  Time newest_time_ = Time::min();  // of the samples in the file
  double filled_ = 0;               // the greatest part of a ring that was new in this turn
  Duration period_ = kMinPeriod;
  bool is_more_ = false;  // to be taken at once
  MonoTime all_by_{};     // until then the past waits for streams to be opened
  MonoTime next_take_{}, next_check_{};
  std::uint64_t past_progress_ = 0;  // is_past_late(): how much of the past is recorded
  MonoTime past_moved_ = MonoClock::now();
};

}  // namespace dssm::ctl
