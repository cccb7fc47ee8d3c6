// SPDX-License-Identifier: Apache-2.0
//
// What a host states of the clocks of others, on the wire. Its own report is in
// network_protocol_test.cpp.
#include "core/wire/clock_report.hpp"

#include <gtest/gtest.h>

#include "core/wire/messages.hpp"

namespace dssm::wire {
namespace {

using namespace std::chrono_literals;

TEST(ClockPair, CrossesTheWire) {
  ClockPair pair;
  pair.reader = "pc1";
  pair.owner = "pc2";
  pair.reason = "too far";
  pair.refused = true;
  pair.bound = 4ms;
  pair.basis = DistanceBasis::measured;
  pair.chain = 5ms;
  pair.measured = 6ms;
  pair.round_trip = 70us;
  pair.limit = 1500us;
  pair.error = "not known";
  proto::ClockPair message;
  to_message(pair, message);
  EXPECT_EQ(clock_pair_untrusted(message), pair);
  to_message(ClockPair(), message);
  EXPECT_EQ(clock_pair_untrusted(message), ClockPair()) << "unknown stays unknown";
}

TEST(ClockPair, TakesNothingThatCannotBe) {
  proto::ClockPair message;
  message.set_reader("pc1\n");
  message.set_owner(std::string(32, 'p'));
  message.set_basis(static_cast<std::uint32_t>(DistanceBasis::one_clock) + 1);
  message.set_bound_ns(-1);
  message.set_chain_ns(-1);
  message.set_measured_ns(INT64_MIN);
  message.set_round_trip_ns(-1);
  message.set_limit_ns(-1);
  EXPECT_EQ(clock_pair_untrusted(message), ClockPair());
}

TEST(ClockPair, TakesPrintableTextOfLimitedLength) {
  proto::ClockPair message;
  message.set_reason("\x1b[31m");
  message.set_error(std::string(kMaxSentenceBytes + 1, 'x'));
  const ClockPair pair = clock_pair_untrusted(message);
  EXPECT_EQ(pair.reason, "?[31m");
  EXPECT_EQ(pair.error.size(), kMaxSentenceBytes);
}

TEST(TextUntrusted, EndsBeforeACharacterThatIsCutOrInvalid) {
  EXPECT_EQ(text_untrusted("caf\xc3\xa9", 5), "caf\xc3\xa9");
  EXPECT_EQ(text_untrusted("caf\xc3\xa9", 4), "caf");
  EXPECT_EQ(text_untrusted("\xff", 4), "");
}

}  // namespace
}  // namespace dssm::wire
