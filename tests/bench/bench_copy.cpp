// SPDX-License-Identifier: Apache-2.0
//
// Writing and reading samples of several sizes with the public API, compared with clock_gettime for
// small ones, and with memcpy of the same size between the same buffers for large ones; and the
// writers' lock beside the C library's.
#include <pthread.h>

#include <cstdlib>
#include <cstring>
#include <dssm/dssm.hpp>
#include <filesystem>

#include "core/clock/clock_page.hpp"
#include "core/ring/robust_lock.hpp"
#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

void raw_clock() {
  timespec ts;
  ::clock_gettime(CLOCK_REALTIME, &ts);
  keep(ts);
}

struct Stream {
  RawWriter writer;
  RawReader reader;
};

Stream make_stream(Session& session, const char* name, std::uint64_t bytes, std::uint64_t depth) {
  const StreamId id{name, 0, ""};
  RawWriter writer =
      session.create_raw(id, TypeInfo{"", bytes, 1, {}}, History{depth, 1ms}).value();
  RawReader reader = session.open_raw_reader(id).value();
  return {std::move(writer), std::move(reader)};
}

void locks() {
  const UniqueFd fd = create_sealed_memory("bench-lock", system_page_bytes(), 0600).value();
  const ring::RobustLock lock = ring::RobustLock::map(fd.get()).value();
  pthread_mutexattr_t attributes;
  ::pthread_mutexattr_init(&attributes);
  ::pthread_mutexattr_setpshared(&attributes, PTHREAD_PROCESS_SHARED);
  ::pthread_mutexattr_setrobust(&attributes, PTHREAD_MUTEX_ROBUST);
  pthread_mutex_t mutex;
  ::pthread_mutex_init(&mutex, &attributes);
  const auto theirs = [&] {
    ::pthread_mutex_lock(&mutex);
    ::pthread_mutex_unlock(&mutex);
  };
  const auto ours = [&] {
    static_cast<void>(lock.lock());
    lock.unlock();
  };
  print_pair("robust mutex, lock and unlock", "writers' lock, lock and unlock",
             measure(2000, 1000, theirs, ours), "<= 1.0");
}

void small(Session& session) {
  Stream stream = make_stream(session, "small", 64, 1000);
  std::byte payload[64] = {};
  SampleInfo info;
  std::int64_t time = 0;
  const auto write = [&] { stream.writer.write(payload, time_from_ns(++time), 1us); };
  for (int i = 0; i < 2000; ++i) write();
  print_pair("clock_gettime", "write 64 B, given stamp", measure(2000, 1000, raw_clock, write),
             "<= 1.8");
  const auto read = [&] {
    if (stream.reader.read_newest(payload, info) != ReadStatus::ok) std::abort();
    keep(payload);
  };
  print_pair("clock_gettime", "read newest 64 B", measure(2000, 1000, raw_clock, read), "<= 1.2");
}

// The cost of the clock error that libdssm adds: writing with and without it, and reading the clock
// page, which contains a bound here, as with a chronyd.
void stamped(Session& session) {
  Stream stream = make_stream(session, "stamped", 64, 1000);
  std::byte payload[64] = {};
  Time now;
  int writes = 0;
  // Reading the clock in each write would hide the difference.
  const auto recently = [&] {
    if (writes++ % 1000 == 0) now = WallClock::now();
    return now;
  };
  const auto given = [&] { stream.writer.write(payload, recently(), 1us); };
  const auto own = [&] { stream.writer.write(payload, recently()); };
  print_pair("write 64 B, given stamp", "write 64 B, own clock's error",
             measure(2000, 1000, given, own), "at most 5 ns more");

  {
    static clock::ClockPage page{};
    clock::ClockPageState stated;
    stated.wall = Time(50s);
    stated.clock.bound = 100us;
    stated.clock.ageing_ppb = 56'250;
    page.state.store(stated);
    Time t = stated.wall;
    const auto nothing = [&] { keep(t += 1ns); };
    clock::ClockErrorCache cache;
    const auto look = [&] {
      Duration error{};
      if (!cache.find(&page, t += 1ns, error)) std::abort();
      keep(error);
    };
    print_pair("nothing", "read the clock page", measure(2000, 1000, nothing, look),
               "at most 5 ns more");
  }
}

// memcpy uses the same buffers: the caller's and the ring's slots, in the order of writing and half
// a lap apart, so that neither fills the caches for the other.
void large(Session& session, std::uint64_t bytes, std::uint64_t depth, int batches) {
  const std::string size = std::to_string(bytes / 1024) + " KiB";
  Stream stream = make_stream(session, ("large" + std::to_string(bytes)).c_str(), bytes, depth);
  std::vector<std::byte> mine(bytes, std::byte{1});
  std::vector<std::byte*> slots;
  SampleInfo info;
  for (std::uint64_t i = 0; i < depth; ++i) {
    LoanedSample loan = stream.writer.loan();
    slots.push_back(loan.payload().data());
    loan.publish(time_from_ns(1));
  }
  std::uint64_t slot = depth / 2;
  print_pair("memcpy " + size, "write " + size,
             measure(
                 batches, 1,
                 [&] {
                   slot = (slot + 1) % depth;
                   std::memcpy(slots[slot], mine.data(), bytes);
                   keep(slots);
                 },
                 [&] { stream.writer.write(mine, time_from_ns(1)); }),
             "<= 1.1");
  const auto newest = static_cast<std::uint64_t>(stream.writer.newest_tid()) % depth;
  print_pair("memcpy " + size, "read " + size,
             measure(
                 batches, 1,
                 [&] {
                   std::memcpy(mine.data(), slots[newest], bytes);
                   keep(mine);
                 },
                 [&] {
                   if (stream.reader.read_newest(mine, info) != ReadStatus::ok) std::abort();
                   keep(mine);
                 }),
             "<= 1.1");
  Stream tiny = make_stream(session, ("tiny" + std::to_string(bytes)).c_str(), 64, depth);
  std::byte payload[64] = {};
  print_pair("write 64 B", "loan and publish " + size,
             measure(
                 1000, 100, [&] { tiny.writer.write(payload, time_from_ns(1)); },
                 [&] {
                   LoanedSample loan = stream.writer.loan();
                   keep(loan);
                   loan.publish(time_from_ns(1));
                 }),
             "as 64 B");
  print_pair("read 64 B", "borrow and check " + size,
             measure(
                 1000, 100,
                 [&] {
                   if (tiny.reader.read_newest(payload, info) != ReadStatus::ok) std::abort();
                   keep(payload);
                 },
                 [&] {
                   BorrowedSample sample;
                   if (stream.reader.borrow(stream.reader.newest_tid(), sample) != ReadStatus::ok ||
                       !sample.still_valid()) {
                     std::abort();
                   }
                   keep(sample);
                 }),
             "as 64 B");
}

}  // namespace

int main() {
  test::DaemonProcess daemon;
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  print_head();
  locks();
  small(session);
  stamped(session);
  large(session, 64 << 10, 32, 4000);
  large(session, 1 << 20, 16, 1000);
}
