// SPDX-License-Identifier: Apache-2.0
//
// Recorders, players, writers and dssmds are killed at random. Each recording that is left opens at
// once, with all samples up to about a second before the kill, each once, in order and whole.
// Readers that live through all that get new samples after each recovery.
//
//   pc1  has half of the streams, and `dssmctl record` of all of them, which begins another
//        recording after each kill; `dssmctl play` plays the first one over and over
//   pc2  has the other half
//   pc3  only reads
//
//   $DSSM_SOAK_SECONDS  duration of the kills; default 12
//   $DSSM_TEST_SEED     of the random kills; default: another one each time, printed
#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <csignal>
#include <cstdio>
#include <deque>
#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <map>
#include <mutex>
#include <random>
#include <sstream>
#include <thread>

#include "tests/process/network/fleet.hpp"
#include "tests/process/network/follower.hpp"
#include "tests/process/network/load.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// A chunk is written when it is a second old (docs/recording.md "Writing"). The rest is for the
// time that this takes on a busy machine.
constexpr Duration kWrittenWithin = 1s + (kSlowness > 1 ? 8s : 2s);

// What a ring holds for so long is not lost on a busy machine.
constexpr Duration kLongHistory = 5s;

// By then a program has begun, and does not end any more when dssmd does. Each dssmd that begins
// answers after 3 s at the latest (kPatientRecovery), and programs wait for an answer for 5 s.
constexpr Duration kStartTime = 10s;

// A clock that hardly moves while this machine stalls: it counts pauses of 10 ms.
class Ticks {
 public:
  Ticks() {
    thread_ = std::thread([this] {
      while (!stop_) {
        std::this_thread::sleep_for(kTick);
        ++ticks_;
      }
    });
  }
  Ticks(const Ticks&) = delete;
  Ticks& operator=(const Ticks&) = delete;
  ~Ticks() {
    stop_ = true;
    thread_.join();
  }
  Duration now() const { return ticks_.load() * kTick; }

 private:
  static constexpr Duration kTick = 10ms;
  std::atomic<bool> stop_ = false;
  std::atomic<std::int64_t> ticks_ = 0;
  std::thread thread_;
};

// What a reader that is never killed had at some time.
struct Mark {
  Duration at{};  // of Ticks
  std::uint64_t incarnation = 0;
  Tid last = kNoTid;
};

// Followers on one host, and the thread that reads.
class FollowerGroup {
 public:
  explicit FollowerGroup(const Ticks& ticks) : ticks_(ticks) {}
  FollowerGroup(const FollowerGroup&) = delete;
  FollowerGroup& operator=(const FollowerGroup&) = delete;
  ~FollowerGroup() { stop(); }

  void add(const KnownStream& known, RawReader reader) {
    followers_.emplace_back(known, std::move(reader), std::nullopt);
  }
  void begin() {
    marks_.resize(followers_.size());
    thread_ = std::thread([this] { run(); });
  }
  void stop() {
    stop_ = true;
    if (thread_.joinable()) thread_.join();
  }

  // Of streams that are written at least ten times a second: how many samples were taken.
  std::map<std::string, std::uint64_t> taken() {
    const std::lock_guard lock(mutex_);
    std::map<std::string, std::uint64_t> taken;
    for (const Follower& follower : followers_) {
      if (follower.known().cycle > 100ms * kSlowness) continue;
      taken[follower.known().id.str()] = follower.taken();
    }
    return taken;
  }
  // By the stream: what was taken at `time`, as far as samples had come by then.
  std::map<std::string, Mark> marks(Duration time) {
    const std::lock_guard lock(mutex_);
    std::map<std::string, Mark> marks;
    for (std::size_t i = 0; i < followers_.size(); ++i) {
      for (const Mark& mark : marks_[i]) {
        if (mark.at <= time) marks[followers_[i].known().id.str()] = mark;
      }
    }
    return marks;
  }
  std::uint64_t lost(const std::string& stream) {
    const std::lock_guard lock(mutex_);
    for (const Follower& follower : followers_) {
      if (follower.known().id.str() == stream) return follower.lost();
    }
    return 0;
  }
  // After stop().
  std::vector<Follower>& followers() { return followers_; }

 private:
  void run() {
    std::vector<RawReader*> readers;
    for (Follower& follower : followers_) readers.push_back(&follower.reader());
    while (!stop_) {
      (void)wait_any(readers, deadline_in(100ms));
      const std::lock_guard lock(mutex_);
      for (std::size_t i = 0; i < followers_.size(); ++i) {
        Follower& follower = followers_[i];
        follower.take(64);
        if (follower.last() == kNoTid) continue;
        std::deque<Mark>& marks = marks_[i];
        const Mark mark{ticks_.now(), follower.reader().incarnation(), follower.last()};
        if (!marks.empty() && marks.back().last == mark.last &&
            marks.back().incarnation == mark.incarnation) {
          continue;
        }
        marks.push_back(mark);
        while (marks.front().at < mark.at - 4 * kWrittenWithin) marks.pop_front();
      }
    }
  }

  const Ticks& ticks_;
  std::mutex mutex_;
  std::vector<Follower> followers_;
  std::vector<std::deque<Mark>> marks_;  // of each follower, the latest last
  std::atomic<bool> stop_ = false;
  std::thread thread_;
};

class RecordingSoak : public NetworkTest {
 protected:
  static constexpr int kOwners = 2;
  static constexpr int kRecorder = 1;  // its host, and that of the player
  static constexpr int kReader = 3;

  ~RecordingSoak() override {
    for (Program* program : {&recorder_, &player_, &writers_[0], &writers_[1]}) end(*program);
  }

  // --- programs

  struct Program {
    pid_t pid = -1;
    std::string log;  // a file: what it printed
    int kills = 0;
    Duration started{};  // of Ticks
  };

  void begin(Program& program, std::vector<std::string> words, const std::string& log) {
    program.log = folder_.file(log);
    words.insert(words.begin(), {"/bin/sh", "-c", "exec \"$@\" > '" + program.log + "' 2>&1", "sh",
                                 built("client/dssmctl/dssmctl")});
    program.pid = start(words, {fleet->dssmd(kRecorder).environment()});
    program.started = ticks_.now();
  }
  static std::string text_of(const std::string& file) {
    std::ostringstream text;
    text << std::ifstream(file).rdbuf();
    return text.str();
  }
  // Kills it; it must have run until now, or have started while dssmd was killed.
  void kill(Program& program, const char* what) {
    ::kill(program.pid, SIGKILL);
    const int status = wait_for(std::exchange(program.pid, -1));
    const bool may_end =
        dssmd_killed_ && ticks_.now() - std::min(program.started, *dssmd_killed_) < kStartTime;
    EXPECT_TRUE(status == 128 + SIGKILL || (status == 1 && may_end))
        << what << " ended by itself: " << text_of(program.log);
    ++program.kills;
  }
  // Of what ended because dssmd was killed while it started, as a service manager does.
  void restart_ended() {
    const auto has_ended = [](const Program& program) {
      siginfo_t info{};
      const auto id = static_cast<id_t>(program.pid);
      return ::waitid(P_PID, id, &info, WEXITED | WNOHANG | WNOWAIT) == 0 && info.si_pid != 0;
    };
    if (has_ended(recorder_)) {
      std::printf("%s", text_of(recorder_.log).c_str());
      kill_recorder({});
      start_recorder();
    }
    if (has_ended(player_)) {
      std::printf("%s", text_of(player_.log).c_str());
      kill(player_, "the player");
      start_player();
    }
  }
  void kill_dssmd(int host) {
    fleet->kill_dssmd(host);
    ++dssmd_kills_;
    if (host == kRecorder) dssmd_killed_ = ticks_.now();
  }
  static void end(Program& program) {
    if (program.pid < 0) return;
    ::kill(program.pid, SIGKILL);
    wait_for(std::exchange(program.pid, -1));
  }

  void start_writer(int owner) {
    int began[2];
    ASSERT_EQ(::pipe2(began, O_CLOEXEC), 0);
    Program& writer = writers_[owner - 1];
    writer.pid = start({built("tests/process/network/load-writer"), std::to_string(owner),
                        std::to_string(percent_), std::to_string(++lives_[owner - 1])},
                       {fleet->dssmd(owner).environment()}, began[1]);
    ::close(began[1]);
    char byte = 0;
    EXPECT_EQ(::read(began[0], &byte, 1), 1) << "the writer ended early";
    ::close(began[0]);
  }

  // --- the recorder

  struct Announced {
    Duration at{};                           // when it was first found to have samples
    std::map<std::uint64_t, Tid> last_tids;  // by the incarnation
  };

  void start_recorder() {
    recording_ = folder_.file("recording_" + std::to_string(++recordings_));
    std::filesystem::create_directory(recording_);
    announced_.clear();
    // Files are so short that some recorders are killed when they begin another one.
    begin(recorder_, {"record", "-o", recording_ + "/a.mcap", "--max-file-size", "4MiB"},
          "recorder");
  }

  // Reads the recording while it is written: what it has now it must have later, too.
  void observe_recording() {
    if (std::filesystem::is_empty(recording_)) return;
    const Result<Recording> recording = Recording::open(recording_);
    ASSERT_TRUE(recording) << recording.error().message;
    ++observed_;
    for (const RecordedStreamInfo& stream : recording->streams()) {
      if (stream.samples == 0) continue;
      announced_.try_emplace(stream.id.str(), Announced{ticks_.now(), {}})
          .first->second.last_tids[stream.incarnation] = stream.last_tid;
    }
  }

  // An incarnation of a stream in a recording.
  struct Recorded {
    std::string stream;
    std::uint64_t incarnation = 0, life = 0;
    std::uint64_t missing = 0, lost = 0;  // after the first sample; which the recording says
    Tid last = kNoTid;
    std::string gaps = {};  // between samples, for messages
  };

  // That all samples of the recording are whole, and in order.
  std::vector<Recorded> read(const Recording& recording) {
    std::vector<Recorded> all;
    for (const RecordedStreamInfo& stream : recording.streams()) {
      all.push_back({stream.id.str(), stream.incarnation, 0, 0, stream.lost_samples, kNoTid});
    }
    RecordingCursor cursor = recording.cursor();
    for (RecordedSample sample; cursor.next(sample); ++samples_) {
      Recorded& recorded = all[sample.stream];
      const KnownStream& known = known_.at(recorded.stream);
      const Tid tid = sample.info.tid;
      const std::uint64_t life = KnownStream::life(sample.payload);
      if (recorded.last == kNoTid) {
        recorded.life = life, recorded.last = tid - 1;
        recorded.gaps = "from tid " + std::to_string(tid);
      } else if (tid > recorded.last + 1) {
        recorded.gaps +=
            ", not " + std::to_string(recorded.last + 1) + " to " + std::to_string(tid - 1);
      }
      std::string wrong = known.fault(sample.payload, sample.info, recorded.life);
      if (sample.payload.size() != known.payload_bytes) wrong += "it has another length";
      if (tid <= recorded.last) wrong += "after tid " + std::to_string(recorded.last);
      EXPECT_EQ(wrong, "") << recorded.stream << " tid " << tid;
      if (!wrong.empty()) break;
      recorded.missing += static_cast<std::uint64_t>(tid - recorded.last - 1);
      recorded.last = tid;
    }
    return all;
  }

  // That the recording of a recorder that was killed has all that it had before, and all of
  // `wanted`, as far as the stream was recorded by then.
  void check_recording(const std::map<std::string, Mark>& wanted) {
    SCOPED_TRACE(recording_);
    if (std::filesystem::is_empty(recording_)) {
      EXPECT_TRUE(announced_.empty());
      return;
    }
    for (const auto& file : std::filesystem::directory_iterator(recording_)) {
      const Result<Recording> alone = Recording::open(file.path());
      EXPECT_TRUE(alone) << alone.error().message;
      ++files_;
    }
    const Result<Recording> recording = Recording::open(recording_);
    ASSERT_TRUE(recording) << recording.error().message;
    const std::vector<Recorded> all = read(*recording);
    for (const Recorded& recorded : all) {
      SCOPED_TRACE(recorded.stream + " of life " + std::to_string(recorded.life));
      EXPECT_LE(recorded.missing, recorded.lost);
      const KnownStream& known = known_.at(recorded.stream);
      // Another host's ring may be full when its stream comes: its oldest samples are
      // overwritten while it is opened, and count as lost, too.
      const bool is_own = recorded.stream.ends_with("@" + Network::name(kRecorder));
      if (static_cast<std::int64_t>(known.depth) * known.cycle >= kLongHistory) {
        EXPECT_LE(is_own ? recorded.lost : recorded.missing, groups_[0].lost(recorded.stream))
            << "which another reader has; recorded: " << recorded.gaps << " to " << recorded.last
            << "\n"
            << text_of(recorder_.log);
      }
      lost_ += recorded.lost;
    }
    for (const auto& [stream, announced] : announced_) {
      SCOPED_TRACE(stream);
      const auto last_of = [&, &name = stream](std::uint64_t incarnation) {
        for (const Recorded& recorded : all) {
          if (recorded.stream == name && recorded.incarnation == incarnation) return recorded.last;
        }
        return kNoTid;
      };
      for (const auto& [incarnation, last] : announced.last_tids) {
        EXPECT_GE(last_of(incarnation), last) << "which it had before";
      }
      const auto mark = wanted.find(stream);
      if (mark == wanted.end() || mark->second.at < announced.at) continue;
      EXPECT_GE(last_of(mark->second.incarnation), mark->second.last) << "which was due";
      ++checked_;
    }
  }

  void kill_recorder(const std::map<std::string, Mark>& wanted) {
    kill(recorder_, "the recorder");
    check_recording(wanted);
    if (recording_ != to_play_) std::filesystem::remove_all(recording_);
  }

  // --- the player

  static std::string original_of(const KnownStream& played) {
    StreamId id = played.id;
    id.name = "load";
    return id.str();
  }

  void start_player() {
    std::vector<std::string> words = {"play", to_play_, "--loop"};
    for (const KnownStream& stream : played_) words.push_back(original_of(stream));
    for (const KnownStream& stream : played_) {
      words.insert(words.end(), {"--map", original_of(stream) + "=" + stream.id.str()});
      // It refuses to write beside another program, as which a player counts until dssmd has seen
      // its end.
      await("no other player is known", [&] {
        const auto info = sessions_[0].stream_info(stream.id);
        return !info || info->writers == 0;
      });
    }
    begin(player_, words, "player");
  }

  // --- all

  // Until all readers have new samples.
  void await_new_samples() {
    for (const int host : {kRecorder, kReader}) {
      FollowerGroup& group = groups_[host == kRecorder ? 0 : 1];
      auto waiting = group.taken();
      const bool all = await("all readers get new samples", [&] {
        restart_ended();
        const auto now = group.taken();
        std::erase_if(waiting,
                      [&](const auto& before) { return now.at(before.first) > before.second; });
        return waiting.empty();
      });
      for (const auto& [stream, taken] : waiting) {
        ADD_FAILURE() << "on pc" << host << " " << about(host, stream) << "; taken: " << taken;
      }
      if (!all) std::printf("the player: %s\n", text_of(player_.log).c_str());
    }
    ++recoveries_;
  }
  // What the host's dssmd says of the stream.
  std::string about(int host, const std::string& stream) {
    const auto info =
        sessions_[static_cast<std::size_t>(host) - 1].stream_info(StreamId::parse(stream).value());
    if (!info) return info.error().message;
    std::string text = "'" + stream + "': newest " + std::to_string(info->newest) + ", writers " +
                       std::to_string(info->writers);
    if (!info->mirror) return text;
    return text + ", mirror " + std::string(name_of(info->mirror->state)) + " at " +
           std::to_string(info->mirror->newest) + " " + info->mirror->error;
  }

  const std::uint64_t seed_ = number_from_environment("DSSM_TEST_SEED", std::random_device{}());
  const std::uint64_t seconds_ =
      number_from_environment("DSSM_SOAK_SECONDS", kSlowness > 1 ? 10 : 12);
  const std::uint64_t percent_ = std::max(1, 10 / kSlowness);
  TestFolder folder_;
  Ticks ticks_;
  std::vector<Session> sessions_;
  std::map<std::string, KnownStream> known_;  // all, by their names
  std::vector<KnownStream> played_;
  Program recorder_, player_, writers_[kOwners];
  std::uint64_t lives_[kOwners] = {};
  std::string recording_, to_play_;
  int recordings_ = 0, dssmd_kills_ = 0;
  std::optional<Duration> dssmd_killed_;        // of Ticks: that of the recorder
  std::map<std::string, Announced> announced_;  // of recording_, by the stream
  FollowerGroup groups_[2] = {FollowerGroup(ticks_), FollowerGroup(ticks_)};  // on pc1, pc3
  std::uint64_t files_ = 0, samples_ = 0, lost_ = 0, observed_ = 0, checked_ = 0, recoveries_ = 0;
};

TEST_F(RecordingSoak, SurvivesKillsOfAllThatTakePart) {
  if (!make_fleet(kReader, kPatientRecovery)) return;
  std::printf("DSSM_TEST_SEED=%llu DSSM_SOAK_SECONDS=%llu\n",
              static_cast<unsigned long long>(seed_), static_cast<unsigned long long>(seconds_));
  std::mt19937_64 random(seed_);
  for (int host = 1; host <= kReader; ++host) sessions_.push_back(fleet->session(host));
  for (int owner = 1; owner <= kOwners; ++owner) {
    start_writer(owner);
    for (const KnownStream& known : load_of(owner, percent_)) known_[known.id.str()] = known;
  }
  const auto follow = [&](FollowerGroup& group, int host, const KnownStream& known) {
    auto reader =
        sessions_[static_cast<std::size_t>(host) - 1].await_raw_reader(known.id, deadline_in(1min));
    ASSERT_TRUE(reader) << reader.error().message;
    group.add(known, *std::move(reader));
  };
  for (const auto& [name, known] : known_) {
    follow(groups_[0], kRecorder, known);
    follow(groups_[1], kReader, known);
  }

  // The first recording, to be played.
  for (const int number : {1, 4}) {
    KnownStream stream = known_.at("load:" + std::to_string(number) + "@pc1");
    stream.id.name = "played";
    stream.is_played = true;
    played_.push_back(stream);
  }
  start_recorder();
  to_play_ = recording_;
  await("all streams are recorded", [&] {
    observe_recording();
    return announced_.size() == known_.size() || HasFailure();
  });
  kill_recorder({});
  for (const KnownStream& stream : played_) known_[stream.id.str()] = stream;
  start_player();
  for (const KnownStream& stream : played_) follow(groups_[0], kRecorder, stream);
  for (FollowerGroup& group : groups_) group.begin();
  start_recorder();

  const auto chance = [&](std::uint64_t percent_of_all) { return random() % 100 < percent_of_all; };
  // Each pause is the duration of a state, not a wait for anything.
  const auto pause = [&](std::uint64_t most_ms) {
    std::this_thread::sleep_for(std::chrono::milliseconds(random() % most_ms));
  };
  for (const MonoTime end = deadline_in(std::chrono::seconds(seconds_));
       MonoClock::now() < end && !HasFailure();) {
    pause(chance(30) ? 50 : 500);
    restart_ended();
    observe_recording();
    const std::uint64_t what = random() % 100;
    if (what < 15) {
      kill_recorder(groups_[0].marks(ticks_.now() - kWrittenWithin));
      pause(200);
      start_recorder();
    } else if (what < 35) {
      kill(player_, "the player");
      pause(200);
      start_player();
    } else if (what < 60) {
      const int owner = 1 + static_cast<int>(random() % kOwners);
      kill(writers_[owner - 1], "a writer");
      pause(200);
      start_writer(owner);
    } else {
      const int host = 1 + static_cast<int>(random() % kReader);
      // Without its writer, too, a stream has no ring any more, unless programs here read it.
      const bool with_writer = host <= kOwners && chance(30);
      if (with_writer) kill(writers_[host - 1], "a writer");
      kill_dssmd(host);
      pause(500);
      fleet->start_dssmd(host);
      if (with_writer) start_writer(host);
    }
    if (chance(30)) await_new_samples();
  }

  await_new_samples();
  await("the recorder records", [&] {
    restart_ended();
    observe_recording();
    return HasFailure() || !announced_.empty();
  });
  // What readers have now comes into the file, whatever time that takes.
  const std::map<std::string, Mark> wanted = groups_[0].marks(ticks_.now());
  await("all that was read is recorded", [&] {
    observe_recording();
    return HasFailure() || std::ranges::all_of(wanted, [&](const auto& entry) {
             const auto& [name, mark] = entry;
             const auto announced = announced_.find(name);
             if (announced == announced_.end()) return false;
             if (mark.at < announced->second.at) return true;  // of a ring that may be gone
             const auto last = announced->second.last_tids.find(mark.incarnation);
             return last != announced->second.last_tids.end() && last->second >= mark.last;
           });
  });
  kill_recorder(wanted);
  for (FollowerGroup& group : groups_) {
    group.stop();
    for (const Follower& follower : group.followers()) {
      EXPECT_EQ(follower.faults(), "");
      EXPECT_GT(follower.taken(), 0U);
    }
  }
  std::printf(
      "killed: %d recorders, %d players, %d writers, %d dssmds; %llu recoveries awaited\n"
      "recorded: %llu files, %llu samples, %llu lost; opened %llu times while they were written; "
      "%llu streams were due\n",
      recorder_.kills, player_.kills, writers_[0].kills + writers_[1].kills, dssmd_kills_,
      static_cast<unsigned long long>(recoveries_), static_cast<unsigned long long>(files_),
      static_cast<unsigned long long>(samples_), static_cast<unsigned long long>(lost_),
      static_cast<unsigned long long>(observed_), static_cast<unsigned long long>(checked_));
}

}  // namespace
}  // namespace dssm::test
