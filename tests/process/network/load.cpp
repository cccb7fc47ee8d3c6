// SPDX-License-Identifier: Apache-2.0
#include "tests/process/network/load.hpp"

#include <string>
#include <thread>

#include "tests/support/network.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct Kind {
  int rate_hz;
  std::uint64_t payload_bytes, depth;
};

constexpr Kind kKinds[] = {
    {1000, 64, 16384},    {1000, 256, 8192},   {1000, 1024, 1024},  {1000, 64, 128},
    {500, 512, 8192},     {500, 4 << 10, 512}, {200, 1024, 4096},   {200, 8 << 10, 512},
    {100, 16 << 10, 512}, {100, 4 << 10, 32},  {50, 32 << 10, 256}, {20, 64 << 10, 256},
    {20, 256 << 10, 64},  {10, 512 << 10, 32}, {10, 1 << 20, 16},
};

// A stream that is being written.
struct Written {
  const KnownStream& known;
  RawWriter writer;
  std::uint64_t life;
  std::uint64_t written = 0;  // by this program

  void write_next() {
    const SampleInfo info = known.info(writer.newest() + 1);
    Loan loan = writer.loan();
    known.fill(loan.payload(), life, info.tid);
    loan.publish(info.time, info.clock_error);
    ++written;
  }
};

// The life of the samples that the stream holds already; `otherwise` when there are none.
std::uint64_t life_of(Session& session, const KnownStream& known, std::uint64_t otherwise) {
  RawReader reader = session.open_raw_reader(known.id).value();
  std::vector<std::byte> payload(known.payload_bytes);
  SampleInfo info;
  return reader.latest(payload, info) == ReadStatus::ok ? KnownStream::life(payload) : otherwise;
}

}  // namespace

std::vector<KnownStream> load_of(int host, std::uint64_t percent) {
  std::vector<KnownStream> streams;
  for (const Kind& kind : kKinds) {
    const int number = static_cast<int>(streams.size());
    const Duration cycle = Duration(1s) / kind.rate_hz * 100 / static_cast<std::int64_t>(percent);
    streams.push_back({{"load", number, Network::name(host)},
                       kind.payload_bytes,
                       kind.depth,
                       cycle,
                       number % 3 == 0 ? 5 * cycle : cycle / 4,
                       static_cast<std::uint64_t>(100 * host + number)});
  }
  return streams;
}

void write_load(Session session, const std::vector<KnownStream>& streams, std::uint64_t life,
                const std::atomic<bool>& stop) {
  std::vector<Written> all;
  for (const KnownStream& known : streams) {
    RawWriter writer = session.create_raw(known.id, known.type(), known.history()).value();
    all.push_back({known, std::move(writer), life_of(session, known, life)});
  }
  const MonoTime begin = MonoClock::now();
  while (!stop) {
    const Duration gone = MonoClock::now() - begin;
    for (Written& stream : all) {
      const auto due = static_cast<std::uint64_t>(gone / stream.known.cycle);
      while (stream.written < due) stream.write_next();
    }
    std::this_thread::sleep_for(1ms);  // the load's rate, not a wait for anything
  }
}

KnownStream steady_stream() { return {{"steady", 0, "pc1"}, 256, 1 << 16, 1ms, 0ms, 1000}; }

}  // namespace dssm::test
