// SPDX-License-Identifier: Apache-2.0
//
// Reading at random times, for several depths and shapes of streams. The raw limit is what every
// search must do, with its cache misses, in the same memory: for a known tid, read its entry in the
// time index, and then copy the sample from its slot.
#include <dssm/dssm.hpp>
#include <filesystem>
#include <random>

#include "core/ring/ring_reader.hpp"
#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kQuestions = 1 << 16;

// The stream's ring, mapped a second time, for the raw limit.
std::shared_ptr<const ring::RingMapping> ring_of(Session& session, const StreamId& id) {
  const std::string wanted = "dssm-ring:" + session.stream_info(id).value().id.str();
  for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd")) {
    std::error_code error;
    const std::string target = std::filesystem::read_symlink(entry, error).string();
    if (target.find(wanted) == std::string::npos) continue;
    const int fd = std::stoi(entry.path().filename().string());
    auto mapping = ring::RingMapping::open_untrusted(fd, ring::Access::read_only);
    if (mapping) return *mapping;
  }
  std::abort();
}

void shape(Session& session, const std::string& name, std::uint64_t depth, Duration cycle,
           auto next_time, const std::string& target, int batches = 300) {
  const StreamId id{"s" + std::to_string(depth) + name.substr(0, 4), 0, ""};
  RawWriter writer = session.create_raw(id, TypeInfo{"", 64, 1, {}}, History{depth, cycle}).value();
  RawReader reader = session.open_raw_reader(id).value();
  const auto ring = ring_of(session, id);
  const ring::SlotTable slots(*ring);
  const ring::RingReader raw_reader(*ring);
  std::byte payload[64] = {};
  std::int64_t time = 1'000'000'000;
  std::mt19937_64 random(depth);
  for (std::uint64_t i = 0; i < depth + depth / 2; ++i) {
    time = next_time(time, random);
    writer.write(payload, time_from_ns(time));
  }
  // Times all over the window, and the slots of their samples.
  std::vector<Time> questions;
  std::vector<Tid> places;
  SampleInfo oldest, newest, found;
  if (reader.read_info(reader.oldest_tid() + 1, oldest) != ReadStatus::ok ||
      reader.read_info(reader.newest_tid(), newest) != ReadStatus::ok) {
    std::abort();
  }
  while (questions.size() < kQuestions) {
    SampleInfo any;
    const Tid tid =
        oldest.tid +
        static_cast<Tid>(random() % static_cast<std::uint64_t>(newest.tid - oldest.tid + 1));
    if (reader.read_info(tid, any) != ReadStatus::ok) std::abort();
    const Time t = any.time + Duration(static_cast<std::int64_t>(random() % 500));
    if (reader.find(t, found) != ReadStatus::ok) continue;  // older than the oldest sample
    questions.push_back(t);
    places.push_back(found.tid);
  }
  std::size_t raw_at = 0, our_at = 0;
  SampleInfo info;
  const auto touch = [&] {
    const Tid known = places[raw_at++ % kQuestions];
    const std::int64_t time_ns = slots.time_ns(known).load(std::memory_order_relaxed);
    // The tid depends on the time, as in a search; the difference is always 0.
    const Tid tid = known + (time_ns < 0 ? 1 : 0);
    if (raw_reader.read(tid, payload, info) != ReadStatus::ok) std::abort();
    keep(payload);
  };
  const auto read = [&] {
    if (reader.read_at(questions[our_at++ % kQuestions], payload, info) != ReadStatus::ok)
      std::abort();
    keep(payload);
  };
  char label[80];
  std::snprintf(label, sizeof label, "at(t), %s, depth %llu", name.c_str(),
                static_cast<unsigned long long>(depth));
  print_pair("the same sample, tid known", label, measure(batches, 1000, touch, read), target);
}

}  // namespace

int main() {
  test::DaemonProcess daemon;
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  const auto regular = [](std::int64_t last, auto&) { return last + 1'000'000; };
  const auto jitter = [](std::int64_t last, auto& random) {
    return last + 900'000 + static_cast<std::int64_t>(random() % 200'000);
  };
  const auto irregular = [](std::int64_t last, auto& random) {
    return last + (std::int64_t{1} << (10 + random() % 20));
  };
  const auto zigzag = [up = 0](std::int64_t last, auto&) mutable {
    return last + (++up % 2 ? 2'500'000 : -1'000'000);
  };
  print_head();
  for (const std::uint64_t depth : {100, 1000, 10'000, 100'000, 1'000'000}) {
    shape(session, "regular", depth, 1ms, regular,
          depth == 100         ? "<= 60 ns"
          : depth == 1'000'000 ? "<= 1.3 * depth 100, less misses"
                               : "");
  }
  shape(session, "jitter of 10 %", 100'000, 1ms, jitter, "");
  shape(session, "wrong cycle, 10 times", 100'000, 10ms, regular, "< 1 us");
  shape(session, "irregular", 100'000, 1ms, irregular, "< 1 us");
  shape(session, "every other sample backwards", 100'000, 1ms, zigzag, "< 1 us");
}
