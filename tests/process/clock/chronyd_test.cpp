// SPDX-License-Identifier: Apache-2.0
//
// The watch and the real chronyd, which leaves this machine's clock alone (-x) and talks to nobody
// but to one more of its kind on loopback.
#include <event2/event.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <memory>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "core/wire/tcp.hpp"
#include "daemon/clock/clock_watch.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/log_recorder.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

std::string program(const std::string& name) {
  for (const char* folder : {"/usr/sbin/", "/usr/bin/"}) {
    if (::access((folder + name).c_str(), X_OK) == 0) return folder + name;
  }
  return "";
}

// What `chronyc -c tracking` prints of the parts that are compared.
struct Printed {
  std::string reference_id, source, updated;
  double correction = 0, delay = 0, dispersion = 0, interval = 0;
  int stratum = 0;
};

class Chronyd {
 public:
  explicit Chronyd(const std::string& configuration) : dir_(test::make_temp_dir()) {
    // chronyd makes its socket where nobody else may go.
    std::filesystem::permissions(dir_, std::filesystem::perms::owner_all);
    std::ofstream(dir_ + "/chrony.conf")
        << "bindcmdaddress 127.0.0.1\nbindcmdaddress " << dir_ << "/chronyd.sock\n"
        << "cmdport " << port_ << "\npidfile " << dir_ << "/chronyd.pid\n"
        << configuration;
    start();
  }
  Chronyd(const Chronyd&) = delete;
  Chronyd& operator=(const Chronyd&) = delete;
  ~Chronyd() {
    kill();
    test::remove_tree(dir_);
  }

  void start() {
    std::filesystem::remove(dir_ + "/chronyd.pid");
    pid_ = test::start(
        {program("chronyd"), "-x", "-d", "-L", "1", "-u", "root", "-f", dir_ + "/chrony.conf"});
  }
  void kill() {
    if (pid_ <= 0) return;
    ::kill(pid_, SIGKILL);
    test::wait_for(std::exchange(pid_, -1));
  }

  void signal(int number) const { ::kill(pid_, number); }

  wire::SocketAddress address() const {
    const wire::Address there{"127.0.0.1", port_};
    return wire::resolve_number(there).at(0);
  }
  // Through its socket in the file system, which may also change things.
  std::string chronyc(std::vector<std::string> arguments) const {
    std::vector<std::string> argv{program("chronyc"), "-h", dir_ + "/chronyd.sock"};
    argv.insert(argv.end(), arguments.begin(), arguments.end());
    return test::run(argv).out;
  }
  Printed tracking() const {
    std::istringstream line(chronyc({"-c", "tracking"}));
    std::array<std::string, 14> field;
    for (std::string& text : field) std::getline(line, text, ',');
    Printed printed{.reference_id = field[0], .source = field[1], .updated = field[3]};
    if (field[12].empty()) return printed;  // it does not answer yet
    printed.stratum = std::stoi(field[2]);
    printed.correction = std::stod(field[4]);
    printed.delay = std::stod(field[10]);
    printed.dispersion = std::stod(field[11]);
    printed.interval = std::stod(field[12]);
    return printed;
  }

 private:
  const std::string dir_;
  const std::uint16_t port_ = test::free_port(SOCK_DGRAM);
  pid_t pid_ = -1;
};

class ChronydTest : public testing::Test, protected ClockWatch::Observer {
 protected:
  EventLoop loop = EventLoop::open().value();
  LogRecorder logger;
  int clock_events = 0;
  std::unique_ptr<ClockWatch> watch;

  void SetUp() override {
    if (program("chronyd").empty() || program("chronyc").empty()) {
      GTEST_SKIP() << "no chronyd and chronyc on this machine; install the package chrony";
    }
    if (::geteuid() != 0) GTEST_SKIP() << "chronyd runs as root only";
  }
  void on_clock() override { ++clock_events; }

  void follow(const Chronyd& chronyd) {
    // Both clocks tick as one here, so that what they add to the bound is nothing.
    const clock::Instant start = clock::Instant::now();
    const auto now = [start] {
      const MonoTime mono = MonoClock::now();
      return clock::Instant{mono, start.wall + (mono - start.mono), {}};
    };
    ClockWatch::Observer& observer = *this;
    watch = std::make_unique<ClockWatch>(loop, ClockWatch::Options{chronyd.address(), {}, now},
                                         observer, logger);
  }
  // meson's time-out is the watchdog.
  void until(const std::function<bool()>& done) {
    while (!done()) event_base_loop(loop.base(), EVLOOP_ONCE);
  }
};

// One question, answered.
class OneAnswer final : private ChronydClient::Observer {
 public:
  OneAnswer(const EventLoop& loop, const Chronyd& chronyd)
      : client_(loop, chronyd.address(), *this, clock::Instant::now) {
    while (!reply) event_base_loop(loop.base(), EVLOOP_ONCE);
  }
  std::optional<TrackingReply> reply;

 private:
  void on_answer(const TrackingReply& answer, MonoTime, const clock::Instant&) override {
    reply = answer;
  }
  void on_no_chronyd() override {}
  void on_no_answer(const Error&) override {}
  ChronydClient client_;
};

// Whether ours is what chronyc prints, to a nanosecond, of a number of seconds that moved from `a`
// to `b` meanwhile. It may be farther from zero, by the last nanosecond and a unit of chronyd's
// format.
void expect_printed(Duration ours, double a, double b) {
  const auto slack = [](double ns) { return 1.6 + std::fabs(ns) * 2e-7; };
  const double least = std::min(a, b) * 1e9, most = std::max(a, b) * 1e9;
  EXPECT_GE(static_cast<double>(ours.count()), least - (least < 0 ? slack(least) : 0.6));
  EXPECT_LE(static_cast<double>(ours.count()), most + (most > 0 ? slack(most) : 0.6));
}

TEST_F(ChronydTest, ReportsWhatChronycPrints) {
  const std::uint16_t ntp_port = test::free_port(SOCK_DGRAM);
  const Chronyd reference("local stratum 10\nallow 127.0.0.1\nbindaddress 127.0.0.1\nport " +
                          std::to_string(ntp_port) + "\n");
  const Chronyd chronyd("server 127.0.0.1 port " + std::to_string(ntp_port) +
                        " iburst minpoll 0 maxpoll 0\nport 0\n");
  int compared = 0;
  while (compared < 3) {
    const Printed before = chronyd.tracking();
    const TrackingReply ours = *OneAnswer(loop, chronyd).reply;
    const Printed after = chronyd.tracking();
    // It measures once a second: not while we look.
    if (before.source.empty() || before.updated != after.updated) continue;
    if (before.interval < 0.1) continue;  // its first measurements
    ++compared;
    const clock::Tracking& tracking = ours.tracking;
    EXPECT_EQ(tracking.reference_id, std::stoul(before.reference_id, nullptr, 16));
    ASSERT_TRUE(ours.source);
    EXPECT_EQ(ours.source->str(), before.source);
    EXPECT_EQ(tracking.stratum, before.stratum);
    EXPECT_EQ(tracking.leap, 0);
    const std::string nanoseconds = std::to_string(to_ns(tracking.updated));
    EXPECT_EQ(std::string(nanoseconds).insert(nanoseconds.size() - 9, "."), before.updated);
    expect_printed(tracking.root.delay, before.delay, after.delay);
    expect_printed(tracking.root.dispersion, before.dispersion, after.dispersion);
    expect_printed(tracking.offset, -before.correction, -after.correction);
    EXPECT_NEAR(static_cast<double>(to_ns(tracking.update_interval)) * 1e-9, before.interval,
                0.051);
    EXPECT_GT(to_ns(tracking.root.delay), 0);
  }
}

TEST_F(ChronydTest, TakesTheLocalModeForRightByDefinition) {
  const Chronyd chronyd("local stratum 10\nport 0\nmanual\n");
  follow(chronyd);
  until([&] { return watch->state().status == ClockStatus::synchronized; });
  const ClockSnapshot state = watch->state();
  EXPECT_EQ(state.basis, ClockBasis::own);
  EXPECT_EQ(state.bound, Duration::zero());
  EXPECT_EQ(watch->reference_id(), clock::kLocalReferenceId);
  EXPECT_EQ(state.stratum, 10u);
  EXPECT_EQ(watch->source(), std::nullopt);

  // Now chronyd shall take this clock for a quarter of a second fast.
  ASSERT_EQ(chronyd.chronyc({"doffset", "0.25"}), "200 OK\n");
  EXPECT_NE(chronyd.chronyc({"tracking"}).find("0.250000000 seconds fast of NTP time"),
            std::string::npos);
  until([&] { return watch->state().offset != Duration::zero(); });
  EXPECT_EQ(watch->state().offset, 250'000'015ns) << "ahead, and a unit of chronyd's format more";
  EXPECT_EQ(watch->state().reason, ClockReason::too_far);
  EXPECT_EQ(watch->state().bound, 250'000'015ns);
}

TEST_F(ChronydTest, IsFoundMissingByOneRequestAndRecovers) {
  Chronyd chronyd("local stratum 10\nport 0\n");
  follow(chronyd);
  until([&] { return watch->state().status == ClockStatus::synchronized; });
  for (int i = 0; i < 2; ++i) {
    chronyd.kill();
    clock_events = 0;
    until([&] { return clock_events == 1; });
    EXPECT_EQ(watch->state().status, ClockStatus::out_of_bounds);
    EXPECT_EQ(watch->state().reason, ClockReason::no_chronyd);
    EXPECT_EQ(watch->state().bound, kUnknownClockError);
    chronyd.start();
    until([&] { return watch->state().status == ClockStatus::synchronized; });
  }
}

TEST_F(ChronydTest, DoesNotAnswerWhileItIsStopped) {
  const Chronyd chronyd("local stratum 10\nport 0\n");
  follow(chronyd);
  until([&] { return watch->state().status == ClockStatus::synchronized; });
  chronyd.signal(SIGSTOP);
  until([&] { return watch->state().status != ClockStatus::synchronized; });
  EXPECT_EQ(watch->state().reason, ClockReason::silent);
  chronyd.signal(SIGCONT);
  until([&] { return watch->state().status == ClockStatus::synchronized; });
}

}  // namespace
}  // namespace dssm::daemon
