// SPDX-License-Identifier: Apache-2.0
//
// Reading across hosts: a PConnector's question by time beside a bare TCP ping-pong of the same
// sizes; a mirror by time beside the owner's ring; and what remote readers cost the writer, beside
// one write to an eventfd. Both hosts are on this machine, joined by loopback.
#include <sys/eventfd.h>

#include <dssm/dssm.hpp>
#include <dssm/pconnector.hpp>
#include <random>
#include <string>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr std::size_t kQuestionBytes = 32;

void bench_questions(const std::string& address, Session& session, std::size_t bytes) {
  const StreamId id{"ask", static_cast<std::int32_t>(bytes), ""};
  RawWriter writer = session.create_raw(id, {"", bytes, 1, {}}, History{101, 1ms}).value();
  std::vector<std::byte> payload(bytes);
  for (std::int64_t i = 0; i < 100; ++i) writer.write(payload, time_from_ns(1'000'000 * i));

  const auto [client, server] = tcp_pair();
  const int echo = server;
  const pid_t pid = in_child([&] {
    std::vector<std::byte> question(kQuestionBytes), answer(bytes);
    for (;;) {
      receive_all(echo, question.data(), question.size());
      send_all(echo, answer.data(), answer.size());
    }
  });
  PConnector connector = PConnector::open(id, {.address = address}).value();
  std::vector<std::byte> question(kQuestionBytes), out(bytes);
  SampleInfo info;
  std::int64_t at = 0;
  const int socket = client;
  const Pair pair = measure(
      4000, 1,
      [&] {
        send_all(socket, question.data(), question.size());
        receive_all(socket, out.data(), out.size());
      },
      [&] {
        at = (at + 37) % 100;
        if (connector.at(time_from_ns(1'000'000 * at), out, info).value() != ReadStatus::ok) {
          fail("read by time");
        }
      });
  end_child(pid);
  ::close(client), ::close(server);
  const std::string tail = ", " + std::to_string(bytes) + " B";
  print_pair("TCP ping-pong" + tail, "PConnector read by time" + tail, pair, "<= 1.3");
}

void bench_mirror(Session& owner, Session& other) {
  constexpr int kDepth = 10'000;
  RawWriter writer =
      owner.create_raw({"history", 0, ""}, {"", 64, 1, {}}, History{kDepth, 1ms}).value();
  std::vector<std::byte> payload(64);
  for (std::int64_t i = 0; i < 2 * kDepth; ++i) {
    writer.write(payload, time_from_ns(1'000'000 * i));
  }
  const StreamId id{"history", 0, "pc1"};
  RawReader here = owner.open_raw_reader(id).value();
  RawReader there = other.await_raw_reader(id, deadline_in(10s)).value();
  while (there.newest() != here.newest()) ::usleep(1000);
  std::mt19937_64 random(1);
  SampleInfo info;
  const auto read = [&](RawReader& reader) {
    const auto t = static_cast<std::int64_t>(random() % (kDepth - 2)) + kDepth + 1;
    if (reader.at(time_from_ns(1'000'000 * t), payload, info) != ReadStatus::ok) fail("at");
  };
  const Pair pair = measure(
      2000, 200, [&] { read(here); }, [&] { read(there); });
  print_pair("owner's ring by time", "mirror by time", pair, "");
  std::printf("%-44s %47.2f  %s\n", "  ratio of the p99", pair.ours.p99 / pair.raw.p99, "<= 1.2");
}

// What a write costs more while eight readers elsewhere are subscribed, in units of one write to an
// eventfd that somebody waits for.
void bench_writer(const test::DaemonProcess& daemon, Session& session) {
  constexpr int kReaders = 8, kWrites = 3000;
  RawWriter writer =
      session.create_raw({"cost", 0, ""}, {"", 64, 1, {}}, History{1000, 1ms}).value();
  const int bell = ::eventfd(0, EFD_CLOEXEC);
  const pid_t listener = in_child([&] {
    for (std::uint64_t count = 0;;) {
      if (::read(bell, &count, sizeof count) != sizeof count) fail("read eventfd");
    }
  });
  std::vector<std::byte> payload(64);
  const auto paced = [&](auto operation) {
    std::vector<double> ns;
    MonoTime next = MonoClock::now();
    for (int i = 0; i < kWrites; ++i) {
      sleep_until(next += 500us);
      const std::int64_t start = now_ns();
      operation();
      ns.push_back(static_cast<double>(now_ns() - start));
    }
    return figures_of(std::move(ns));
  };
  const auto write = [&] { writer.write(payload, WallClock::now()); };
  const Figures doorbell = paced([&] {
    const std::uint64_t one = 1;
    if (::write(bell, &one, sizeof one) != sizeof one) fail("write eventfd");
  });
  const Figures alone = paced(write);
  auto& ready = shared<std::atomic<int>>();
  const std::string address = daemon.address();
  std::vector<pid_t> readers;
  for (int i = 0; i < kReaders; ++i) {
    readers.push_back(in_child([&] {
      PConnector connector = PConnector::open({"cost", 0, ""}, {.address = address}).value();
      connector.subscribe({}).value();
      ready.fetch_add(1);
      std::vector<std::byte> out(64);
      for (SampleInfo info;;) {
        while (connector.wait(kNever) != WaitStatus::ready) {
        }
        while (connector.next(out, info).value() == ReadStatus::ok) {
        }
      }
    }));
  }
  while (ready.load() != kReaders) ::usleep(1000);
  const Figures with = paced(write);
  for (const pid_t pid : readers) end_child(pid);
  end_child(listener);
  ::close(bell);
  print_row("  write an eventfd that wakes a process", doorbell);
  print_row("  write 64 B, no reader", alone);
  char rest[80];
  std::snprintf(rest, sizeof rest, "%7.2f  <= 1 more",
                (with.median - alone.median) / doorbell.median);
  print_row("write 64 B, 8 remote readers", with, rest);
}

}  // namespace

int main() {
  test::DaemonProcess owner({"--listen", "127.0.0.1:0"}, "pc1");
  test::DaemonProcess other({"--listen", "127.0.0.1:0", "--peer", owner.address()}, "pc2");
  Session session = Session::connect({.socket_path = owner.socket_path()}).value();
  Session there = Session::connect({.socket_path = other.socket_path()}).value();
  print_head();
  for (const std::size_t bytes : {64, 1024, 16 << 10, 64 << 10}) {
    bench_questions(owner.address(), session, bytes);
  }
  bench_mirror(session, there);
  bench_writer(owner, session);
}
