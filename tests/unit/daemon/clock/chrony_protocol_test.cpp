// SPDX-License-Identifier: Apache-2.0
//
// chronyd's command protocol byte by byte: requests, replies recorded from a real chronyd, and
// replies that are cut, changed or random.
#include "daemon/clock/chrony_protocol.hpp"

#include <cstdlib>
#include <random>

#include "tests/support/sanitized.hpp"
#include "tests/unit/daemon/clock/fake_chronyd.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

constexpr std::uint32_t kSequence = 0x11223344;  // of real_reply()

// What a reply means in which one number was replaced.
template <class Number>
Result<TrackingReply> with(std::size_t at, Number number) {
  Datagram reply = real_reply();
  put_number(reply, at, number);
  return tracking_untrusted(reply);
}

template <class Number>
void expect_refused(std::size_t at, Number number, Errc code, const std::string& text) {
  const Result<TrackingReply> reply = with(at, number);
  ASSERT_FALSE(reply) << text;
  EXPECT_EQ(reply.error().code, code) << reply.error().message;
  EXPECT_NE(reply.error().message.find(text), std::string::npos) << reply.error().message;
}

TEST(ChronyProtocol, SendsTheRequestsOfChronyc) {
  // chronyc 4.3 sends these 20 bytes and pads them.
  constexpr std::array<int, 20> kHead{6, 1, 0, 0, 0, 33, 0, 0, 0x11, 0x22, 0x33, 0x44};
  const auto request = tracking_request(kSequence);
  for (std::size_t i = 0; i < request.size(); ++i) {
    EXPECT_EQ(std::to_integer<int>(request[i]), i < kHead.size() ? kHead[i] : 0) << "byte " << i;
  }
}

TEST(ChronyProtocol, ReadsARealReply) {
  const Datagram bytes = real_reply();
  ASSERT_TRUE(answers_untrusted(bytes, kSequence));
  const TrackingReply reply = tracking_untrusted(bytes).value();
  const clock::Tracking& tracking = reply.tracking;
  ASSERT_TRUE(reply.source);
  EXPECT_EQ(reply.source->str(), "127.0.0.1");
  EXPECT_EQ(tracking.reference_id, 0x7f000001u);
  EXPECT_EQ(tracking.stratum, 11);
  EXPECT_EQ(tracking.leap, 0);
  EXPECT_EQ(to_ns(tracking.updated), 1795323571'059992969);
  EXPECT_EQ(to_ns(tracking.root.delay), 3630) << "3.629 us";
  EXPECT_GE(to_ns(tracking.root.dispersion), 1850);
  EXPECT_LE(to_ns(tracking.root.dispersion), 2503);
  EXPECT_GE(to_ns(tracking.offset), 285) << "fast, so ahead";
  EXPECT_LE(to_ns(tracking.offset), 383);
  EXPECT_NEAR(static_cast<double>(tracking.update_interval.count()), 1e9, 5e7);
  EXPECT_EQ(tracking.rate_ppb, 287);
  EXPECT_EQ(with(kReplyFrequency, chrony_float(12.5)).value().tracking.rate_ppb, -12'500)
      << "12.5 ppm fast, so chronyd's time runs slower than the oscillator";
  EXPECT_EQ(with(kReplyFrequency, chrony_float(-0.25)).value().tracking.rate_ppb, 250);
}

TEST(ChronyProtocol, DecodesTheSourceOfChronyd) {
  const auto source = [](std::uint16_t family, std::vector<std::uint32_t> words) {
    Datagram reply = real_reply();
    put_number(reply, kReplyFamily, family);
    for (std::size_t i = 0; i < words.size(); ++i)
      put_number(reply, kReplyAddress + 4 * i, words[i]);
    return tracking_untrusted(reply).value().source;
  };
  const auto address = [](const char* text) {
    return wire::IpAddress::of(wire::resolve_number(wire::Address::parse(text).value()).at(0));
  };
  EXPECT_EQ(source(0, {0x0a000001}), std::nullopt);
  EXPECT_EQ(source(1, {0x0a000001}), address("10.0.0.1"));
  EXPECT_EQ(source(1, {0x0a000001}), address("[::ffff:10.0.0.1]:1"));
  EXPECT_EQ(source(2, {0xfd770000, 0, 0, 1}), address("fd77::1"));
  EXPECT_EQ(source(2, {0xfd770000, 0, 0, 1})->str(), "fd77::1");
  EXPECT_NE(source(1, {0x0a000001}), address("10.0.0.2"));
  EXPECT_EQ(source(3, {7}), std::nullopt) << "a source that waits for its address";
  EXPECT_EQ(wire::IpAddress::of({}), std::nullopt);
  expect_refused(kReplyFamily, std::uint16_t{4}, Errc::protocol, "family 4");
}

TEST(ChronyProtocol, LeavesAloneWhatIsNoAnswer) {
  Datagram reply = real_reply();
  EXPECT_FALSE(answers_untrusted(reply, kSequence + 1));
  EXPECT_TRUE(answers_untrusted(std::span(reply).first(28), kSequence)) << "refusals are so short";
  EXPECT_FALSE(answers_untrusted(std::span(reply).first(27), kSequence));
  EXPECT_FALSE(answers_untrusted({}, 0));
  put_number(reply, kReplyType, std::uint8_t{1});
  EXPECT_FALSE(answers_untrusted(reply, kSequence)) << "a request";
}

TEST(ChronyProtocol, RefusesRepliesThatItDoesNotKnow) {
  expect_refused(kReplyVersion, std::uint8_t{5}, Errc::protocol, "version 5");
  expect_refused(kReplyType, std::uint8_t{1}, Errc::protocol, "type 1");
  expect_refused(kReplyCommand, std::uint16_t{34}, Errc::protocol, "command 34");
  expect_refused(kReplyKind, std::uint16_t{6}, Errc::protocol, "kind 6");
  expect_refused(kReplyNanoseconds, std::uint32_t{1'000'000'000}, Errc::protocol,
                 "1000000000 nano");
  EXPECT_TRUE(with(kReplyNanoseconds, std::uint32_t{999'999'999}));
  Datagram longer = real_reply();
  longer.resize(longer.size() + 1);
  for (std::size_t size = 0; size <= longer.size(); ++size) {
    const Result<TrackingReply> reply = tracking_untrusted(std::span(longer).first(size));
    EXPECT_EQ(reply.has_value(), size == kTrackingBytes) << size;
    if (!reply) {
      EXPECT_EQ(reply.error().code, Errc::protocol) << size;
    }
  }
}

TEST(ChronyProtocol, ReportsWhyChronydRefuses) {
  expect_refused(kReplyStatus, std::uint16_t{1}, Errc::system, "status 1;");
  expect_refused(kReplyStatus, std::uint16_t{2}, Errc::no_permission, "cmdallow");
  expect_refused(kReplyStatus, std::uint16_t{3}, Errc::protocol, "does not know the question");
  expect_refused(kReplyStatus, std::uint16_t{6}, Errc::system, "not enabled");
  expect_refused(kReplyStatus, std::uint16_t{10}, Errc::no_permission, "cmdallow");
  expect_refused(kReplyStatus, std::uint16_t{18}, Errc::protocol, "another version");
  expect_refused(kReplyStatus, std::uint16_t{19}, Errc::protocol, "another version");
  expect_refused(kReplyStatus, std::uint16_t{65535}, Errc::system, "status 65535;");
  // As chronyd 4.3 answered to a request that was a byte too short.
  Datagram reply = real_reply();
  reply.resize(28);
  put_number(reply, kReplyKind, std::uint16_t{1});
  put_number(reply, kReplyStatus, std::uint16_t{19});
  EXPECT_NE(tracking_untrusted(reply).error().message.find("refuses"), std::string::npos);
}

TEST(ChronyProtocol, ReadsTimesOfAnyAge) {
  const auto updated = [](std::uint32_t high, std::uint32_t low) {
    return to_ns(with(kReplySeconds, std::uint64_t{high} << 32 | low).value().tracking.updated);
  };
  constexpr std::int64_t kRest = 59992969;
  EXPECT_EQ(updated(0, 0), kRest);
  EXPECT_EQ(updated(1, 0), (std::int64_t{1} << 32) * 1'000'000'000 + kRest);
  EXPECT_EQ(updated(0x7fffffff, 5), 5'000'000'000 + kRest) << "a chronyd with 32 bits";
  EXPECT_GT(updated(0x7ffffffe, 0), 9'000'000'000'000'000'000);
  EXPECT_GT(updated(0xffffffff, 0xffffffff), 9'000'000'000'000'000'000);
}

TEST(ChronyProtocol, RoundsAwayFromZero) {
  const auto ns = [](std::int32_t coefficient, int exponent) {
    return to_ns(seconds_untrusted(chrony_float(coefficient, exponent)));
  };
  constexpr std::int64_t kMax = std::numeric_limits<std::int64_t>::max();
  EXPECT_EQ(ns(0, 0), 0) << "a clock that needs no correction";
  EXPECT_EQ(ns(0, 63), 0);
  // 1 s, and one unit of 2^-23 s for what chronyd rounded.
  EXPECT_EQ(ns(1 << 23, 2), 1'000'000'120);
  EXPECT_EQ(ns(-(1 << 23), 2), -1'000'000'120);
  EXPECT_EQ(ns((1 << 24) - 1, 1), 1'000'000'000);
  EXPECT_EQ(ns(-(1 << 24), -1), -250'000'015) << "as chronyd 4.3 writes a quarter of a second";
  EXPECT_EQ(ns(1, -64), 1) << "less than a nanosecond";
  EXPECT_EQ(ns(-1, -64), -1);
  EXPECT_EQ(ns((1 << 24) - 1, -37), 1);
  EXPECT_EQ(ns((1 << 24) - 1, -64), 1);
  EXPECT_EQ(ns(1, 25), 2'000'000'000);
  EXPECT_EQ(ns((1 << 24) - 1, 63), kMax);
  EXPECT_EQ(ns(-(1 << 24), 63), -kMax);
  EXPECT_EQ(ns(1, 63), kMax) << "17,000 years";
}

std::uint32_t first_chrony_seed() {
  const char* text = std::getenv("DSSM_TEST_SEED");
  return text ? static_cast<std::uint32_t>(std::strtoul(text, nullptr, 10)) : 1;
}

TEST(ChronyProtocol, NeverMakesANumberSmaller) {
  SCOPED_TRACE("DSSM_TEST_SEED=" + std::to_string(first_chrony_seed()));
  std::mt19937 random(first_chrony_seed());
  std::uniform_real_distribution<double> digits(-18, 9);
  for (int i = 0; i < 100'000; ++i) {
    const double seconds = std::pow(10, digits(random)) * (i % 2 ? 1 : -1);
    const Duration read = seconds_untrusted(chrony_float(seconds));
    const double exact = std::fabs(seconds) * 1e9,
                 size = std::fabs(static_cast<double>(read.count()));
    EXPECT_EQ(read > Duration::zero(), seconds > 0) << seconds;
    EXPECT_GE(size, exact) << seconds;
    EXPECT_LE(size, exact * (1 + 3e-7) + 1) << seconds;
  }
}

TEST(ChronyProtocol, SurvivesAnyBytes) {
  SCOPED_TRACE("DSSM_TEST_SEED=" + std::to_string(first_chrony_seed()));
  std::mt19937 random(first_chrony_seed());
  int read = 0;
  for (int i = 0; i < (test::kIsSanitized ? 10'000 : 100'000); ++i) {  // there is a fuzzer, too
    Datagram bytes = real_reply();
    for (auto changes = random() % 20; changes > 0; --changes) {
      // Mostly in the report, so that many get that far.
      bytes[random() % 8 ? 28 + random() % 76 : random() % 104] = static_cast<std::byte>(random());
    }
    if (random() % 8 == 0) bytes.resize(random() % 200);
    answers_untrusted(bytes, kSequence);
    const Result<TrackingReply> reply = tracking_untrusted(bytes);
    if (!reply) {
      EXPECT_FALSE(reply.error().message.empty());
      continue;
    }
    ++read;
    EXPECT_FALSE(reply->source && reply->source->str().empty());
    // Whatever was read, the estimator states no bound below what it was told, or none.
    clock::ClockEstimator estimator{clock::ClockEstimator::Settings{}};
    const clock::Instant now{MonoTime(1000s), time_from_ns(1795323571'500000000), {}};
    estimator.observe(now);
    const auto outcome = estimator.take_untrusted(reply->tracking, now.mono, now);
    const ClockSnapshot state = estimator.at(now.mono);
    if (outcome != clock::ClockEstimator::Outcome::taken) continue;
    EXPECT_GE(state.bound, std::chrono::abs(reply->tracking.offset));
  }
  EXPECT_GT(read, 1000);
}

}  // namespace
}  // namespace dssm::daemon
