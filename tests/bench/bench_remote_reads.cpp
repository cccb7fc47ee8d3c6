// SPDX-License-Identifier: Apache-2.0
//
// Reading across hosts: a PConnector's read by time compared with a bare TCP ping-pong of the same
// sizes; reading a mirror by time compared with the owner's ring; and the cost of remote readers
// for the writer, compared with one write to an eventfd.
#include <sys/epoll.h>
#include <sys/eventfd.h>

#include <dssm/dssm.hpp>
#include <dssm/pconnector.hpp>
#include <random>
#include <string>

#include "tests/bench/harness.hpp"
#include "tests/bench/hosts.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr std::size_t kQuestionBytes = 32;
constexpr std::size_t kAnswers = 100, kStride = 37;

void bench_questions(const Hosts& hosts, const std::string& address, Session& session,
                     std::size_t bytes) {
  const StreamId id{"ask", static_cast<std::int32_t>(bytes), ""};
  RawWriter writer = session.create_raw(id, {"", bytes, 1, {}}, History{kAnswers + 1, 1ms}).value();
  std::vector<std::byte> payload(bytes);
  for (std::int64_t i = 0; i < std::int64_t{kAnswers}; ++i)
    writer.write(payload, time_from_ns(1'000'000 * i));

  const auto [server, client] = hosts.tcp_pair();
  const int echo = server;
  const pid_t pid = in_child([&] {
    // From as many buffers as the ring has slots, in the same order: with a single buffer, the raw
    // limit would profit from the cache.
    std::vector<std::byte> question(kQuestionBytes), answers(kAnswers * bytes, std::byte{1});
    for (std::size_t at = 0;; at = (at + kStride) % kAnswers) {
      receive_all(echo, question.data(), question.size());
      send_all(echo, answers.data() + at * bytes, bytes);
    }
  });
  const auto in_other = hosts.inside(2);
  PConnector connector = PConnector::open(id, {.address = address}).value();
  std::vector<std::byte> question(kQuestionBytes), out(bytes);
  SampleInfo info;
  std::size_t at = 0;
  const int socket = client;
  const Pair pair = measure(
      4000, 1,
      [&] {
        send_all(socket, question.data(), question.size());
        receive_all(socket, out.data(), out.size());
      },
      [&] {
        at = (at + kStride) % kAnswers;
        if (connector.read_at(time_from_ns(1'000'000 * static_cast<std::int64_t>(at)), out, info)
                .value() != ReadStatus::ok) {
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
  while (there.newest_tid() != here.newest_tid()) ::usleep(1000);
  std::mt19937_64 random(1);
  SampleInfo info;
  const auto read = [&](RawReader& reader) {
    const auto t = static_cast<std::int64_t>(random() % (kDepth - 2)) + kDepth + 1;
    if (reader.read_at(time_from_ns(1'000'000 * t), payload, info) != ReadStatus::ok) fail("at");
  };
  // The first access to each page of the two rings causes a page fault.
  for (int i = 0; i < 20 * kDepth; ++i) read(here), read(there);
  const Pair pair = measure(
      20'000, 200, [&] { read(here); }, [&] { read(there); });
  print_pair("owner's ring by time", "mirror by time", pair, "");
  std::printf("%-44s %47.2f  %s\n", "  ratio of the p99", pair.ours.p99 / pair.raw.p99, "<= 1.2");
}

// The additional cost of a write with eight remote subscribers, in units of one write to an eventfd
// that makes a bare process send 64 B to eight others.
void bench_writer(const Hosts& hosts, const std::string& address, const std::string& socket_path,
                  Session& session) {
  constexpr int kReaders = 8, kRounds = 60, kWrites = 100;
  const TypeInfo type{"", 64, 1, {}};
  RawWriter near = session.create_raw({"near", 0, ""}, type, History{1000, 1ms}).value();
  RawWriter far = session.create_raw({"far", 0, ""}, type, History{1000, 1ms}).value();
  const int bell = ::eventfd(0, EFD_CLOEXEC);
  std::vector<pid_t> bare;
  std::vector<int> sockets;
  for (int i = 0; i < kReaders; ++i) {
    const auto [here, there] = hosts.tcp_pair();
    sockets.push_back(here);
    bare.push_back(in_child([socket = there] {
      for (std::byte sample[64];;) receive_all(socket, sample, sizeof sample);
    }));
    ::close(there);
  }
  bare.push_back(in_child([&] {
    const int epoll = ::epoll_create1(EPOLL_CLOEXEC);
    epoll_event event{};
    event.events = EPOLLIN | EPOLLET;
    if (::epoll_ctl(epoll, EPOLL_CTL_ADD, bell, &event)) fail("epoll_ctl");
    const std::byte sample[64]{};
    while (::epoll_wait(epoll, &event, 1, -1) >= 0) {
      for (const int socket : sockets) send_all(socket, sample, sizeof sample);
    }
    fail("epoll_wait");
  }));
  const std::vector<std::byte> payload(64);
  near.write(payload, WallClock::now());
  auto& ready = shared<std::atomic<int>>();
  // A reader that never waits costs the writer no system call, only cache misses, like dssmd.
  const pid_t local = in_child([&] {
    RawReader reader = Session::connect({.socket_path = socket_path})
                           .value()
                           .open_raw_reader({"near", 0, ""})
                           .value();
    ready.fetch_add(1);
    std::vector<std::byte> out(64);
    for (SampleInfo info;; ::usleep(100)) {
      if (reader.read_newest(out, info) != ReadStatus::ok) fail("read");
    }
  });
  std::vector<pid_t> readers;
  for (int i = 0; i < kReaders; ++i) {
    readers.push_back(in_child([&] {
      const auto in_other = hosts.inside(2);
      PConnector connector = PConnector::open({"far", 0, ""}, {.address = address}).value();
      connector.subscribe({}).value();
      ready.fetch_add(1);
      std::vector<std::byte> out(64);
      for (SampleInfo info;;) {
        while (connector.wait(kNever) != WaitStatus::ready) {
        }
        while (connector.read_next(out, info).value() == ReadStatus::ok) {
        }
      }
    }));
  }
  while (ready.load() != kReaders + 1) ::usleep(1000);
  ::kill(local, SIGSTOP);
  const auto ring = [&] {
    const std::uint64_t one = 1;
    if (::write(bell, &one, sizeof one) != sizeof one) fail("write eventfd");
  };
  const auto paced = [&](std::vector<double>& ns, auto operation, auto untimed) {
    MonoTime next = MonoClock::now();
    for (int i = 0; i < kWrites; ++i) {
      sleep_until(next += 500us);
      const std::int64_t start = now_ns();
      operation();
      ns.push_back(static_cast<double>(now_ns() - start));
      untimed();
    }
  };
  std::vector<double> bare_ns, near_ns, far_ns;
  for (int round = 0; round < kRounds; ++round) {
    paced(bare_ns, ring, [] {});
    ::kill(local, SIGCONT);
    // In all three cases eight processes run between two writes and use the writer's caches.
    paced(
        near_ns, [&] { near.write(payload, WallClock::now()); }, ring);
    ::kill(local, SIGSTOP);
    paced(
        far_ns, [&] { far.write(payload, WallClock::now()); }, [] {});
  }
  end_child(local);
  for (const pid_t pid : readers) end_child(pid);
  for (const pid_t pid : bare) end_child(pid);
  for (const int socket : sockets) ::close(socket);
  ::close(bell);
  const Figures doorbell = figures_of(bare_ns), with_local = figures_of(near_ns),
                with = figures_of(far_ns);
  print_row("  write an eventfd, 64 B sent to 8 processes", doorbell);
  print_row("  write 64 B, a local reader polls", with_local);
  char rest[80];
  std::snprintf(rest, sizeof rest, "%7.2f  <= 1 more",
                (with.median - with_local.median) / doorbell.median);
  print_row("write 64 B, 8 remote readers", with, rest);
}

}  // namespace

int main() {
  on_hosts([](const Hosts& hosts) {
    const auto owner = hosts.start_owner(), other = hosts.start_other(*owner);
    Session session = Session::connect({.socket_path = owner->socket_path()}).value();
    Session there = Session::connect({.socket_path = other->socket_path()}).value();
    print_head();
    for (const std::size_t bytes : {64, 1024, 16 << 10, 64 << 10}) {
      bench_questions(hosts, owner->address(), session, bytes);
    }
    bench_mirror(session, there);
    bench_writer(hosts, owner->address(), owner->socket_path(), session);
  });
}
