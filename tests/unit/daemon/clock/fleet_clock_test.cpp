// SPDX-License-Identifier: Apache-2.0
//
// This PC's clock among others, which the test puts into the catalog, with a chronyd that says what
// the test wants.
#include "daemon/clock/fleet_clock.hpp"

#include <filesystem>
#include <thread>

#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/clock/fake_chronyd.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

constexpr wire::HostId kSelf{1}, kReference{2}, kOther{3};
constexpr std::uint32_t kReferenceAddress = 0x0a000001;  // 10.0.0.1
constexpr wire::IpAddress kReferenceIp{{0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 10, 0, 0, 1}};

// A host whose clock is `bound` from its own chronyd's time, and follows nobody.
wire::Greeting host(wire::HostId id, const std::string& name, Duration bound) {
  auto report = std::make_shared<wire::ClockReport>();
  report->boot_id = name + "'s boot";
  report->chain = {{id, bound}};
  report->anchor = id;
  report->clock.bound = bound;
  report->clock.status = ClockStatus::synchronized;
  report->as_of = MonoClock::now();
  wire::Greeting greeting;
  greeting.host = name;
  greeting.host_id = id;
  greeting.instance_id = 1;
  greeting.program = "dssmd";
  greeting.clock = report;
  return greeting;
}

bool contains(const std::string& text, std::string_view words) {
  return text.find(words) != std::string::npos;
}

class FleetClockTest : public testing::Test {
 protected:
  FleetClockTest() {
    char folder[] = "/tmp/dssm-fleet-clock-XXXXXX";
    EXPECT_TRUE(::mkdtemp(folder));
    folder_ = folder;
    tracking.reference_id = kReferenceAddress;
    tracking.stratum = 11;
    tracking.leap = 0;
    tracking.update_interval = 1s;
    tracking.offset = 10us;
    tracking.root = {20us, 60us};
  }
  ~FleetClockTest() override { std::filesystem::remove_all(folder_); }

  // Starts, and waits until chronyd has answered.
  FleetClock& start() {
    Result<clock::ClockPageWriter> page = clock::ClockPageWriter::open(folder_ + "/clock");
    fleet.emplace(
        loop,
        FleetClock::Options{{chronyd.address(), {}, [this] { return now(); }, 50ms}, policies},
        *std::move(page), own, kSelf, catalog, logger);
    fleet->on_new_generation([this] { ++generations; });
    wait([this] { return own->clock.status != ClockStatus::unknown; });
    return *fleet;
  }
  void wait(const std::function<bool()>& done) { run_until(loop, done); }
  clock::Instant now() const {
    clock::Instant now = clock::Instant::now();
    return {now.mono + passed, now.wall + passed + set_by, now.width, now.raw + passed};
  }
  void follow_no_source() {
    tracking.reference_id = clock::kLocalReferenceId;
    tracking.root = {};
    tracking.offset = 0us;
  }
  void add_reference() {
    wire::Greeting reference = host(kReference, "pc1", 5us);
    auto report = std::make_shared<wire::ClockReport>(*reference.clock);
    report->addresses = {kReferenceIp};
    reference.clock = report;
    catalog.host_up(reference, {"10.0.0.1", 13776});
  }
  // pc2, which follows pc1 within `bound`, and which chronyd here follows.
  void add_follower(Duration bound) {
    catalog.host_up(host(kOther, "pc2", 5us), {"10.0.0.1", 13776});
    set_follower(bound);
  }
  void set_follower(Duration bound) {
    auto report = std::make_shared<wire::ClockReport>(*host(kOther, "pc2", 5us).clock);
    report->addresses = {kReferenceIp};
    report->chain.push_back({kReference, bound});
    report->anchor = kReference;
    report->clock.bound = bound;
    catalog.set_clock(kOther, report);
  }
  ring::ClockAssessment assessed(const wire::Greeting& owner) const {
    return fleet->assess_mirror(lidar, owner.clock.get());
  }

  const std::string& folder() const { return folder_; }

  const StreamId lidar{"lidar", 0, "pc3"};
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  LogRecorder logger;
  clock::Tracking tracking;
  FakeChronyd chronyd{loop, [this](const FakeChronyd::Request& request) {
                        tracking.updated = WallClock::now() - tracking.offset - 10ms;
                        chronyd.answer(request, reply_of(tracking));
                      }};
  Catalog catalog{"self"};
  ClockPolicies policies;
  std::shared_ptr<wire::ClockReport> own = std::make_shared<wire::ClockReport>();
  std::optional<FleetClock> fleet;
  int generations = 0;
  Duration passed{}, set_by{};  // by how much all clocks, or the wall clock, are ahead

 private:
  std::string folder_;
};

TEST_F(FleetClockTest, APcWithoutASourceIsItsOwnReference) {
  follow_no_source();
  start();
  EXPECT_EQ(own->clock.status, ClockStatus::synchronized);
  EXPECT_EQ(own->clock.basis, ClockBasis::own);
  EXPECT_EQ(own->anchor, kSelf);
  EXPECT_EQ(own->chain.size(), 1U);
  EXPECT_LT(own->clock.bound, 50us);
  EXPECT_FALSE(own->root_is_utc);
  EXPECT_EQ(generations, 1) << "others have to know";
}

// It stays where it was set to, and samples that came before are by the clock that it was.
TEST_F(FleetClockTest, AReferenceTrustsNoReportFromBeforeItsClockWasSet) {
  follow_no_source();
  auto follower = std::make_shared<wire::ClockReport>(*host(kOther, "pc2", 5us).clock);
  follower->chain.push_back({kSelf, 100us});
  follower->anchor = kSelf;
  start();  // with a new setting
  EXPECT_FALSE(fleet->assess_mirror(lidar, follower.get()).can_be_good());
  EXPECT_EQ(fleet->distance_to(*follower), kUnknownClockError);
  follower->as_of = MonoClock::now();
  EXPECT_TRUE(fleet->assess_mirror(lidar, follower.get()).can_be_good());
  EXPECT_LT(fleet->distance_to(*follower), 1ms);
}

TEST_F(FleetClockTest, OwnStreamsThatOthersWriteToAreAsFarOffAsThisClock) {
  EXPECT_FALSE(FleetClockTest::start().assess_own(lidar).added == kUnknownClockError);
  const ring::ClockAssessment known = fleet->assess_own(lidar);
  EXPECT_EQ(known.policy, ClockPolicy::enforce);
  EXPECT_GE(known.added, own->clock.bound);
  EXPECT_EQ(known.limit, policies.general.limit);
  tracking.leap = clock::Tracking::kUnsynchronized;
  wait([this] { return own->clock.bound == kUnknownClockError; });
  EXPECT_FALSE(fleet->assess_own(lidar).can_be_good());
  policies.general.policy = ClockPolicy::off;
  fleet->set(policies, 50'000);
  EXPECT_EQ(fleet->assess_own(lidar).policy, ClockPolicy::off);
}

TEST_F(FleetClockTest, OnlyUtcIsLeftWithoutAHostToFollow) {
  start();
  EXPECT_EQ(own->clock.basis, ClockBasis::root);
  EXPECT_TRUE(own->bound_is_root);
  EXPECT_TRUE(own->root_is_utc);
  EXPECT_GE(own->clock.bound, 60us);
  EXPECT_LT(own->clock.bound, 200us);
  EXPECT_EQ(own->reference, "10.0.0.1");
}

TEST_F(FleetClockTest, TheHostAtTheAddressThatChronydFollowsIsTheReference) {
  add_reference();
  start();
  EXPECT_EQ(own->clock.basis, ClockBasis::reference);
  EXPECT_EQ(own->reference, "pc1");
  EXPECT_EQ(own->anchor, kReference);
  ASSERT_EQ(own->chain.size(), 2U);
  EXPECT_EQ(own->chain[1].host, kReference);
  EXPECT_EQ(own->chain[1].bound, own->clock.bound);
}

TEST_F(FleetClockTest, ASampleMayBeAsWrongAsIsLeftOfTheLimit) {
  add_reference();
  start();
  const ring::ClockAssessment found = assessed(host(kReference, "pc1", 5us));
  EXPECT_EQ(found.policy, ClockPolicy::enforce);
  EXPECT_EQ(found.limit, 1500us);
  EXPECT_GE(found.added, own->clock.bound);
  EXPECT_LT(found.added, own->clock.bound + 200us);
}

TEST_F(FleetClockTest, NothingIsGoodOfAHostThatFollowsAnotherReference) {
  add_reference();
  start();
  EXPECT_FALSE(assessed(host(kOther, "pc3", 5us)).can_be_good());
  const Error why = fleet->refusal(lidar, host(kOther, "pc3", 5us).clock.get());
  EXPECT_EQ(why.code, Errc::clock_out_of_bounds);
  EXPECT_NE(why.message.find("follow different references"), std::string::npos) << why.message;
}

TEST_F(FleetClockTest, NothingIsGoodOfAHostWhoseClockIsUnknown) {
  add_reference();
  start();
  EXPECT_FALSE(assessed(host(kReference, "pc1", kUnknownClockError)).can_be_good());
  EXPECT_FALSE(fleet->assess_mirror(lidar, nullptr).can_be_good());
}

TEST_F(FleetClockTest, AHostWithThisKernelHasThisClock) {
  chronyd.stop();
  Result<clock::ClockPageWriter> page =
      clock::ClockPageWriter::open(std::filesystem::temp_directory_path() / "dssm-same-clock");
  std::filesystem::remove(std::filesystem::temp_directory_path() / "dssm-same-clock");
  fleet.emplace(loop,
                FleetClock::Options{{chronyd.address(), {}, clock::Instant::now, 50ms}, policies},
                *std::move(page), own, kSelf, catalog, logger);
  wire::ClockReport same;
  same.boot_id = clock::boot_id();
  EXPECT_TRUE(fleet->assess_mirror(lidar, &same).same_clock);
  EXPECT_EQ(fleet->distance_to(same), 0us);
}

TEST_F(FleetClockTest, PoliciesDecide) {
  policies.general.policy = ClockPolicy::mark;
  policies.exceptions = {{"lidar", ClockPolicy::off, 0us}, {"cam*", ClockPolicy::enforce, 5ms}};
  add_reference();
  start();
  const wire::Greeting owner = host(kReference, "pc1", 5us);
  EXPECT_EQ(assessed(owner).policy, ClockPolicy::off);
  EXPECT_EQ(fleet->assess_mirror({"odometry", 0, "pc1"}, owner.clock.get()).policy,
            ClockPolicy::mark);
  const ring::ClockAssessment camera =
      fleet->assess_mirror({"camera", 1, "pc1"}, owner.clock.get());
  EXPECT_EQ(camera.policy, ClockPolicy::enforce);
  EXPECT_EQ(camera.limit, 5ms);
}

TEST_F(FleetClockTest, ServesProgramsOfOtherPcsWhileItsClockIsGood) {
  tracking.leap = clock::Tracking::kUnsynchronized;
  start();
  wire::Greeting peer = host(kOther, "pc3", 5us);
  peer.features = {std::string(wire::kFeatureClock)};
  wire::Greeting program = host(kOther, "pc3", 5us);
  program.clock = nullptr;
  EXPECT_TRUE(fleet->check_serving(lidar, peer)) << "a dssmd assesses for itself";
  const Result<void> refused = fleet->check_serving(lidar, program);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::clock_out_of_bounds);
  EXPECT_NE(refused.error().message.find("not synchronised"), std::string::npos)
      << refused.error().message;
  tracking.leap = 0;
  wait([this] { return own->clock.status == ClockStatus::synchronized; });
  EXPECT_TRUE(fleet->check_serving(lidar, program));
  tracking.leap = clock::Tracking::kUnsynchronized;
  wait([this] { return own->clock.status == ClockStatus::out_of_bounds; });
  EXPECT_FALSE(fleet->check_serving(lidar, program)) << "who watches no clock cannot";
}

// --- measured by heartbeats

class MeasuredTest : public FleetClockTest {
 protected:
  // pc3, whose clock is `ahead` of this one and of which nothing else is known than what heartbeats
  // with a round trip of 100 us say.
  void heartbeat(Duration ahead, std::int64_t setting = 1, Duration bound = kUnknownClockError) {
    wire::Greeting other = host(kOther, "pc3", bound);
    other.clock = pc3 = answered(*other.clock, ahead, setting);
    if (!catalog.find(kOther)) catalog.host_up(other, {"10.0.0.3", 13776});
    catalog.set_clock(kOther, pc3);
  }
  // The reference, likewise.
  void heartbeat_of_reference(Duration ahead, Duration round_trip = 100us) {
    const wire::Greeting& reference = catalog.find(kReference)->greeting;
    catalog.set_clock(kReference, answered(*reference.clock, ahead, 1, round_trip));
  }
  static std::shared_ptr<const wire::ClockReport> answered(const wire::ClockReport& before,
                                                           Duration ahead, std::int64_t setting,
                                                           Duration round_trip = 100us) {
    auto report = std::make_shared<wire::ClockReport>(before);
    const clock::Instant now = later(round_trip);
    report->line = {now.raw, now.wall + ahead, 0, 10us};
    report->setting = setting;
    const RawTime there = now.raw - round_trip / 2;
    report->heartbeat = {now.raw - round_trip, there, there, now.raw};
    return report;
  }
  // Heartbeats from before its start count for nothing.
  static clock::Instant later(Duration round_trip = 100us) {
    std::this_thread::sleep_for(round_trip + 50us);
    return clock::Instant::now();
  }
  ring::ClockAssessment found() const { return fleet->assess_mirror(lidar, pc3.get()); }

  std::shared_ptr<const wire::ClockReport> pc3;
};

TEST_F(MeasuredTest, NeedsNoChronydAtAll) {
  chronyd.stop();
  follow_no_source();
  Result<clock::ClockPageWriter> page = clock::ClockPageWriter::open(folder() + "/clock");
  fleet.emplace(loop,
                FleetClock::Options{{chronyd.address(), {}, clock::Instant::now, 50ms}, policies},
                *std::move(page), own, kSelf, catalog, logger);
  wait([this] { return own->line.exists(); });
  const Time before = WallClock::now();
  heartbeat(200us);
  EXPECT_EQ(own->clock.bound, kUnknownClockError);
  EXPECT_TRUE(found().can_be_good());
  EXPECT_EQ(found().added, kUnknownClockError);
  EXPECT_GE(found().measured, 200us);
  EXPECT_GE(found().recent, 200us);
  EXPECT_LE(found().recent, 2ms);
  EXPECT_GE(found().recent_from, before + 200us) << "their clock is ahead";
  EXPECT_LT(fleet->distance_to(*pc3), kUnknownClockError);
  const SampleInfo sample{0, WallClock::now() + 1s, kUnknownClockError};
  EXPECT_TRUE(found().is_good(sample, MonoClock::now()));
}

TEST_F(MeasuredTest, AClockThatIsMeasuredToBeTooFarOffIsRefused) {
  start();
  heartbeat(50ms);
  EXPECT_GE(found().measured, 50ms);
  EXPECT_FALSE(found().can_be_good());
  const Error why = fleet->refusal(lidar, pc3.get());
  EXPECT_NE(why.message.find("1500 us are allowed"), std::string::npos) << why.message;
}

TEST_F(MeasuredTest, IsVoidAfterAStepThereUntilItWasMeasuredAgain) {
  start();
  heartbeat(0us, 1);
  EXPECT_TRUE(found().can_be_good());
  auto stepped = std::make_shared<wire::ClockReport>(*pc3);
  stepped->setting = 2;
  stepped->heartbeat.reset();
  pc3 = stepped;
  EXPECT_FALSE(found().can_be_good()) << "a channel may bring it first";
  catalog.set_clock(kOther, stepped);
  EXPECT_FALSE(found().can_be_good());
  heartbeat(0us, 2);
  EXPECT_TRUE(found().can_be_good());
}

TEST_F(MeasuredTest, AHeartbeatThatBringsANewSettingDoesNotConfirmIt) {
  start();
  heartbeat(0us, 1);
  heartbeat(0us, 2);  // that PC may have slept before it answered
  EXPECT_FALSE(found().can_be_good());
  catalog.set_clock(kOther, pc3);
  EXPECT_FALSE(found().can_be_good()) << "the same report again";
  heartbeat(0us, 2);
  EXPECT_TRUE(found().can_be_good());
}

TEST_F(MeasuredTest, AClockThatWasFarOffAMomentAgoCostsOnlyTheSamplesOfThatTime) {
  start();
  heartbeat(50ms);
  EXPECT_FALSE(found().can_be_good());
  const Time before = WallClock::now();
  heartbeat(100us);  // it was slewed
  EXPECT_TRUE(found().can_be_good());
  EXPECT_GT(found().measured_from, before);
}

// This one's was slow.
TEST_F(MeasuredTest, TheOtherHostsHeartbeatsCountToo) {
  start();
  wire::Greeting other = host(kOther, "pc3", kUnknownClockError);
  other.clock = pc3 = answered(*other.clock, 0us, 1, 20ms);
  catalog.host_up(other, {"10.0.0.3", 13776});
  catalog.set_clock(kOther, pc3);
  EXPECT_GE(fleet->distance_to(*pc3), 10ms);
  const auto return_one = [&](const wire::HostId& from) {
    const RawTime now = later().raw;
    fleet->add_returned_untrusted(from, {now - 100us, now - 50us, now - 50us, now});
  };
  return_one(kReference);  // which is not there
  EXPECT_GE(fleet->distance_to(*pc3), 10ms);
  return_one(kOther);
  EXPECT_LE(fleet->distance_to(*pc3), 5ms);
  auto stepped = std::make_shared<wire::ClockReport>(*pc3);
  stepped->setting = 2;
  stepped->heartbeat.reset();
  catalog.set_clock(kOther, stepped);
  return_one(kOther);
  EXPECT_EQ(fleet->distance_to(*stepped), kUnknownClockError) << "its clock may have stood still";
}

TEST_F(MeasuredTest, AHostThatReportsEverNewBootsFillsNoMoreThanTheTable) {
  start();
  heartbeat(0us);
  EXPECT_TRUE(found().can_be_good());
  for (std::size_t i = 0; i < FleetClock::kMaxPairs; ++i) {
    auto other = std::make_shared<wire::ClockReport>(*pc3);
    other->boot_id = "boot " + std::to_string(i);
    catalog.set_clock(kOther, other);
  }
  EXPECT_FALSE(found().can_be_good()) << "it made room for the last one";
  heartbeat(0us);
  EXPECT_TRUE(found().can_be_good());
}

TEST_F(MeasuredTest, TimesFromBeforeAStepThereAreNotMeasured) {
  start();
  heartbeat(0us);
  auto later = std::make_shared<wire::ClockReport>(*pc3);
  later->setting_from = WallClock::now() + 1h;  // it was set back by an hour
  EXPECT_EQ(fleet->assess_mirror(lidar, later.get()).measured_from, later->setting_from);
  EXPECT_EQ(fleet->assess_mirror(lidar, later.get()).recent_from, later->setting_from);
}

// So are the samples that it writes for an hour: what is stated of the host is what readers do.
TEST_F(MeasuredTest, AClockThatWasSetBackIsRefusedAsItsSamplesAre) {
  start();
  heartbeat(0us);
  EXPECT_FALSE(fleet->clock_pairs().at(0).refused);
  auto later = std::make_shared<wire::ClockReport>(*pc3);
  later->setting_from = WallClock::now() + 1h;
  later->heartbeat.reset();
  catalog.set_clock(kOther, pc3 = later);
  const ClockPair pair = fleet->clock_pairs().at(0);
  const SampleInfo sample{0, WallClock::now(), pc3->clock.bound};
  EXPECT_GT(fleet->assess_mirror(lidar, pc3.get()).distance(sample, MonoClock::now()), pair.limit);
  EXPECT_TRUE(pair.refused);
}

// For an hour it shows times that it showed before.
TEST_F(MeasuredTest, OfAClockThatWasSetBackNewSamplesAreToldFromEarlierOnesByTheirTids) {
  set_by = 1h;
  start();
  EXPECT_EQ(own->setting_from, Time());
  const std::int64_t earlier_setting = own->setting;
  set_by = 0h;
  wait([&] { return own->setting != earlier_setting; });
  const Time setting_from = own->setting_from;
  EXPECT_GT(setting_from, WallClock::now() + 59min);
  EXPECT_EQ(own->settled_from, Time()) << "programs may still write samples of the earlier setting";
  const int before = generations;
  passed = FleetClock::kWrittenWithin;
  wait([&] { return own->settled_from != Time(); });
  EXPECT_EQ(own->setting_from, setting_from);
  EXPECT_GE(own->settled_from, WallClock::now());
  EXPECT_LT(own->settled_from, WallClock::now() + 1min);
  EXPECT_EQ(generations, before + 1) << "others have to know before they get another sample";
}

TEST_F(MeasuredTest, TimesAreMeasuredFromWhenAClockThatWasSetBackHadSettled) {
  start();
  heartbeat(0us);
  auto later = std::make_shared<wire::ClockReport>(*pc3);
  later->setting_from = WallClock::now() + 1h;
  later->settled_from = WallClock::now() + 1min;
  EXPECT_EQ(fleet->assess_mirror(lidar, later.get()).measured_from, later->settled_from);
  EXPECT_EQ(fleet->assess_mirror(lidar, later.get()).recent_from, later->settled_from);
}

TEST_F(MeasuredTest, StatementsThatExcludeEachOtherAreRefused) {
  add_reference();
  start();
  wire::Greeting reference = host(kReference, "pc1", 5us);
  auto report = std::make_shared<wire::ClockReport>(*reference.clock);
  const clock::Instant now = later();
  report->line = {now.raw, now.wall + 1ms, 0, 10us};  // and chronyd states some 50 us
  report->setting = 1;
  EXPECT_TRUE(fleet->assess_mirror(lidar, report.get()).can_be_good());
  report->heartbeat = {now.raw - 100us, now.raw - 50us, now.raw - 50us, now.raw};
  catalog.set_clock(kReference, report);
  EXPECT_FALSE(fleet->assess_mirror(lidar, report.get()).can_be_good());
  EXPECT_EQ(fleet->distance_to(*report), kUnknownClockError);
  const Error why = fleet->refusal(lidar, report.get());
  EXPECT_NE(why.message.find("the heartbeats show"), std::string::npos) << why.message;
}

TEST_F(MeasuredTest, AStepOfTheReferenceTakesAwayWhatChronydStates) {
  add_reference();
  start();
  auto report = std::make_shared<wire::ClockReport>(*catalog.find(kReference)->greeting.clock);
  const clock::Instant now = clock::Instant::now();
  report->line = {now.raw, now.wall, 0, 10us};
  report->setting = 1;
  catalog.set_clock(kReference, report);
  EXPECT_TRUE(own->has_bound());
  report = std::make_shared<wire::ClockReport>(*report);
  report->setting = 2;
  const int before = generations;
  catalog.set_clock(kReference, report);
  EXPECT_FALSE(own->has_bound());
  EXPECT_EQ(own->clock.reason, ClockReason::stepped);
  EXPECT_GT(generations, before) << "others have to know";
  EXPECT_TRUE(logger.contains("the clock of 'pc1', which this PC's chronyd follows, was set"));
}

// The source follows another host from now on, which is far from the one that it followed before.
// chronyd here has not measured the source since, and nothing is measured with that host yet.
TEST_F(FleetClockTest, ACorrectionOfTheSourceCountsForAllThatIsKnownThroughIt) {
  constexpr wire::HostId kBack{4};
  catalog.host_up(host(kOther, "pc2", 5us), {"10.0.0.1", 13776});
  auto report = std::make_shared<wire::ClockReport>(*host(kOther, "pc2", 5us).clock);
  report->addresses = {kReferenceIp};
  report->corrected = 5ms;
  catalog.set_clock(kOther, report);
  start();
  const wire::Greeting back = host(kBack, "pc1", 5us);
  EXPECT_EQ(assessed(back).added, kUnknownClockError);
  const auto correct = [&](Duration to) {
    report = std::make_shared<wire::ClockReport>(*report);
    report->corrected = to;
    catalog.set_clock(kOther, report);
  };
  report->chain.push_back({kBack, 100us});
  correct(5ms);
  const Duration without = assessed(back).added;
  EXPECT_LT(without, 1ms);
  correct(1ms);  // dssmd there was restarted
  EXPECT_LT(assessed(back).added, without + 100us);
  correct(3200us);
  EXPECT_GE(assessed(back).added, without + 2100us);
  EXPECT_LT(assessed(back).added, without + 2300us);
  EXPECT_FALSE(fleet->reason_against(back.clock.get()).empty());
  EXPECT_FALSE(fleet->reason_against(report.get()).empty()) << "the source has moved, too";
}

TEST_F(FleetClockTest, ASourceThatWasBootedAnewMayHaveAnotherTime) {
  add_reference();
  start();
  ASSERT_TRUE(own->has_bound());
  wire::Greeting again = catalog.find(kReference)->greeting;
  catalog.host_down(kReference, Error{Errc::unavailable, "its power was cut"});
  auto report = std::make_shared<wire::ClockReport>(*again.clock);
  report->boot_id = "the next one";
  again.clock = report;
  catalog.host_up(again, {"10.0.0.1", 13776});
  EXPECT_EQ(own->clock.reason, ClockReason::stepped);
}

TEST_F(FleetClockTest, ReportsItsOwnCorrections) {
  start();
  EXPECT_EQ(own->corrected, 0us);
  Duration told{};
  fleet->on_new_generation([&] { told = own->corrected; });
  // To and fro, because an answer that comes late says too little. The status stays the same.
  wait([this] {
    tracking.offset = -1390us - tracking.offset;
    return own->corrected != 0us;
  });
  EXPECT_GE(own->corrected, 1300us);
  EXPECT_EQ(told, own->corrected) << "others have to know";
}

TEST_F(MeasuredTest, OwnReportsSayWhatTheClockShows) {
  start();
  const std::optional<Time> shown = own->line.at(RawClock::now());
  ASSERT_TRUE(shown);
  EXPECT_LT(std::chrono::abs(*shown - WallClock::now()), 1s);
  EXPECT_NE(own->setting, 0);
}

// What programs and the log are told must be what readers do: these differed, once.

TEST_F(FleetClockTest, RefusesForTheErrorOfItsSamplesEvenWhereItsClockIsNear) {
  add_follower(1200us);
  start();
  const wire::ClockReport& pc2 = *catalog.find(kOther)->greeting.clock;
  EXPECT_LT(fleet->distance_to(pc2), policies.general.limit);
  const SampleInfo latest{0, WallClock::now(), pc2.clock.bound};
  EXPECT_FALSE(fleet->assess_mirror(lidar, &pc2).is_good(latest, MonoClock::now()));
  EXPECT_TRUE(contains(fleet->reason_against(&pc2), "1500 us are allowed"));
  EXPECT_TRUE(fleet->refuses());
  EXPECT_TRUE(contains(fleet->refusal(lidar, &pc2).message, "1500 us are allowed"));
  policies.general.policy = ClockPolicy::mark;
  fleet->set(policies, 50'000);
  EXPECT_FALSE(fleet->reason_against(&pc2).empty());
  EXPECT_FALSE(fleet->refuses());
  policies.general.policy = ClockPolicy::off;
  fleet->set(policies, 50'000);
  EXPECT_EQ(fleet->reason_against(&pc2), "");
}

TEST_F(FleetClockTest, LogsThatItIsTooFarFromTheReferenceThoughNotFromItsSource) {
  add_follower(20us);
  start();
  EXPECT_EQ(own->anchor, kReference);
  EXPECT_EQ(own->clock.status, ClockStatus::synchronized);
  EXPECT_TRUE(logger.contains("this PC's clock is within"));
  set_follower(1490us);
  wait([this] { return own->clock.reason == ClockReason::too_far; });
  EXPECT_TRUE(logger.contains("more than its limit of 1.500 ms"));
}

TEST_F(FleetClockTest, LogsOfOtherHostsWhatReadersDoWhileThisClockIsBad) {
  add_reference();
  start();
  EXPECT_FALSE(logger.contains("'pc1''s samples"));
  tracking.leap = clock::Tracking::kUnsynchronized;
  wait([this] { return own->clock.bound == kUnknownClockError; });
  EXPECT_EQ(logger.warnings.back(),
            "the times of 'pc1''s samples are not good here: this PC's clock is out of bounds (not "
            "synchronised)");
  tracking.leap = 0;
  wait([this] { return own->clock.status == ClockStatus::synchronized; });
  EXPECT_EQ(logger.notices.back(), "the times of 'pc1''s samples are good here again");
  EXPECT_EQ(std::count_if(logger.lines.begin(), logger.lines.end(),
                          [](const std::string& line) { return contains(line, "'pc1''s"); }),
            2);
}

// --- pairs of clocks

TEST_F(FleetClockTest, StatesThePairWithAHostWhoseChainIsKnown) {
  add_reference();
  start();
  const ClockPair pair = fleet->clock_pairs().at(0);
  EXPECT_EQ(pair.reader, "") << "the host that asks sets it";
  EXPECT_EQ(pair.owner, "pc1");
  EXPECT_EQ(pair.basis, DistanceBasis::chain);
  EXPECT_GE(pair.bound, own->clock.bound + 5us);
  EXPECT_GE(pair.chain, own->clock.bound + 5us);
  EXPECT_LT(pair.chain, kUnknownClockError);
  EXPECT_EQ(pair.measured, kUnknownClockError);
  EXPECT_EQ(pair.round_trip, 0us);
  EXPECT_EQ(pair.limit, 1500us);
  EXPECT_EQ(pair.refused, !pair.reason.empty());
  EXPECT_EQ(pair.error, "");
}

TEST_F(FleetClockTest, ChecksThisClockBeforeItStatesPairs) {
  start();
  own->line = {};  // as if this clock had left it
  fleet->clock_pairs();
  EXPECT_TRUE(own->line.exists());
}

TEST_F(FleetClockTest, ReplacesALineWithMuchToleranceByABetterOneWithin) {
  start();
  const auto reading = clock::ClockReading::now();
  own->line = {reading.raw, reading.wall, 0, 50ms};  // as if reading the clocks took so long
  const int before = generations;
  fleet->set(policies, 50'000);
  EXPECT_LT(own->line.tolerance, 50ms * 3 / 4);
  EXPECT_EQ(generations, before) << "the line that the others have holds as well";
}

TEST_F(FleetClockTest, StatesTheErrorOfItsSamplesEvenWhereItsClockIsNear) {
  add_follower(1200us);
  start();
  EXPECT_LT(fleet->distance_to(*catalog.find(kOther)->greeting.clock), 1200us);
  const ClockPair pair = fleet->clock_pairs().at(0);
  EXPECT_GE(pair.bound, 1200us);
  EXPECT_GE(pair.chain, 1200us);
  EXPECT_TRUE(pair.refused);
  EXPECT_TRUE(contains(pair.reason, "1500 us are allowed")) << pair.reason;
}

TEST_F(MeasuredTest, StatesWhatIsMeasuredOfAHostWithoutAChain) {
  start();
  heartbeat(2ms);
  const ClockPair pair = fleet->clock_pairs().at(0);
  EXPECT_EQ(pair.owner, "pc3");
  EXPECT_EQ(pair.basis, DistanceBasis::measured);
  EXPECT_EQ(pair.chain, kUnknownClockError);
  EXPECT_GE(pair.measured, 2ms);
  EXPECT_LT(pair.measured, kUnknownClockError);
  EXPECT_GE(pair.bound, 2ms);
  EXPECT_LT(pair.bound, kUnknownClockError);
  EXPECT_EQ(pair.round_trip, 100us);
  EXPECT_TRUE(pair.refused);
}

TEST_F(MeasuredTest, StatesBothAndWhichOneCounts) {
  add_reference();
  start();
  heartbeat_of_reference(0us, 2ms);
  const ClockPair chained = fleet->clock_pairs().at(0);
  EXPECT_GE(chained.measured, 1ms);
  EXPECT_LT(chained.measured, kUnknownClockError);
  EXPECT_LT(chained.chain, chained.measured);
  EXPECT_EQ(chained.basis, DistanceBasis::chain);
  EXPECT_LT(chained.bound, chained.measured);
}

TEST_F(MeasuredTest, StatesNoBoundWhereStatementsExcludeEachOther) {
  add_reference();
  start();
  heartbeat_of_reference(10ms);
  const ClockPair pair = fleet->clock_pairs().at(0);
  EXPECT_EQ(pair.bound, kUnknownClockError);
  EXPECT_EQ(pair.basis, DistanceBasis::nothing);
  EXPECT_LT(pair.chain, 10ms);
  EXPECT_GE(pair.measured, 10ms);
  EXPECT_LT(pair.measured, kUnknownClockError);
  EXPECT_TRUE(pair.refused);
  EXPECT_TRUE(contains(pair.reason, "the heartbeats show")) << pair.reason;
}

TEST_F(MeasuredTest, LogsWhichClockDisagreesWithTheOthers) {
  add_reference();
  start();
  heartbeat(0us);
  heartbeat_of_reference(0us);
  wait([this] { return fleet->clock_pairs().size() == 2; });
  heartbeat_of_reference(10ms);
  wait([this] { return logger.contains("'pc1''s samples are not good here"); });
  EXPECT_TRUE(logger.warnings.back().ends_with("; those of 'pc3' are good"))
      << logger.warnings.back();
  heartbeat(20ms);
  wait([this] { return logger.contains("'pc3''s samples are not good here"); });
  EXPECT_TRUE(logger.warnings.back().ends_with("; those of no other host are good here either"))
      << logger.warnings.back();
}

TEST_F(FleetClockTest, StatesOneClockForAHostWithThisKernel) {
  start();
  wire::Greeting same = host(kOther, "pc2", kUnknownClockError);
  auto report = std::make_shared<wire::ClockReport>(*same.clock);
  report->boot_id = own->boot_id;
  same.clock = report;
  catalog.host_up(same, {"10.0.0.2", 13776});
  ClockPair expected;
  expected.owner = "pc2";
  expected.bound = 0us;
  expected.basis = DistanceBasis::one_clock;
  expected.limit = 1500us;
  EXPECT_EQ(fleet->clock_pairs(), std::vector{expected});
}

TEST_F(FleetClockTest, StatesThatItKnowsNothingOfAHostThatReportsNoClock) {
  policies.general = {ClockPolicy::mark, 2ms};
  start();
  wire::Greeting silent = host(kOther, "pc2", 5us);
  silent.clock = nullptr;
  catalog.host_up(silent, {"10.0.0.2", 13776});
  ClockPair expected;
  expected.owner = "pc2";
  expected.limit = 2ms;
  expected.reason = "nothing is known of its host's clock";
  EXPECT_EQ(fleet->clock_pairs(), std::vector{expected}) << "not refused, only marked";
}

TEST_F(FleetClockTest, ProgramsOfThisPcFindTheBoundOnThePage) {
  follow_no_source();
  start();
  const UniqueFd file = fleet->page_for_reading().value();
  const clock::ClockPage& page = **clock::map_clock_page_untrusted(file.get());
  EXPECT_EQ(clock::status_of(page), ClockStatus::synchronized);
  EXPECT_LT(clock::clock_error_at(page, WallClock::now()).value(), 1ms);
}

}  // namespace
}  // namespace dssm::daemon
