// SPDX-License-Identifier: Apache-2.0
//
// The throughput of one channel: large samples compared with raw TCP with writes of the same size,
// and the rate of small samples; and how often a payload is copied on the way.
//
// The samples are in the owner's ring before the clock starts, and the reader reads all of them
// into one buffer, so only sending and receiving is measured. The raw sender's memory is as large
// as the ring, so that neither side works only in the cache.
//
// Raw TCP is measured twice: in a straightforward way, to which the target refers, and as fast as
// bare processes can be made.
#include <fcntl.h>
#include <sys/mman.h>

#include <algorithm>
#include <cinttypes>
#include <cstring>
#include <dssm/dssm.hpp>
#include <dssm/pconnector.hpp>
#include <string>

#include "tests/bench/harness.hpp"
#include "tests/bench/hosts.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kRounds = 7;
constexpr std::uint64_t kPostedDepth = 32;

// Memory with pages of the same size as a ring's.
class SharedMemory {
 public:
  explicit SharedMemory(std::size_t size) : bytes_(size) {
    void* const place =
        ::mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (place == MAP_FAILED) fail("map shared memory");
    data_ = static_cast<std::byte*>(place);
    std::memset(data_, 1, size);
  }
  SharedMemory(const SharedMemory&) = delete;
  SharedMemory& operator=(const SharedMemory&) = delete;
  ~SharedMemory() { ::munmap(data_, bytes_); }

  const std::byte* data() const { return data_; }
  std::size_t bytes() const { return bytes_; }

  // So that a new process has no page faults later.
  void touch() const {
    for (std::size_t at = 0; at < bytes_; at += 4096) {
      static_cast<void>(*static_cast<const volatile std::byte*>(data_ + at));
    }
  }

 private:
  std::byte* data_;
  std::size_t bytes_;
};

struct RawWay {
  std::size_t write_bytes;
  int receive_flags;  // of receive_all()
};

double raw_bytes_per_s(const Hosts& hosts, const SharedMemory& all, std::size_t bytes,
                       const RawWay& way) {
  const auto [out, in] = hosts.tcp_pair();
  const int sender = out;
  const pid_t pid = in_child([&] {
    all.touch();
    std::byte go{};
    send_all(sender, &go, 1);
    receive_all(sender, &go, 1);
    for (std::size_t at = 0; at < all.bytes(); at += way.write_bytes)
      send_all(sender, all.data() + at, way.write_bytes);
  });
  std::vector<std::byte> one(bytes);
  receive_all(in, one.data(), 1);
  const std::int64_t start = now_ns();
  send_all(in, one.data(), 1);
  for (std::size_t at = 0; at < all.bytes(); at += bytes) {
    receive_all(in, one.data(), bytes, way.receive_flags);
  }
  const double took = static_cast<double>(now_ns() - start);
  ::waitpid(pid, nullptr, 0);
  ::close(in), ::close(out);
  return static_cast<double>(all.bytes()) * 1e9 / took;
}

// Reads `count` samples by a subscription; returns the duration.
double drain_ns(PConnector& connector, std::size_t bytes, std::size_t count) {
  std::vector<std::byte> one(bytes);
  SampleInfo info;
  const std::int64_t start = now_ns();
  connector.subscribe({.start = Subscription::Start::oldest}).value();
  for (std::size_t i = 0; i < count;) {
    if (connector.read_next(one, info).value() != ReadStatus::ok) {
      static_cast<void>(connector.wait(kNever));
    } else {
      ++i;
    }
  }
  const double took = static_cast<double>(now_ns() - start);
  connector.unsubscribe().value();
  return took;
}

// Posts `count` samples and waits until they are written; returns the duration.
double post_ns(PConnector& connector, const std::vector<std::byte>& one, std::size_t count) {
  const std::int64_t start = now_ns();
  for (std::size_t i = 0; i < count; ++i) {
    connector.post(one, time_from_ns(static_cast<std::int64_t>(i))).value();
  }
  const Tid last = connector.flush(deadline_in(60s)).value();
  const double took = static_cast<double>(now_ns() - start);
  if (last % static_cast<Tid>(count) != static_cast<Tid>(count) - 1) fail("post all samples");
  return took;
}

RawWriter fill(Session& session, const StreamId& id, std::size_t bytes, std::size_t count) {
  RawWriter writer = session.create_raw(id, {"", bytes, 1, {}}, History{count + 1, 1ms}).value();
  std::vector<std::byte> payload(bytes, std::byte{1});
  for (std::size_t i = 0; i < count; ++i)
    writer.write(payload, time_from_ns(static_cast<std::int64_t>(i)));
  return writer;
}

void print_receiver_copies(const PConnector::Counters& counters, std::size_t bytes) {
  const double received = static_cast<double>(counters.samples * bytes);
  std::printf("%-44s %9.3f\n", "  user-space copies of a payload, receiver",
              static_cast<double>(counters.copied_payload_bytes) / received);
}

void bench_large(const Hosts& hosts, const std::string& address, Session& session,
                 std::size_t bytes, std::size_t count) {
  const StreamId id{"large", static_cast<std::int32_t>(bytes), ""};
  const RawWriter writer = fill(session, id, bytes, count);
  const auto in_other = hosts.inside(2);
  PConnector connector = PConnector::open(id, {.address = address}).value();
  const RawWay plain{bytes, 0}, fastest{std::min<std::size_t>(bytes, 256 << 10), MSG_DONTWAIT};
  PConnector poster =
      PConnector::create(
          {"posted", id.id, ""}, {"", bytes, 1, {}}, History{kPostedDepth, 1ms},
          {.address = address, .max_unsent_samples = count, .max_unsent_bytes = bytes * count})
          .value();
  const std::vector<std::byte> posted(bytes, std::byte{1});
  std::vector<double> raw, awake, ours, posts;
  const SharedMemory all(bytes * count);
  drain_ns(connector, bytes, count);
  post_ns(poster, posted, count);
  for (int i = 0; i < kRounds; ++i) {
    raw.push_back(raw_bytes_per_s(hosts, all, bytes, plain) / 1e6);
    awake.push_back(raw_bytes_per_s(hosts, all, bytes, fastest) / 1e6);
    ours.push_back(static_cast<double>(bytes * count) * 1e3 / drain_ns(connector, bytes, count));
    posts.push_back(static_cast<double>(bytes * count) * 1e3 / post_ns(poster, posted, count));
  }
  const Figures raw_figures = figures_of(raw), awake_figures = figures_of(awake),
                our_figures = figures_of(ours), posted_figures = figures_of(posts);
  const std::string tail = ", " + std::to_string(bytes >> 10) + " KiB";
  char rest[80];
  std::snprintf(rest, sizeof rest, "%7.2f  >= 0.9", our_figures.median / raw_figures.median);
  print_row("  raw TCP [MB/s]" + tail, raw_figures);
  print_row("one channel [MB/s]" + tail, our_figures, rest);
  print_row("  raw TCP that never sleeps [MB/s]" + tail, awake_figures);
  std::printf("%-44s %47.2f\n", "  one channel compared with that",
              our_figures.median / awake_figures.median);
  print_receiver_copies(connector.counters(), bytes);
  print_row("PConnector::post [MB/s]" + tail, posted_figures);
  std::printf("%-44s %47.2f\n", "  compared with raw TCP",
              posted_figures.median / raw_figures.median);
  session.remove(id).value();
}

void bench_small(const Hosts& hosts, const std::string& address, Session& session, Session& other) {
  constexpr std::size_t kCount = 1'000'000, kBytes = 64;
  const StreamId id{"small", 0, "pc1"};
  const RawWriter writer = fill(session, id, kBytes, kCount);
  std::vector<double> connector_rate, mirror_rate;
  const auto in_other = hosts.inside(2);
  PConnector connector = PConnector::open(id, {.address = address}).value();
  for (int i = 0; i < kRounds; ++i) {
    connector_rate.push_back(static_cast<double>(kCount) * 1e9 /
                             drain_ns(connector, kBytes, kCount));
  }
  print_row("PConnector, 64 B [samples/s]", figures_of(connector_rate), "         >= 1000000");
  print_receiver_copies(connector.counters(), kBytes);
  const std::int64_t start = now_ns();
  RawReader reader =
      other.await_raw_reader(id, deadline_in(30s), nullptr, FetchHistory::at_once).value();
  while (reader.wait_for_sample(0, kNever) != WaitStatus::ready) {  // the newest ones come first
  }
  mirror_rate.push_back(static_cast<double>(kCount) * 1e9 / static_cast<double>(now_ns() - start));
  if (reader.oldest_tid() != 0) fail("samples are missing");
  print_row("mirror from nothing, 64 B [samples/s]", figures_of(mirror_rate),
            "         >= 1000000");
  session.remove(id).value();
}

// Congestion control decides when a sender may send, and so affects all figures here.
void print_congestion_control(const Hosts& hosts) {
  char name[16]{};
  socklen_t length = sizeof name;
  const auto [out, in] = hosts.tcp_pair();
  if (::getsockopt(out, IPPROTO_TCP, TCP_CONGESTION, name, &length))
    fail("read the congestion control");
  ::close(out), ::close(in);
  std::printf("TCP's congestion control is '%s'\n", name);
}

// Parses what the owner's dssmd logs at the end of a channel about sent payloads.
void count_copies(const Hosts& hosts, std::size_t bytes, std::size_t count) {
  const int log = ::memfd_create("log", MFD_CLOEXEC), screen = ::fcntl(2, F_DUPFD_CLOEXEC, 3);
  if (log < 0 || screen < 0 || ::dup2(log, 2) < 0) fail("catch the log");
  const auto owner = hosts.start_owner("debug");
  ::dup2(screen, 2);
  Session session = Session::connect({.socket_path = owner->socket_path()}).value();
  const StreamId id{"copied", 0, ""};
  const RawWriter writer = fill(session, id, bytes, count);
  {
    const auto in_other = hosts.inside(2);
    PConnector connector = PConnector::open(id, {.address = owner->address()}).value();
    drain_ns(connector, bytes, count);
  }
  for (std::string text(1 << 16, ' ');; ::usleep(1000)) {
    const ssize_t length = ::pread(log, text.data(), text.size(), 0);
    const std::string said = text.substr(0, static_cast<std::size_t>(std::max<ssize_t>(length, 0)));
    const std::size_t at = said.find(" samples sent (");
    if (at == std::string::npos) continue;
    std::uint64_t copied = 0, in_place = 0;
    if (std::sscanf(said.c_str() + at, " samples sent (%" SCNu64 " payload bytes copied, %" SCNu64,
                    &copied, &in_place) != 2) {
      fail("parse dssmd's log");
    }
    std::printf("%-44s %9.3f\n", "  user-space copies of a payload, sender",
                static_cast<double>(copied) / static_cast<double>(copied + in_place));
    break;
  }
  ::close(log), ::close(screen);
}

}  // namespace

int main() {
  on_hosts([](const Hosts& hosts) {
    const auto owner = hosts.start_owner(), other = hosts.start_other(*owner);
    Session session = Session::connect({.socket_path = owner->socket_path()}).value();
    Session there = Session::connect({.socket_path = other->socket_path()}).value();
    print_congestion_control(hosts);
    std::printf("%-44s %9s %9s %9s %9s  %7s  %s\n", "more is better", "min", "median", "p99",
                "p99.9", "ratio", "target");
    for (const std::size_t bytes : {64 << 10, 1 << 20}) {
      const std::size_t count = (256U << 20) / bytes;
      bench_large(hosts, owner->address(), session, bytes, count);
      count_copies(hosts, bytes, count);
    }
    bench_small(hosts, owner->address(), session, there);
    count_copies(hosts, 64, 1'000'000);
  });
}
