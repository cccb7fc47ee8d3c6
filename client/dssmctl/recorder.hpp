// SPDX-License-Identifier: Apache-2.0
//
// From live streams into a recording. It reads rings as every reader does, so that no writer waits
// for it: what a ring overwrites before it was taken is a gap in the recording, with its tids.
//
// The rings are looked at so often that none of them is filled more than by a part in between:
// which costs less than a wake-up for each sample, and a recording is in no hurry. Streams are
// opened and their properties asked for by a thread of its own, so that a host that does not answer
// costs no samples of the others.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
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
  // From so long before now: what the rings hold still. Empty: from now on.
  std::optional<Duration> past;
};

class Recorder {
 public:
  // `session` is used by a thread until the recorder is destroyed.
  static Result<std::unique_ptr<Recorder>> start(Session session, RecordingWriter file,
                                                 RecorderPlan plan);
  Recorder(const Recorder&) = delete;
  Recorder& operator=(const Recorder&) = delete;
  ~Recorder() = default;

  // Records what has come since the last call.
  //   fails  as RecordingWriter::write(); what was recorded before stays
  Result<void> take();

  // How much of `plan.past` is recorded: rises until has_past().
  std::uint64_t past_progress() const;

  // When take() is to be called again.
  MonoTime next_take() const { return next_take_; }

  // Whether there is nothing more of `plan.past` to come: all streams that there were at the start
  // are recorded up to their newest sample of then, or could not be opened.
  bool has_past() const;

  std::size_t streams() const { return sources_.size(); }
  RecordingProgress progress() const { return file_.progress(); }
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
  static constexpr Duration kEndingTime = std::chrono::seconds(1);
  // So long the past waits for streams to be opened.
  static constexpr Duration kOpeningTime = std::chrono::seconds(1);
  static constexpr Duration kCheckPeriod =
      std::chrono::seconds(1);  // for readers that cannot go on
  // The past is recorded in parts of this length, each of all streams, so that the recording is
  // about in the order of times.
  static constexpr Duration kPastPart = std::chrono::milliseconds(100);
  // What one stream may have taken before the others have their turn.
  static constexpr std::uint64_t kTurnBytes = 4U << 20;

  // A stream that is recorded.
  struct Source {
    RawReader reader;
    std::uint32_t number = 0;  // in the file
    Tid next = kNoTid;  // what was before it is recorded, or known as lost; kNoTid: not known yet
    Tid past_until = kNoTid;   // the newest at its opening, if history is wanted
    std::optional<Time> from;  // samples before that are not wanted
  };

  // Opens streams and fetches properties. What the thread and take() share is behind a lock.
  class Opener {
   public:
    Opener(Session session, RecorderPlan plan);
    Opener(const Opener&) = delete;
    Opener& operator=(const Opener&) = delete;
    ~Opener() { end(); }

    // All that exists, then all that comes.
    Result<void> begin();
    // Opens nothing more, but those that there were at begin(), for a second at most; waits for
    // that.
    void end();
    // Opens it again: its reader cannot go on, because of `error`.
    void reopen(const StreamId& id, const Error& error);

    struct Opened {
      Source source;
      std::vector<std::byte> property;
    };
    std::vector<Opened> take_opened();
    std::vector<std::string> take_notices();
    bool has_tried_all() const;  // of the streams that there were at begin()

   private:
    struct Wanted {
      StreamInfo stream;
      MonoTime due{};
      bool from_start = false;  // it was there at begin()
      bool reported = false;
    };
    // The one to try next; the end: none.
    std::vector<Wanted>::iterator next_wanted();
    bool wants(const StreamInfo& stream) const;
    void on_event(const StreamEvent& event);
    void run();
    Result<Opened> open(const Wanted& wanted) const;

    Session session_;
    RecorderPlan plan_;
    Time started_{};

    mutable std::mutex mutex_;
    std::condition_variable changed_;
    bool is_beginning_ = true;  // begin() runs: what comes is there already
    std::vector<Wanted> wanted_;
    std::set<std::string> known_;  // names of what was opened: they restart by themselves
    std::size_t untried_ = 0;
    std::vector<Opened> opened_;
    std::vector<std::string> notices_;
    std::optional<MonoTime> stop_at_;

    std::thread thread_;
    std::optional<Session::Watch> watch_;  // the first to end: it calls on_event()
  };

  Recorder(Session session, RecordingWriter file, RecorderPlan plan)
      : file_(std::move(file)), opener_(std::move(session), std::move(plan)) {}

  Duration next_period();
  Result<void> add(Opener::Opened opened);
  Result<void> add_to_file(Source& source, std::vector<std::byte> property);
  // Whether there may be more at once.
  //   until  not beyond samples of that time
  Result<bool> take(Source& source, std::optional<Time> until);
  // The time of the next sample of the past; empty: there is none, or it is not here.
  static std::optional<Time> next_past(const Source& source);
  // What cannot be read any more is opened again.
  void check_readers();
  Result<void> write(Source& source, const SampleInfo& info);

  RecordingWriter file_;
  Opener opener_;
  std::vector<Source> sources_;
  std::vector<std::byte> payload_;
  double filled_ = 0;  // the greatest part of a ring that was new in this turn
  Duration period_ = kMinPeriod;
  bool is_more_ = false;  // to be taken at once
  MonoTime all_by_{};     // until then the past waits for streams to be opened
  MonoTime next_take_{}, next_check_{};
};

}  // namespace dssm::ctl
