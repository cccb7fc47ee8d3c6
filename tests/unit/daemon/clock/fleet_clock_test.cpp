// SPDX-License-Identifier: Apache-2.0
//
// This PC's clock among others, which the test puts into the catalog, with a chronyd that says what
// the test wants.
#include "daemon/clock/fleet_clock.hpp"

#include <filesystem>

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
    fleet.emplace(loop,
                  FleetClock::Options{{chronyd.address(), {}, clock::Instant::now, 50ms}, policies},
                  *std::move(page), own, kSelf, catalog, logger);
    fleet->on_new_generation([this] { ++generations; });
    wait([this] { return own->clock.status != ClockStatus::unknown; });
    return *fleet;
  }
  void wait(const std::function<bool()>& done) { run_until(loop, done); }
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
  ring::ClockAssessment assessed(const wire::Greeting& owner) const {
    return fleet->assess_mirror(lidar, owner.clock.get());
  }

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

TEST_F(FleetClockTest, OwnStreamsThatOthersWriteToAreAsFarOffAsThisClock) {
  EXPECT_FALSE(FleetClockTest::start().assess_own(lidar).added == kUnknownClockError);
  const ring::ClockAssessment known = fleet->assess_own(lidar);
  EXPECT_EQ(known.policy, ClockPolicy::enforce);
  EXPECT_GE(known.added, own->clock.bound);
  EXPECT_EQ(known.limit, policies.general.limit - known.added);
  tracking.leap = clock::Tracking::kUnsynchronized;
  wait([this] { return own->clock.bound == kUnknownClockError; });
  EXPECT_LT(fleet->assess_own(lidar).limit, 0ns);
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
  EXPECT_EQ(found.limit, 1500us - found.added);
  EXPECT_GE(found.added, own->clock.bound);
  EXPECT_LT(found.added, own->clock.bound + 200us);
}

TEST_F(FleetClockTest, NothingIsGoodOfAHostThatFollowsAnotherReference) {
  add_reference();
  start();
  EXPECT_LT(assessed(host(kOther, "pc3", 5us)).limit, 0us);
  const Error why = fleet->refusal(lidar, host(kOther, "pc3", 5us).clock.get());
  EXPECT_EQ(why.code, Errc::clock_out_of_bounds);
  EXPECT_NE(why.message.find("follow different references"), std::string::npos) << why.message;
}

TEST_F(FleetClockTest, NothingIsGoodOfAHostWhoseClockIsUnknown) {
  add_reference();
  start();
  EXPECT_LT(assessed(host(kReference, "pc1", kUnknownClockError)).limit, 0us);
  EXPECT_LT(fleet->assess_mirror(lidar, nullptr).limit, 0us);
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
  EXPECT_EQ(camera.limit, 5ms - camera.added);
}

TEST_F(FleetClockTest, ServesOthersFromWhenTheClockWasFirstKnown) {
  tracking.leap = clock::Tracking::kUnsynchronized;
  start();
  const wire::Greeting peer = host(kOther, "pc3", 5us);
  const Result<void> refused = fleet->check_serving(lidar, peer);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::clock_out_of_bounds);
  EXPECT_NE(refused.error().message.find("not synchronised"), std::string::npos)
      << refused.error().message;
  tracking.leap = 0;
  wait([this] { return own->clock.status == ClockStatus::synchronized; });
  EXPECT_TRUE(fleet->check_serving(lidar, peer));
  wire::Greeting program = peer;
  program.clock = nullptr;
  EXPECT_TRUE(fleet->check_serving(lidar, program));
  tracking.leap = clock::Tracking::kUnsynchronized;
  wait([this] { return own->clock.status == ClockStatus::out_of_bounds; });
  EXPECT_TRUE(fleet->check_serving(lidar, peer)) << "a dssmd assesses for itself";
  EXPECT_FALSE(fleet->check_serving(lidar, program)) << "who watches no clock cannot";
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
