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

// The life of the samples that the stream holds.
std::uint64_t life_of(Session& session, const KnownStream& known) {
  RawReader reader = session.open_raw_reader(known.id).value();
  std::vector<std::byte> payload(known.payload_bytes);
  SampleInfo info;
  while (reader.read_newest(payload, info) != ReadStatus::ok) continue;  // not lapped forever
  return KnownStream::life(payload);
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

LoadWriter::LoadWriter(Session session, const std::vector<KnownStream>& streams,
                       std::uint64_t life) {
  for (const KnownStream& known : streams) {
    RawWriter writer = session.create_raw(known.id, known.type(), known.history()).value();
    const bool begins = writer.newest_tid() == kNoTid;
    streams_.push_back({known, std::move(writer), begins ? life : life_of(session, known)});
  }
}

void LoadWriter::write_until(const std::atomic<bool>& stop) {
  const MonoTime begin = MonoClock::now();
  while (!stop) {
    const Duration elapsed = MonoClock::now() - begin;
    for (Written& stream : streams_) {
      const auto due = static_cast<std::uint64_t>(elapsed / stream.known.cycle);
      while (stream.written < due) stream.write_next();
    }
    std::this_thread::sleep_for(1ms);  // the load's rate, not a wait for anything
  }
}

void LoadWriter::Written::write_next() {
  const SampleInfo info = known.info(writer.newest_tid() + 1);
  LoanedSample loan = writer.loan();
  known.fill(loan.payload(), life, info.tid);
  loan.publish(info.time, info.clock_error);
  ++written;
}

std::vector<KnownStream> published_load(std::uint64_t percent) {
  std::vector<KnownStream> streams;
  for (const Kind& kind : {Kind{1000, 64, 1 << 18}, Kind{1000, 16, 1 << 18},
                           Kind{200, 1024, 1 << 15}, Kind{50, 16 << 10, 1 << 12}}) {
    const int number = static_cast<int>(streams.size());
    const Duration cycle = Duration(1s) / kind.rate_hz * 100 / static_cast<std::int64_t>(percent);
    streams.push_back({{"published", number, "pc1"},
                       kind.payload_bytes,
                       kind.depth,
                       cycle,
                       cycle,
                       static_cast<std::uint64_t>(500 + number)});
  }
  return streams;
}

KnownStream steady_stream() { return {{"steady", 0, "pc1"}, 256, 1 << 16, 1ms, 0ms, 1000}; }

}  // namespace dssm::test
