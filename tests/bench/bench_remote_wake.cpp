// SPDX-License-Identifier: Apache-2.0
//
// From a writer on one host to a sleeping reader on another, 1,000 times a second: the latency, and
// the CPU time of all processes together. It alternates with a chain of bare processes with the
// same hops: eventfd wake, TCP one way, futex wake.
#include <sys/eventfd.h>

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

constexpr int kSamples =
    100;  // of one round; many rounds, since the scheduler places processes differently in each
constexpr int kRounds = 60;
constexpr std::size_t kMaxPayloadBytes = 1024;

enum class Kind { raw_mirror, our_mirror, raw_connector, our_connector, count };
constexpr auto kKinds = static_cast<std::size_t>(Kind::count);

// Shared memory of one chain.
struct alignas(64) Chain {
  alignas(64) std::atomic<std::uint32_t> word{0};  // raw: the futex of the last hop
  alignas(64) std::atomic<std::uint32_t> arrived{0};
  alignas(64) std::byte here[kMaxPayloadBytes];   // raw: in place of the owner's ring
  alignas(64) std::byte there[kMaxPayloadBytes];  // raw: in place of the mirror
  double took_ns[kSamples * kRounds];

  // In the last process of the chain.
  void arrive(const std::byte* payload) {
    std::int64_t sent_ns = 0;
    std::memcpy(&sent_ns, payload, sizeof sent_ns);
    const std::uint32_t n = arrived.load(std::memory_order_relaxed);
    took_ns[n] = static_cast<double>(now_ns() - sent_ns);
    arrived.store(n + 1, std::memory_order_release);
  }
};
struct Shared {
  Chain chains[kKinds];
  Chain& operator[](Kind kind) { return chains[static_cast<std::size_t>(kind)]; }
};

std::int64_t cpu_of(const std::vector<pid_t>& processes) {
  std::int64_t sum = cpu_ns(::getpid());
  for (const pid_t pid : processes) sum += cpu_ns(pid);
  return sum;
}

[[noreturn]] void forward(int doorbell, int socket, const std::byte* payload, std::size_t bytes) {
  for (;;) {
    std::uint64_t count = 0;
    if (::read(doorbell, &count, sizeof count) != sizeof count) fail("read eventfd");
    // One each: on a busy machine one read may return several writes.
    for (; count > 0; --count) send_all(socket, payload, bytes);
  }
}

[[noreturn]] void fill(int socket, Chain& chain, std::size_t bytes) {
  for (;;) {
    receive_all(socket, chain.there, bytes);
    chain.word.fetch_add(1);
    futex_wake(chain.word);
  }
}

[[noreturn]] void sleep_on_futex(Chain& chain) {
  for (std::uint32_t seen = 0;; ++seen) {
    while (chain.word.load() == seen) futex_wait(chain.word, seen);
    chain.arrive(chain.there);
  }
}

[[noreturn]] void sleep_on_socket(int socket, Chain& chain, std::size_t bytes) {
  for (;;) {
    receive_all(socket, chain.there, bytes);
    chain.arrive(chain.there);
  }
}

[[noreturn]] void read_mirror(const std::string& socket, Chain& chain) {
  Session session = Session::connect({.socket_path = socket}).value();
  RawReader reader = session.await_raw_reader(StreamId{"chain", 0, "pc1"}, kNever).value();
  std::vector<std::byte> payload(reader.payload_bytes());
  SampleInfo info;
  reader.seek(reader.newest_tid());
  chain.word.store(1);
  for (;;) {
    while (reader.wait(kNever) != WaitStatus::ready) {
    }
    while (reader.read_next(payload, info) == ReadStatus::ok) chain.arrive(payload.data());
  }
}

[[noreturn]] void read_connector(const std::string& address, Chain& chain) {
  PConnector connector = PConnector::open({"chain", 0, ""}, {.address = address}).value();
  connector.subscribe({.start = Subscription::Start::now}).value();
  std::vector<std::byte> payload(connector.payload_bytes());
  SampleInfo info;
  chain.word.store(1);
  for (;;) {
    while (connector.wait(kNever) != WaitStatus::ready) {
    }
    while (connector.read_next(payload, info).value() == ReadStatus::ok)
      chain.arrive(payload.data());
  }
}

void wait_until_ready(Chain& chain) {
  while (chain.word.load() == 0) ::usleep(1000);
}

// One round: a sample per millisecond by `send`. Returns the CPU time of all `processes`.
template <class Send>
std::int64_t round(Chain& chain, const std::vector<pid_t>& processes, Send send) {
  const std::uint32_t until = chain.arrived.load() + kSamples;
  const std::int64_t cpu_before = cpu_of(processes);
  MonoTime next = MonoClock::now() + 5ms;
  for (int i = 0; i < kSamples; ++i) {
    sleep_until(next += 1ms);
    send();
  }
  while (chain.arrived.load(std::memory_order_acquire) < until) ::usleep(1000);
  return cpu_of(processes) - cpu_before;
}

// The median of ten ratios of p99s, each of a tenth of the rounds.
double middle_p99_ratio(const Chain& raw, const Chain& ours) {
  constexpr int kAll = kSamples * kRounds;
  std::vector<double> ratios = p99_of_parts(ours.took_ns, ours.took_ns + kAll);
  const std::vector<double> raws = p99_of_parts(raw.took_ns, raw.took_ns + kAll);
  for (std::size_t part = 0; part < ratios.size(); ++part) ratios[part] /= raws[part];
  return figures_of(std::move(ratios)).median;
}

void print(const std::string& raw_name, const std::string& our_name, Chain& raw, Chain& ours,
           std::int64_t raw_cpu_ns, std::int64_t our_cpu_ns, const char* cpu_target) {
  constexpr int kAll = kSamples * kRounds;
  const Pair pair{figures_of({raw.took_ns, raw.took_ns + kAll}),
                  figures_of({ours.took_ns, ours.took_ns + kAll})};
  print_pair(raw_name, our_name, pair, "<= 1.2, p99 <= 1.5");
  std::printf("%-44s %47.2f\n", "  ratio of the p99", pair.ours.p99 / pair.raw.p99);
  std::printf("%-44s %47.2f\n", "  the same, middle of ten parts", middle_p99_ratio(raw, ours));
  const auto per_1000 = [](std::int64_t ns) { return static_cast<double>(ns) / kAll; };
  std::printf("%-44s %9.1f  raw %9.1f %17.2f  %s\n",
              "  CPU time of 1,000 samples [us], all processes", per_1000(our_cpu_ns),
              per_1000(raw_cpu_ns),
              static_cast<double>(our_cpu_ns) / static_cast<double>(raw_cpu_ns), cpu_target);
}

void measure_wakes(const Hosts& hosts, std::size_t bytes) {
  const auto owner = hosts.start_owner();
  auto& all = shared<Shared>();
  const int bells[] = {::eventfd(0, EFD_CLOEXEC), ::eventfd(0, EFD_CLOEXEC)};
  const auto [mirror_out, mirror_in] = hosts.tcp_pair();
  const auto [connector_out, connector_in] = hosts.tcp_pair();
  Chain& raw_mirror = all[Kind::raw_mirror];
  Chain& our_mirror = all[Kind::our_mirror];
  Chain& raw_connector = all[Kind::raw_connector];
  Chain& our_connector = all[Kind::our_connector];
  const std::vector<pid_t> raw_mirror_processes = {
      in_child([&] { forward(bells[0], mirror_out, raw_mirror.here, bytes); }),
      in_child([&] { fill(mirror_in, raw_mirror, bytes); }),
      in_child([&] { sleep_on_futex(raw_mirror); })};
  const std::vector<pid_t> raw_connector_processes = {
      in_child([&] { forward(bells[1], connector_out, raw_connector.here, bytes); }),
      in_child([&] { sleep_on_socket(connector_in, raw_connector, bytes); })};

  Session session = Session::connect({.socket_path = owner->socket_path()}).value();
  RawWriter writer =
      session.create_raw({"chain", 0, ""}, {"", bytes, 1, {}}, History{1000, 1ms}).value();
  std::vector<std::byte> payload(bytes);
  const auto send_raw = [&](Chain& chain, int bell) {
    const std::int64_t now = now_ns();
    std::memcpy(chain.here, &now, sizeof now);
    const std::uint64_t one = 1;
    if (::write(bell, &one, sizeof one) != sizeof one) fail("write eventfd");
  };
  const auto send_ours = [&] {
    const std::int64_t now = now_ns();
    std::memcpy(payload.data(), &now, sizeof now);
    writer.write(payload, time_from_ns(now));
  };

  std::int64_t cpu[kKinds] = {};
  const std::string tail = ", " + std::to_string(bytes) + " B";
  {
    const auto mirror = hosts.start_other(*owner);
    const std::string socket = mirror->socket_path();
    const pid_t reader = in_child([&] { read_mirror(socket, our_mirror); });
    wait_until_ready(our_mirror);
    for (int i = 0; i < kRounds; ++i) {
      cpu[0] += round(raw_mirror, raw_mirror_processes, [&] { send_raw(raw_mirror, bells[0]); });
      cpu[1] += round(our_mirror, {owner->pid(), mirror->pid(), reader}, send_ours);
    }
    end_child(reader);
    print("eventfd, TCP, futex" + tail, "writer to sleeping reader of a mirror" + tail, raw_mirror,
          our_mirror, cpu[0], cpu[1], bytes == 1024 ? "<= 1.3" : "");
  }
  const std::string address = owner->address();
  const pid_t reader = in_child([&] {
    const auto in_other = hosts.inside(2);
    read_connector(address, our_connector);
  });
  wait_until_ready(our_connector);
  for (int i = 0; i < kRounds; ++i) {
    cpu[2] +=
        round(raw_connector, raw_connector_processes, [&] { send_raw(raw_connector, bells[1]); });
    cpu[3] += round(our_connector, {owner->pid(), reader}, send_ours);
  }
  end_child(reader);
  print("eventfd, TCP" + tail, "writer to sleeping PConnector" + tail, raw_connector, our_connector,
        cpu[2], cpu[3], "");
  for (const pid_t pid : raw_mirror_processes) end_child(pid);
  for (const pid_t pid : raw_connector_processes) end_child(pid);
  for (const int fd : {bells[0], bells[1], mirror_out, mirror_in, connector_out, connector_in}) {
    ::close(fd);
  }
}

}  // namespace

int main() {
  on_hosts([](const Hosts& hosts) {
    print_head();
    measure_wakes(hosts, 64);
    measure_wakes(hosts, 1024);
  });
}
