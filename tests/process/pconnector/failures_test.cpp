// SPDX-License-Identifier: Apache-2.0
//
// PConnector against a fake dssmd: refusals, garbage, broken connections, samples that come in
// pieces or at a bad moment. What a real dssmd does is in the other tests of this folder.
#include <gtest/gtest.h>
#include <poll.h>
#include <signal.h>
#include <sys/time.h>

#include <dssm/pconnector.hpp>
#include <future>
#include <optional>
#include <thread>

#include "core/wire/tcp.hpp"
#include "tests/support/await.hpp"
#include "tests/support/network_peer.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// A sample of 8 bytes as the fake sends it: its tid, in digits.
std::string text_of(std::int64_t tid) {
  std::string text = std::to_string(tid);
  return std::string(8 - text.size(), '0') + text;
}

// A sample as expect_sample() expects it.
void send_sample(NetworkPeer& peer, std::int64_t tid, const std::string& payload,
                 std::uint64_t serial = 0, bool torn = false) {
  const Bytes bytes = sample_bytes({tid, time_from_ns(tid * 10), 7ns}, to_bytes(payload), serial,
                                   torn ? std::optional(true) : std::nullopt);
  peer.send_bytes({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
}

struct TakenSample {
  std::string bytes = std::string(8, '?');
  SampleInfo info;
  std::span<std::byte> span() { return std::as_writable_bytes(std::span(bytes)); }
};

Result<PConnector> open(const ScriptedDaemon& daemon, const TypeInfo* wanted = nullptr) {
  return PConnector::open({"lidar", 0, {}}, {.address = daemon.address(), .request_timeout = 60s},
                          wanted);
}

// Tried again for as long as a busy fake is later than `request_timeout`.
PConnector open_impatient(const ScriptedDaemon& daemon, Duration request_timeout) {
  std::optional<PConnector> con;
  await([&] {
    auto opened = PConnector::open(
        {"lidar", 0, {}}, {.address = daemon.address(), .request_timeout = request_timeout});
    if (opened) con = std::move(*opened);
    return con.has_value();
  });
  return std::move(*con);
}

void expect_sample(PConnector& con, std::int64_t tid) {
  TakenSample sample;
  for (;;) {
    const WaitStatus waited = con.wait(kNever);
    ASSERT_EQ(waited, WaitStatus::ready);
    const auto status = con.read_next(sample.span(), sample.info);
    ASSERT_TRUE(status) << status.error().message;
    if (*status == ReadStatus::not_yet) continue;
    ASSERT_EQ(*status, ReadStatus::ok);
    break;
  }
  EXPECT_EQ(sample.info.tid, tid);
  EXPECT_EQ(sample.info.time, time_from_ns(tid * 10));
  EXPECT_EQ(sample.info.clock_error, 7ns);
  EXPECT_EQ(sample.bytes, text_of(tid));
}

void expect_words(const Error& error, Errc code, const std::vector<std::string>& words) {
  EXPECT_EQ(name_of(error.code), name_of(code)) << error.message;
  for (const std::string& word : words) {
    EXPECT_NE(error.message.find(word), std::string::npos) << word << "\n" << error.message;
  }
}

// --- opening

TEST(PConnectorOpen, ReportsThatNoProcessListens) {
  // A port that was ours a moment ago.
  std::string address;
  {
    const auto any = wire::Address::parse("127.0.0.1:0", wire::kDefaultPort, true).value();
    const UniqueFd socket = wire::listen_tcp(wire::resolve_number(any).at(0)).value();
    address = wire::local_address(socket.get())->str();
  }
  const auto con = PConnector::open({"lidar", 1, {}}, {.address = address});
  ASSERT_FALSE(con);
  expect_words(con.error(), Errc::no_daemon, {"lidar:1", address, "refused", "dssmd"});
}

TEST(PConnectorOpen, RefusesInvalidAddressesNamesAndTypes) {
  const auto port = PConnector::open({"lidar", 0, {}}, {.address = "127.0.0.1:99999"});
  expect_words(port.error(), Errc::invalid_argument, {"99999"});
  const auto name = PConnector::open({"li:dar", 0, {}}, {.address = "127.0.0.1"});
  expect_words(name.error(), Errc::invalid_argument, {"li:dar"});
  const auto type = PConnector::create({"lidar", 0, {}}, TypeInfo{}, {16, 1ms});
  EXPECT_EQ(type.error().code, Errc::invalid_argument);
}

TEST(PConnectorOpen, TakesThePortFromTheEnvironment) {
  const ScriptedDaemon daemon(
      [](NetworkPeer& peer, int) { peer.answer_open(8), peer.await_end(); });
  const std::string port = daemon.address().substr(daemon.address().find(':') + 1);
  ::setenv("DSSM_PORT", port.c_str(), 1);
  const auto con = PConnector::open({"lidar", 0, {}}, {.address = "127.0.0.1"});
  ::setenv("DSSM_PORT", "many", 1);
  const auto bad = PConnector::open({"lidar", 0, {}});
  ::unsetenv("DSSM_PORT");
  EXPECT_TRUE(con) << con.error().message;
  expect_words(bad.error(), Errc::invalid_argument, {"DSSM_PORT", "many"});
}

TEST(PConnectorOpen, ReportsWhyDssmdRefuses) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.try_receive();
    peer.send(failure_frame(Errc::limit_exceeded, "256 connections are the limit"));
  });
  const auto con = open(daemon);
  ASSERT_FALSE(con);
  expect_words(con.error(), Errc::limit_exceeded,
               {"lidar", daemon.address(), "256 connections are the limit"});
}

TEST(PConnectorOpen, ReportsThatThereIsNoSuchStream) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.answer_hello();
    peer.refuse(Errc::not_found, "no stream 'lidar:0' on host 'fake'");
    peer.await_end();
  });
  const auto con = open(daemon);
  ASSERT_FALSE(con);
  expect_words(con.error(), Errc::not_found, {"no stream 'lidar:0' on host 'fake'"});
}

TEST(PConnectorOpen, NamesBothTypesWhenTheyDiffer) {
  const ScriptedDaemon daemon(
      [](NetworkPeer& peer, int) { peer.answer_open(8, 1, "Scan"), peer.await_end(); });
  const TypeInfo size{"Scan", 16, 1, {}}, name{"Image", 8, 1, {}}, same{"Scan", 8, 1, {}};
  expect_words(open(daemon, &size).error(), Errc::type_mismatch, {"8 bytes", "16 bytes"});
  expect_words(open(daemon, &name).error(), Errc::type_mismatch, {"Scan", "Image"});
  EXPECT_TRUE(open(daemon, &same));
}

TEST(PConnectorOpen, RefusesAnotherVersionNamingBoth) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.try_receive();
    wire::Greeting greeting = greeting_of("future");
    greeting.version = "7.7";
    peer.send(hello_frame(greeting, 9));
    peer.await_end();
  });
  const auto con = open(daemon);
  ASSERT_FALSE(con);
  expect_words(con.error(), Errc::protocol, {daemon.address(), "version 9", "version 1", "7.7"});
}

TEST(PConnectorOpen, ReportsThatGarbageDoesNotComeFromADssmd) {
  for (const std::string& bytes : std::vector<std::string>{
           "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain; charset=utf-8\r\n\r\n400 Bad "
           "Request",
           "SSH-2.0-OpenSSH_9.2p1 Debian-2+deb12u3\r\n" + std::string(100, 'k'),
           std::string(100, '\xff'), std::string(3, '\0')}) {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
      peer.send_bytes(bytes);
      peer.await_end();
    });
    const auto con =
        PConnector::open({"lidar", 0, {}}, {.address = daemon.address(), .request_timeout = 10s});
    ASSERT_FALSE(con);
    expect_words(con.error(), Errc::protocol, {"lidar", daemon.address()});
  }
}

TEST(PConnectorOpen, ReportsThatTheConnectionWasClosed) {
  const ScriptedDaemon daemon([](NetworkPeer&, int) {});
  const auto con = open(daemon);
  ASSERT_FALSE(con);
  expect_words(con.error(), Errc::unavailable, {daemon.address(), "closed"});
}

TEST(PConnectorOpen, RefusesAnInvalidDescription) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int number) {
    peer.answer_open(number == 0 ? (65ULL << 20) : 0);
    peer.await_end();
  });
  for (int i = 0; i < 2; ++i) {
    const auto con = open(daemon);
    ASSERT_FALSE(con);
    EXPECT_NE(con.error().message.find("description"), std::string::npos) << con.error().message;
  }
}

TEST(PConnectorOpen, ADssmdThatDoesNotAnswerCostsTheRequestTimeout) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) { peer.await_end(); });
  const auto con =
      PConnector::open({"lidar", 0, {}}, {.address = daemon.address(), .request_timeout = 200ms});
  ASSERT_FALSE(con);
  expect_words(con.error(), Errc::unavailable, {daemon.address(), "does not greet"});
}

TEST(PConnectorOpen, GivesABusyDssmdTheRequestTimeoutToGreet) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    std::this_thread::sleep_for(wire::kHelloTimeout + 100ms);
    peer.answer_open(8);
    peer.await_end();
  });
  const auto con =
      PConnector::open({"lidar", 0, {}}, {.address = daemon.address(), .request_timeout = 60s});
  EXPECT_TRUE(con) << con.error().message;
}

// --- requests

// Answers the reads of one connection with sample 5, until something else comes.
void answer_reads(NetworkPeer& peer) {
  for (;;) {
    const auto request = peer.try_receive();
    if (!request || !request->has_read()) return;
    send_sample(peer, 5, text_of(5), request->serial());
  }
}

TEST(PConnectorRequest, IsRepeatedOnANewConnection) {
  std::atomic<int> asked = 0;
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(8);
    if (number < 2) {
      if (peer.try_receive()) ++asked;
      return;  // hangs up instead of answering
    }
    answer_reads(peer);
  });
  auto con = open(daemon).value();
  TakenSample sample;
  ASSERT_EQ(con.read_newest(sample.span(), sample.info).value(), ReadStatus::ok);
  EXPECT_EQ(sample.info.tid, 5);
  EXPECT_EQ(sample.bytes, text_of(5));
  EXPECT_EQ(asked, 2);
  EXPECT_EQ(con.counters().reconnects, 2u);
}

TEST(PConnectorRequest, FailsAtOnceWhenTheAnswerIsGarbageAndTheNextOneWorks) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(8);
    if (number == 0) {
      peer.try_receive();
      peer.send_bytes(std::string(64, '\xff'));
      peer.await_end();
      return;
    }
    answer_reads(peer);
  });
  auto con = open(daemon).value();
  TakenSample sample;
  const auto bad = con.read_newest(sample.span(), sample.info);
  ASSERT_FALSE(bad);
  expect_words(bad.error(), Errc::protocol, {"lidar"});
  EXPECT_EQ(sample.info.tid, kNoTid);
  EXPECT_EQ(con.read_newest(sample.span(), sample.info).value(), ReadStatus::ok);
}

// A dssmd whose stream has samples of 8 bytes, and that answers a read with that one.
auto answers_with(const char* payload) {
  return [payload](NetworkPeer& peer, int) {
    peer.answer_open(8);
    const auto request = peer.try_receive();
    if (request) send_sample(peer, 5, payload, request->serial());
    peer.await_end();
  };
}

TEST(PConnectorRequest, TakesASampleThatIsShorter) {
  const ScriptedDaemon daemon(answers_with("123"));
  auto con = open(daemon).value();
  TakenSample sample;
  ASSERT_EQ(con.read_newest(sample.span(), sample.info).value(), ReadStatus::ok);
  EXPECT_EQ(sample.info.payload_bytes, 3u);
  EXPECT_EQ(std::memcmp(sample.span().data(), "123", 3), 0);
}

TEST(PConnectorRequest, RefusesSamplesThatAreTooLong) {
  const ScriptedDaemon daemon(answers_with("123456789"));
  auto con = open(daemon).value();
  TakenSample sample;
  const auto bad = con.read_newest(sample.span(), sample.info);
  ASSERT_FALSE(bad);
  expect_words(bad.error(), Errc::protocol, {"9"});
}

TEST(PConnectorRequest, RequestsATornSampleAgain) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
    peer.answer_open(8);
    auto request = peer.try_receive();
    if (request) send_sample(peer, 4, text_of(4), request->serial(), true);
    request = peer.try_receive();
    if (request) send_sample(peer, 5, text_of(5), request->serial(), false);
    peer.await_end();
  });
  auto con = open(daemon).value();
  TakenSample sample;
  ASSERT_EQ(con.read_newest(sample.span(), sample.info).value(), ReadStatus::ok);
  EXPECT_EQ(sample.info.tid, 5);
}

TEST(PConnectorRequest, FailsWithUnavailableWhileDssmdStaysDown) {
  auto daemon =
      std::make_unique<ScriptedDaemon>([](NetworkPeer& peer, int) { peer.answer_open(8); });
  auto con = open_impatient(*daemon, 300ms);
  const std::string address = daemon->address();
  daemon.reset();
  TakenSample sample;
  const auto away = con.read_newest(sample.span(), sample.info);
  ASSERT_FALSE(away);
  expect_words(away.error(), Errc::unavailable, {"lidar", address});
  EXPECT_FALSE(con.is_connected());
}

TEST(PConnectorRequest, ReportsOnceThatTheStreamWasRecreated) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(8, number == 0 ? 1 : 2);
    if (number == 0) {
      const auto request = peer.try_receive();
      if (request) send_sample(peer, 5, text_of(5), request->serial());
      return;
    }
    answer_reads(peer);
  });
  auto con = open(daemon).value();
  TakenSample sample;
  ASSERT_EQ(con.read_tid(5, sample.span(), sample.info).value(), ReadStatus::ok);
  EXPECT_EQ(con.read_tid(5, sample.span(), sample.info).value(), ReadStatus::restarted);
  EXPECT_EQ(con.restarts(), 1u);
  EXPECT_EQ(con.incarnation(), 2u);
  EXPECT_EQ(con.read_tid(5, sample.span(), sample.info).value(), ReadStatus::ok);
}

TEST(PConnectorRequest, RefusesAStreamThatWasRecreatedWithAnotherSize) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(number == 0 ? 8 : 9, static_cast<std::uint64_t>(number) + 1);
    if (number == 0) {
      peer.try_receive();
      return;
    }
    peer.await_end();
  });
  auto con = open(daemon).value();
  TakenSample sample;
  const auto bad = con.read_newest(sample.span(), sample.info);
  ASSERT_FALSE(bad);
  expect_words(bad.error(), Errc::type_mismatch, {"recreated", "8 bytes", "9 bytes"});
}

TEST(PConnectorRequest, AWaitForAnUnusableStreamDoesNotSpin) {
  std::atomic<int> connections = 0;
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    ++connections;
    peer.answer_open(number == 0 ? 8 : 9, static_cast<std::uint64_t>(number) + 1);
    if (number == 0) {
      peer.answer_subscribe(0);
      return;
    }
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  TakenSample sample;
  for (int i = 0; i < 5; ++i) {
    const int before = connections;
    ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
    EXPECT_GT(connections, before) << "each time after one more attempt";
    const auto status = con.read_next(sample.span(), sample.info);
    ASSERT_FALSE(status);
    EXPECT_NE(status.error().message.find("recreated"), std::string::npos)
        << status.error().message;
  }
}

TEST(PConnectorRequest, RefusesABufferOfAnotherSize) {
  const ScriptedDaemon daemon(
      [&](NetworkPeer& peer, int) { peer.answer_open(8), peer.await_end(); });
  auto con = open(daemon).value();
  std::array<std::byte, 7> small;
  SampleInfo info;
  EXPECT_EQ(con.read_newest(small, info).error().code, Errc::invalid_argument);
  EXPECT_EQ(con.read_next(small, info).error().code, Errc::invalid_argument);
  const std::array<std::byte, 9> large{};
  EXPECT_EQ(con.post(large).error().code, Errc::invalid_argument);
  EXPECT_EQ(con.write(large).error().code, Errc::invalid_argument);
}

// --- subscriptions

TEST(PConnectorSubscription, ComesInOrderHoweverTheBytesCome) {
  for (const std::size_t piece : {1, 7, 50, 1000}) {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
      peer.answer_open(8);
      peer.answer_subscribe(0);
      std::string bytes;
      for (std::int64_t tid = 0; tid < 20; ++tid) {
        const Bytes sample =
            sample_bytes({tid, time_from_ns(tid * 10), 7ns}, to_bytes(text_of(tid)));
        bytes.append(reinterpret_cast<const char*>(sample.data()), sample.size());
      }
      for (std::size_t at = 0; at < bytes.size(); at += piece) {
        peer.send_bytes(bytes.substr(at, piece));
      }
      peer.await_end();
    });
    auto con = open(daemon).value();
    ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
    for (std::int64_t tid = 0; tid < 20; ++tid) expect_sample(con, tid);
    TakenSample sample;
    EXPECT_EQ(con.read_next(sample.span(), sample.info).value(), ReadStatus::not_yet);
    EXPECT_EQ(con.lost_samples(), 0u);
  }
}

TEST(PConnectorSubscription, NeedsOne) {
  const ScriptedDaemon daemon(
      [](NetworkPeer& peer, int) { peer.answer_open(8), peer.await_end(); });
  auto con = open(daemon).value();
  TakenSample sample;
  const auto none = con.read_next(sample.span(), sample.info);
  ASSERT_FALSE(none);
  expect_words(none.error(), Errc::invalid_argument, {"subscribe"});
  EXPECT_EQ(con.wait(kNever), WaitStatus::timeout);
}

TEST(PConnectorSubscription, KeepsSamplesThatArriveDuringARequest) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.answer_open(8);
    peer.answer_subscribe(0);
    for (std::int64_t tid = 0; tid < 3; ++tid) send_sample(peer, tid, text_of(tid));
    const auto request = peer.try_receive();
    if (!request) return;
    for (std::int64_t tid = 3; tid < 6; ++tid) send_sample(peer, tid, text_of(tid));
    send_sample(peer, 5, text_of(5), request->serial());
    send_sample(peer, 6, text_of(6));
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  expect_sample(con, 0);
  TakenSample sample;
  ASSERT_EQ(con.read_newest(sample.span(), sample.info).value(), ReadStatus::ok);
  EXPECT_EQ(sample.info.tid, 5);
  for (std::int64_t tid = 1; tid < 7; ++tid) expect_sample(con, tid);
}

TEST(PConnectorSubscription, ResumesAtTheNextSample) {
  std::promise<net::Subscribe> resumed;
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(8);
    if (number == 0) {
      peer.answer_subscribe(3);
      send_sample(peer, 3, text_of(3));
      send_sample(peer, 4, text_of(4));
      return;
    }
    resumed.set_value(peer.answer_subscribe(7).subscribe());
    send_sample(peer, 7, text_of(7));
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  expect_sample(con, 3);
  expect_sample(con, 4);
  expect_sample(con, 7);
  const net::Subscribe request = resumed.get_future().get();
  EXPECT_EQ(request.from_tid(), 5);
  EXPECT_EQ(request.incarnation(), 1u);
  EXPECT_EQ(con.lost_samples(), 2u);
  EXPECT_EQ(con.restarts(), 0u);
}

TEST(PConnectorSubscription, ReportsANewRingBetweenItsSamplesAndThoseOfTheOldOne) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(8, number == 0 ? 1 : 2);
    peer.answer_subscribe(number == 0 ? 8 : 0, number == 0 ? 1 : 2);
    send_sample(peer, number == 0 ? 8 : 0, text_of(number == 0 ? 8 : 0));
    if (number == 0) return;
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  expect_sample(con, 8);
  ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
  TakenSample sample;
  EXPECT_EQ(con.read_next(sample.span(), sample.info).value(), ReadStatus::restarted);
  expect_sample(con, 0);
  EXPECT_EQ(con.lost_samples(), 0u);
  EXPECT_EQ(con.restarts(), 1u);
}

TEST(PConnectorSubscription, ReportsThatTheConnectionIsDownWithoutWaiting) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    if (number == 0) {
      peer.answer_open(8);
      peer.answer_subscribe(0);
      return;
    }
    peer.await_end();  // silent from now on
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  TakenSample sample;
  for (;;) {
    const auto status = con.read_next(sample.span(), sample.info);
    if (!status) {
      expect_words(status.error(), Errc::unavailable, {"lidar"});
      break;
    }
    ASSERT_EQ(*status, ReadStatus::not_yet);
  }
}

TEST(PConnectorSubscription, ReportsThatTheStreamWasRemovedAndContinuesWhenItIsRecreated) {
  std::atomic<bool> back = false;
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    if (number == 0) {
      peer.answer_open(8);
      peer.answer_subscribe(0);
      peer.send(removed_frame());
    } else if (!back) {
      peer.answer_hello();
      peer.refuse(Errc::not_found, "");
    } else {
      peer.answer_open(8, 2);
      peer.answer_subscribe(0, 2);
      send_sample(peer, 0, text_of(0));
    }
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  TakenSample sample;
  for (;;) {
    const auto status = con.read_next(sample.span(), sample.info);
    if (status) {
      ASSERT_EQ(*status, ReadStatus::not_yet);
      continue;
    }
    EXPECT_EQ(status.error().code, Errc::not_found) << status.error().message;
    break;
  }
  back = true;
  ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
  EXPECT_EQ(con.read_next(sample.span(), sample.info).value(), ReadStatus::restarted);
  expect_sample(con, 0);
}

TEST(PConnectorSubscription, ReportsWhyItIsRefused) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.answer_open(8);
    peer.refuse(Errc::no_permission, "not for you");
    answer_reads(peer);
  });
  auto con = open(daemon).value();
  const auto refused = con.subscribe({});
  ASSERT_FALSE(refused);
  expect_words(refused.error(), Errc::no_permission, {"lidar", "not for you"});
  TakenSample sample;
  EXPECT_FALSE(con.read_next(sample.span(), sample.info));
  EXPECT_EQ(con.read_newest(sample.span(), sample.info).value(), ReadStatus::ok)
      << "the connection is still good";
}

// Else no request would get through any more, or a late answer would begin a subscription.
TEST(PConnectorSubscription, OneThatIsNotAnsweredEndsTheConnection) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.answer_open(8);
    while (const auto request = peer.try_receive()) {
      if (request->has_read()) send_sample(peer, 5, text_of(5), request->serial());
    }
  });
  auto con = open_impatient(daemon, 200ms);
  const auto refused = con.subscribe({});
  ASSERT_FALSE(refused);
  expect_words(refused.error(), Errc::unavailable, {"lidar"});
  TakenSample sample;
  await([&] {
    const auto status = con.read_newest(sample.span(), sample.info);
    return status && *status == ReadStatus::ok;
  });
  EXPECT_EQ(sample.info.tid, 5);
}

TEST(PConnectorSubscription, WaitEndsAtItsDeadlineAndAtASignal) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int) {
    peer.answer_open(8);
    peer.answer_subscribe(0);
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  EXPECT_EQ(con.wait(MonoClock::now() - 1s), WaitStatus::timeout);
  const MonoTime deadline = deadline_in(20ms);
  EXPECT_EQ(con.wait(deadline), WaitStatus::timeout);
  EXPECT_GE(MonoClock::now(), deadline);
  struct sigaction action {};
  action.sa_handler = [](int) {};
  ::sigaction(SIGALRM, &action, nullptr);
  // One signal, while wait() is in recv() and while it is in poll(). It may come before wait() is
  // there: then once more.
  for (const Duration after : {5ms, 200ms}) {
    WaitStatus status = WaitStatus::timeout;
    for (int attempt = 0; attempt < 3 && status == WaitStatus::timeout; ++attempt) {
      const itimerval timer{{}, {0, after / 1us}};
      ::setitimer(ITIMER_REAL, &timer, nullptr);
      status = con.wait(deadline_in(10s));
    }
    EXPECT_EQ(status, WaitStatus::interrupted) << "after " << after / 1ms << " ms";
  }
}

TEST(PConnectorSubscription, ItsDescriptorCoversTheConnectionAndTheNextAttempt) {
  const ScriptedDaemon daemon([](NetworkPeer& peer, int number) {
    if (number == 1) return;  // one attempt fails
    peer.answer_open(8);
    peer.answer_subscribe(number);
    send_sample(peer, number, text_of(number));
    if (number > 1) peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({}));
  for (const std::int64_t tid : {0, 2}) {
    for (;;) {
      TakenSample sample;
      const auto status = con.read_next(sample.span(), sample.info);
      if (status && *status == ReadStatus::ok) {
        EXPECT_EQ(sample.info.tid, tid);
        break;
      }
      pollfd ready{con.ready_fd(), POLLIN, 0};
      ASSERT_EQ(::poll(&ready, 1, -1), 1);
    }
  }
  EXPECT_EQ(con.lost_samples(), 1u);
}

// --- large samples

constexpr std::size_t kLargeBytes = 3 << 20;

std::string large(char fill) { return std::string(kLargeBytes, fill); }

// What comes while the client still waits to hear that it is subscribed has no place of the
// caller's to go to.
TEST(PConnectorLargeSamples, ArePutAsideWhenTheRestDoesNotCome) {
  std::promise<void> subscribed, go_on;
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
    peer.answer_open(kLargeBytes);
    peer.answer_subscribe(0);
    subscribed.get_future().wait();
    net::Frame frame;
    frame.mutable_sample()->set_tid(0);
    frame.set_payload(large('a'));
    const std::string bytes = wire::encode_frame(frame);
    peer.send_bytes(bytes.substr(0, 2'000'000));
    go_on.get_future().wait();
    peer.send_bytes(bytes.substr(2'000'000));
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  subscribed.set_value();
  ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
  std::string first(kLargeBytes, '?'), second(kLargeBytes, '?');
  SampleInfo info;
  EXPECT_EQ(con.read_next(std::as_writable_bytes(std::span(first)), info).value(),
            ReadStatus::not_yet);
  first.assign(kLargeBytes, '!');  // ours again
  EXPECT_EQ(con.read_next(std::as_writable_bytes(std::span(first)), info).value(),
            ReadStatus::not_yet);
  EXPECT_EQ(con.wait(deadline_in(10ms)), WaitStatus::timeout) << "what is put aside is not ready";
  go_on.set_value();
  ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
  ASSERT_EQ(con.read_next(std::as_writable_bytes(std::span(second)), info).value(), ReadStatus::ok);
  EXPECT_EQ(second, large('a'));
  EXPECT_EQ(first, large('!'));
  EXPECT_EQ(info.tid, 0);
}

TEST(PConnectorLargeSamples, AreReceivedWhereTheyAreWanted) {
  std::promise<void> subscribed;
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
    peer.answer_open(kLargeBytes);
    peer.answer_subscribe(0);
    subscribed.get_future().wait();
    for (std::int64_t tid = 0; tid < 20; ++tid) {
      send_sample(peer, tid, large(static_cast<char>('a' + tid)));
    }
    const auto request = peer.try_receive();
    if (request) send_sample(peer, 5, large('!'), request->serial());
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  subscribed.set_value();
  std::string sample(kLargeBytes, '?');
  const auto span = std::as_writable_bytes(std::span(sample));
  SampleInfo info;
  std::uint64_t stalls = 0;  // of a busy machine: what had come is put aside
  for (std::int64_t tid = 0; tid < 20;) {
    ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
    const ReadStatus status = con.read_next(span, info).value();
    if (status == ReadStatus::not_yet) {
      ++stalls;
      continue;
    }
    ASSERT_EQ(status, ReadStatus::ok);
    ASSERT_EQ(info.tid, tid);
    ASSERT_EQ(sample, large(static_cast<char>('a' + tid)));
    ++tid;
  }
  ASSERT_EQ(con.read_newest(span, info).value(), ReadStatus::ok);
  EXPECT_EQ(sample, large('!'));
  const auto counters = con.counters();
  EXPECT_EQ(counters.samples, 21u);
  EXPECT_GT(counters.direct_payload_bytes, 21 * kLargeBytes * 9 / 10);
  EXPECT_LE(counters.direct_payload_bytes + counters.copied_payload_bytes,
            (21 + 2 * stalls) * kLargeBytes);
}

TEST(PConnectorLargeSamples, OneThatWasCutIsSentAgain) {
  const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
    peer.answer_open(kLargeBytes);
    peer.answer_subscribe(0);
    net::Frame frame;
    frame.mutable_sample()->set_tid(0);
    frame.set_payload(large('a'));
    const std::string bytes = wire::encode_frame(frame);
    if (number < 3)
      return peer.send_bytes(
          bytes.substr(0, bytes.size() * (1 + static_cast<unsigned>(number)) / 4));
    peer.send_bytes(bytes);
    peer.await_end();
  });
  auto con = open(daemon).value();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  std::string sample(kLargeBytes, '?');
  SampleInfo info;
  for (;;) {
    const auto status = con.read_next(std::as_writable_bytes(std::span(sample)), info);
    if (status && *status == ReadStatus::ok) break;
    ASSERT_EQ(con.wait(kNever), WaitStatus::ready);
  }
  EXPECT_EQ(sample, large('a'));
  EXPECT_EQ(con.lost_samples(), 0u);
  EXPECT_EQ(con.counters().reconnects, 3u);
}

// --- publishing

// A publisher's other end: writes each sample once, over all connections.
struct Owner {
  std::int64_t last = -1;
  std::vector<std::string> written;

  void answer_start(NetworkPeer& peer, const net::Frame& frame) const {
    net::Frame answer = answer_to(frame);
    answer.mutable_publishing()->set_last(last);
    answer.mutable_publishing()->set_last_tid(static_cast<std::int64_t>(written.size()) - 1);
    peer.send(answer);
  }
  void take(const net::Frame& frame) {
    if (frame.sample().tid() <= last) return;
    last = frame.sample().tid();
    written.push_back(frame.payload());
  }
  void acknowledge(NetworkPeer& peer) const {
    net::Frame event;
    event.mutable_published()->set_last(last);
    event.mutable_published()->set_last_tid(static_cast<std::int64_t>(written.size()) - 1);
    peer.send(event);
  }
};

TEST(PConnectorPublishing, WritesEachSampleOnceOverBrokenConnections) {
  Owner owner;  // of the fake's thread until the connector is gone
  {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
      peer.answer_open(8);
      for (int frames = 0;; ++frames) {
        const auto frame = peer.try_receive();
        if (!frame) return;
        if (frame->has_start_publishing()) {
          owner.answer_start(peer, *frame);
          continue;
        }
        // Hangs up after some samples: before, and after it wrote the last one, and without having
        // said so.
        if (number < 20 && frames > number % 5) {
          if (number % 2 == 0) owner.take(*frame);
          return;
        }
        owner.take(*frame);
        if (frames % 3 == 0 || number >= 20) owner.acknowledge(peer);
      }
    });
    auto con = open(daemon).value();
    for (std::int64_t i = 0; i < 500; ++i) ASSERT_TRUE(con.post(to_bytes(text_of(i))));
    const auto flushed = con.flush(kNever);
    ASSERT_TRUE(flushed) << flushed.error().message;
    EXPECT_EQ(*flushed, 499);
    const auto written = con.write(to_bytes(text_of(500)));
    ASSERT_TRUE(written) << written.error().message;
    EXPECT_EQ(*written, 500);
    EXPECT_EQ(con.dropped_samples(), 0u);
    EXPECT_GE(con.counters().reconnects, 20u);
  }
  ASSERT_EQ(owner.written.size(), 501u);
  for (std::int64_t i = 0; i <= 500; ++i) {
    EXPECT_EQ(owner.written[static_cast<std::size_t>(i)], text_of(i));
  }
}

TEST(PConnectorPublishing, BeginsWhileASubscriptionIsBeingResumed) {
  Owner owner;  // of the daemon's thread until the connector is gone
  std::atomic<bool> asked = false;
  {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
      peer.answer_open(8);
      if (number == 0) {
        peer.answer_subscribe(0);
        return;
      }
      const net::Frame subscribe = peer.receive();
      asked = true;
      while (const auto frame = peer.try_receive()) {
        if (frame->has_start_publishing()) {
          owner.answer_start(peer, *frame);
          net::Frame answer = answer_to(subscribe);
          answer.mutable_subscribed()->set_incarnation(1);
          peer.send(answer);
        } else {
          owner.take(*frame);
          owner.acknowledge(peer);
        }
      }
    });
    auto con = open(daemon).value();
    ASSERT_TRUE(con.subscribe({}));
    TakenSample sample;
    await([&] {
      static_cast<void>(con.read_next(sample.span(), sample.info));
      return asked.load();
    });
    ASSERT_TRUE(con.post(to_bytes(text_of(0))));
    ASSERT_TRUE(con.flush(kNever));
  }
  EXPECT_EQ(owner.written, std::vector<std::string>{text_of(0)});
}

TEST(PConnectorPublishing, SendsNothingTwiceOnOneConnection) {
  std::vector<std::int64_t> numbers;  // of the fake's thread until the connector is gone
  {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
      peer.answer_open(8);
      std::optional<net::Frame> start;
      while (const auto frame = peer.try_receive()) {
        if (frame->has_start_publishing()) {
          start = frame;  // answered late
          continue;
        }
        Owner owner;
        if (frame->has_get_range()) {  // by now the answer to StartPublishing has been seen
          net::Frame answer = answer_to(*frame);
          answer.mutable_range();
          peer.send(answer);
        } else {
          numbers.push_back(frame->sample().tid());
          if (numbers.size() == 100) owner.answer_start(peer, *start);
          if (numbers.size() <= 300) continue;
        }
        owner.last = numbers.back();
        owner.acknowledge(peer);
      }
    });
    auto con = open(daemon).value();
    for (std::int64_t i = 0; i < 300; ++i) ASSERT_TRUE(con.post(to_bytes(text_of(i))));
    ASSERT_TRUE(con.newest_tid());
    ASSERT_TRUE(con.flush(kNever));
    for (std::int64_t i = 300; i < 310; ++i) ASSERT_TRUE(con.post(to_bytes(text_of(i))));
    ASSERT_TRUE(con.flush(kNever));
  }
  ASSERT_EQ(numbers.size(), 310u);
  for (std::int64_t i = 0; i < 310; ++i) EXPECT_EQ(numbers[static_cast<std::size_t>(i)], i);
}

TEST(PConnectorPublishing, NoticesABrokenConnectionByTheNextPosts) {
  Owner owner;
  {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
      peer.answer_open(8);
      while (const auto frame = peer.try_receive()) {
        if (frame->has_start_publishing()) {
          owner.answer_start(peer, *frame);
          continue;
        }
        owner.take(*frame);
        owner.acknowledge(peer);
        if (number == 0) return;
      }
    });
    auto con = open(daemon).value();
    int posts = 0;
    ASSERT_TRUE(con.post(to_bytes(text_of(posts++))));
    await([&] { return daemon.ended() != 0; });
    // The first one tells the kernel, the second one us.
    for (int i = 0; i < 3 && con.counters().reconnects == 0 && con.is_connected(); ++i) {
      ASSERT_TRUE(con.post(to_bytes(text_of(posts++))));
    }
    EXPECT_FALSE(con.is_connected());
    ASSERT_TRUE(con.flush(kNever));
    EXPECT_EQ(owner.written.size(), static_cast<std::size_t>(posts));
  }
}

TEST(PConnectorPublishing, KeepsTheNewestWhileDssmdIsDownAndCountsTheOthers) {
  Owner owner;
  std::atomic<bool> back = false;
  {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int number) {
      if (number > 0 && !back) return;
      peer.answer_open(8);
      if (number == 0) return;
      for (;;) {
        const auto frame = peer.try_receive();
        if (!frame) return;
        if (frame->has_start_publishing()) {
          owner.answer_start(peer, *frame);
        } else {
          owner.take(*frame);
          owner.acknowledge(peer);
        }
      }
    });
    auto con =
        PConnector::open({"lidar", 0, {}}, {.address = daemon.address(), .max_unsent_samples = 10})
            .value();
    while (con.is_connected()) ASSERT_TRUE(con.post(to_bytes(text_of(0))));
    const std::uint64_t before = con.dropped_samples();
    for (std::int64_t i = 1; i <= 30; ++i) ASSERT_TRUE(con.post(to_bytes(text_of(i))));
    EXPECT_GE(con.dropped_samples(), before + 20);
    back = true;
    ASSERT_TRUE(con.flush(kNever));
  }
  ASSERT_GE(owner.written.size(), 10u);
  for (std::size_t i = 0; i < 10; ++i) {
    EXPECT_EQ(owner.written[owner.written.size() - 10 + i],
              text_of(static_cast<std::int64_t>(21 + i)));
  }
}

TEST(PConnectorPublishing, AWriteThatIsNotAcknowledgedFails) {
  const ScriptedDaemon daemon(
      [](NetworkPeer& peer, int) { peer.answer_open(8), peer.await_end(); });
  auto con = open_impatient(daemon, 100ms);
  const auto written = con.write(to_bytes(text_of(0)));
  ASSERT_FALSE(written);
  expect_words(written.error(), Errc::unavailable, {"lidar", "kept"});
}

TEST(PConnectorPublishing, TheDestructorSendsWhatWasPosted) {
  Owner owner;
  {
    const ScriptedDaemon daemon([&](NetworkPeer& peer, int) {
      peer.answer_open(8);
      while (const auto frame = peer.try_receive()) {
        if (frame->has_start_publishing()) {
          owner.answer_start(peer, *frame);
        } else {
          owner.take(*frame);
          owner.acknowledge(peer);
        }
      }
    });
    auto con = open(daemon).value();
    for (std::int64_t i = 0; i < 1000; ++i) ASSERT_TRUE(con.post(to_bytes(text_of(i))));
  }
  EXPECT_EQ(owner.written.size(), 1000u);
}

}  // namespace
}  // namespace dssm::test
