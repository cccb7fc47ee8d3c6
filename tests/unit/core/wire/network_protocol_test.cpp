// SPDX-License-Identifier: Apache-2.0
#include "core/wire/network_protocol.hpp"

#include <gtest/gtest.h>

#include <fstream>

namespace dssm::wire {
namespace {

// As it is now; unknown: the greeting has no clock.
Duration reported_bound(const Greeting& greeting) {
  return greeting.clock ? greeting.clock->at(MonoClock::now()).clock.bound : kUnknownClockError;
}

Greeting mapper() {
  Greeting greeting;
  greeting.host = "pc3";
  greeting.host_id = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16};
  greeting.instance_id = 77;
  greeting.program = "mapper";
  greeting.version = "0.1.0";
  greeting.features = {"torn", "other"};
  auto clock = std::make_shared<ClockReport>();
  clock->anchor = greeting.host_id;
  clock->clock.bound = std::chrono::microseconds(250);
  clock->as_of = MonoClock::now();
  clock->line = {RawTime(std::chrono::seconds(5)), Time(std::chrono::hours(9)), -7,
                 std::chrono::microseconds(12)};
  clock->setting = 3;
  clock->setting_from = Time(std::chrono::hours(8));
  clock->settled_from = Time(std::chrono::hours(7));
  clock->corrected = Duration(8);
  greeting.clock = clock;
  return greeting;
}

proto::Hello hello() {
  proto::Hello message;
  to_message(mapper(), message);
  return message;
}

// Checks that the greeting is refused with a text that holds `why`.
void expect_refused(const proto::Hello& message, const std::string& why) {
  const auto greeting = greeting_untrusted(message, "the program at '10.0.0.3:4'");
  ASSERT_FALSE(greeting) << why;
  EXPECT_EQ(greeting.error().code, Errc::protocol);
  EXPECT_NE(greeting.error().message.find("the program at '10.0.0.3:4'"), std::string::npos);
  EXPECT_NE(greeting.error().message.find(why), std::string::npos) << greeting.error().message;
}

TEST(Greeting, CrossesTheWire) {
  const auto back = greeting_untrusted(hello(), "x");
  ASSERT_TRUE(back) << back.error().message;
  EXPECT_EQ(back->host, "pc3");
  EXPECT_EQ(back->host_id, mapper().host_id);
  EXPECT_EQ(back->instance_id, 77u);
  EXPECT_EQ(back->program, "mapper");
  EXPECT_EQ(back->version, "0.1.0");
  EXPECT_EQ(back->features, mapper().features);
  EXPECT_EQ(reported_bound(*back), std::chrono::microseconds(250)) << "it does not age";
  EXPECT_EQ(back->clock->line, mapper().clock->line);
  EXPECT_EQ(back->clock->setting, mapper().clock->setting);
  EXPECT_EQ(back->clock->setting_from, mapper().clock->setting_from);
  EXPECT_EQ(back->clock->settled_from, mapper().clock->settled_from);
  EXPECT_EQ(back->clock->corrected, mapper().clock->corrected);
  EXPECT_EQ(back->pid, 0) << "an older program";
  proto::Hello with_pid = hello();
  with_pid.set_pid(4711);
  EXPECT_EQ(greeting_untrusted(with_pid, "x")->pid, 4711);
  with_pid.set_pid(-4711);
  EXPECT_EQ(greeting_untrusted(with_pid, "x")->pid, 0);
  EXPECT_TRUE(back->has_feature(kFeatureTorn));
  EXPECT_FALSE(back->has_feature("tor"));
  EXPECT_EQ(back->str(), "'mapper' on host 'pc3'");
  Greeting daemon = mapper();
  daemon.program = "dssmd";
  EXPECT_EQ(daemon.str(), "dssmd of host 'pc3'");
}

TEST(Greeting, NamesBothVersionsAndBothSidesWhenTheyDiffer) {
  proto::Hello message = hello();
  message.set_protocol_version(9);
  message.set_version("7.1.0");
  message.clear_host_id();  // whatever else changed: the version is what counts
  expect_refused(message, "speaks version 9 of the network protocol (DSSM 7.1.0)");
  expect_refused(message, "version 1; install the same DSSM on both");
  message.set_version("\n");
  expect_refused(message, "speaks version 9 of the network protocol, this side");
  expect_refused(proto::Hello(), "speaks version 0");
}

TEST(Greeting, ChecksEveryValue) {
  proto::Hello message = hello();
  for (const char* host : {"", "pc.3", "pc 3", "\xc3\xa4", "a-name-of-thirty-two-characters-x"}) {
    message.set_host(host);
    expect_refused(message, "a host name");
  }
  message = hello();
  message.set_host_id("123456789012345");
  expect_refused(message, "a host id of 15 bytes");
  message = hello();
  message.set_program(std::string(128, 'x'));
  expect_refused(message, "127 bytes");
  message.set_program("ma\npper");
  expect_refused(message, "control characters");
  message = hello();
  message.set_version("\x1b[31m");
  expect_refused(message, "control characters");
  message = hello();
  for (std::size_t i = 0; i < kMaxFeatures; ++i) message.add_features("x");
  expect_refused(message, "more than 32 features");
  for (const std::string& feature : {std::string(), std::string(64, 'x'), std::string("\t")}) {
    message = hello();
    message.add_features(feature);
    expect_refused(message, "a feature");
  }
}

TEST(Greeting, TakesValuesAtTheirLimits) {
  proto::Hello message = hello();
  message.set_host(std::string(31, 'z'));
  message.set_program(std::string(127, 'x'));
  message.clear_features();
  for (std::size_t i = 0; i < kMaxFeatures; ++i) message.add_features(std::string(63, 'x'));
  EXPECT_TRUE(greeting_untrusted(message, "x"));
}

TEST(Greeting, LeavesOutTheClockUnlessItIsKnown) {
  proto::Hello message = hello();
  message.clear_clock();
  EXPECT_EQ(reported_bound(*greeting_untrusted(message, "x")), kUnknownClockError);
  message = hello();
  message.mutable_clock()->set_bound_ns(-1);
  EXPECT_EQ(reported_bound(*greeting_untrusted(message, "x")), kUnknownClockError);
}

TEST(HostId, DiffersBetweenNamesAndStaysTheSame) {
  EXPECT_EQ(host_id_for("pc1"), host_id_for("pc1"));
  EXPECT_NE(host_id_for("pc1"), host_id_for("pc2"));
  EXPECT_NE(host_id_for("pc1"), host_id_for(""));
  EXPECT_NE(host_id_for("pc1"), HostId{});
}

TEST(HostId, DoesNotRevealTheMachineId) {
  std::string machine;
  std::getline(std::ifstream("/etc/machine-id"), machine);
  if (machine.size() != 32) GTEST_SKIP() << "this machine has no id";
  HostId raw{};
  for (std::size_t i = 0; i < raw.size(); ++i) {
    raw[i] = static_cast<std::uint8_t>(std::stoul(machine.substr(2 * i, 2), nullptr, 16));
  }
  EXPECT_NE(host_id_for(""), raw);
}

TEST(HostId, IsLastingWhereThisMachineHasAnId) {
  std::string machine;
  std::getline(std::ifstream("/etc/machine-id"), machine);
  EXPECT_EQ(has_lasting_host_id(), machine.size() == 32);
}

TEST(RandomNumber, IsNeverTwiceTheSame) {
  const std::uint64_t first = random_number();
  EXPECT_NE(first, 0u);
  EXPECT_NE(first, random_number());
}

}  // namespace
}  // namespace dssm::wire
