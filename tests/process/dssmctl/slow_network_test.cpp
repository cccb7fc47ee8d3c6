// SPDX-License-Identifier: Apache-2.0
//
// dssmctl where newer samples come before earlier ones, or instead of them.
#include "tests/process/dssmctl/ctl_test.hpp"
#include "tests/support/stream_owner.hpp"

namespace dssm::test {
namespace {

struct CtlOfASlowNetwork : WithStreamOwner, CtlTest {
  CtlOfASlowNetwork() : CtlTest({"--peer", owner.address()}) {}
  RawReader reader = session_.await_raw_reader({"late", 0, "fake"}, kNever).value();
};

TEST_F(CtlOfASlowNetwork, DelayIsOfWhatComesThoughEarlierSamplesAreStillToCome) {
  Running delay(argv({"delay", owner.stream(), "--json", "--interval", "0.05"}), environment());
  Tid tid = 0;
  Json report;
  do {
    report = Json::parse(delay.line([&] { owner.send_sample(2 * tid++); }));
  } while (report["samples"] < 3);
  EXPECT_GE(report["late_samples"], 2);
}

TEST_F(CtlOfASlowNetwork, HzSaysThatItWaitsForSamplesThatAreStillToCome) {
  Running hz(argv({"hz", owner.stream(), "--interval", "0.05"}), environment());
  const auto line_with = [&](const std::string& part) {
    std::string line = hz.line();
    while (!line.empty() && !contains(line, part)) line = hz.line();
    return line;
  };
  for (const Tid tid : {0, 1, 2}) owner.send_sample(tid);
  EXPECT_NE(line_with("average rate"), "");
  owner.send_sample(5);
  EXPECT_EQ(line_with("on their way"), "the next samples are on their way, newer ones are here");
}

}  // namespace
}  // namespace dssm::test
