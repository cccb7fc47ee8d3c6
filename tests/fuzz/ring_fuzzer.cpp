// SPDX-License-Identifier: Apache-2.0
//
// A ring left by a hostile writer: a valid ring with some samples, and then arbitrary bytes written
// over header, time index and slots. Opening and reading it may return wrong data, but must not
// crash or hang. The input is a list of records: 2 bytes offset (in units of 8 bytes), 1 byte
// length, bytes.
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "core/ring/bell.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"
#include "tests/fuzz/fuzzer.hpp"

namespace dssm::ring {
namespace {

constexpr std::uint64_t kPayloadBytes = 24, kDepth = 8;

void fill(const UniqueFd& ring) {
  const auto mapping = RingMapping::open_untrusted(ring.get(), Access::read_write);
  const auto bell_fd = create_bell("fuzz");
  if (!mapping || !bell_fd) std::abort();
  const auto bell = Bell::open_untrusted(bell_fd->get());
  if (!bell) std::abort();
  RingWriter writer(**mapping, **bell, -1);
  const std::vector<std::byte> payload(kPayloadBytes);
  for (const int time : {10, 20, 30, 15, 25, 35, 5, 40, 50, 60, 45}) {
    writer.write(payload, time_from_ns(time), Duration(1));
  }
}

void scribble(const UniqueFd& ring, const Geometry& geometry, std::span<const std::uint8_t> input) {
  while (input.size() >= 4) {
    const std::size_t at = (input[0] + input[1] * std::size_t{256}) * 8 % geometry.total_bytes;
    const std::size_t length = std::min<std::size_t>(
        {1 + std::size_t{input[2]} % 64, input.size() - 3, geometry.total_bytes - at});
    if (::pwrite(ring.get(), input.data() + 3, length, static_cast<off_t>(at)) < 0) std::abort();
    input = input.subspan(3 + length);
  }
}

void read_everything(const RingMapping& mapping) {
  const RingReader reader(mapping);
  std::vector<std::byte> payload(mapping.geometry().payload_bytes);
  SampleInfo info;
  static_cast<void>(reader.read_newest(payload, info));
  const Tid newest = reader.newest(), oldest = reader.oldest();
  for (const Tid tid : {newest, oldest, Tid{-1}, Tid{0}, Tid{7}, Tid{INT64_MAX}, Tid{INT64_MIN}}) {
    static_cast<void>(reader.read(tid, payload, info));
    static_cast<void>(reader.stamp(tid, info));
    RingReader::Place place{};
    if (reader.locate(tid, place, info) == ReadStatus::ok) {
      std::memcpy(payload.data(), place.payload, payload.size());
      static_cast<void>(RingReader::still_valid(*place.sequence, place.expected));
    }
  }
  for (const std::int64_t time : {INT64_MIN, INT64_C(-1), INT64_C(0), INT64_C(5), INT64_C(27),
                                  INT64_C(44), INT64_C(60), INT64_C(1000), INT64_MAX}) {
    Tid tid = 0;
    static_cast<void>(reader.find(time_from_ns(time), tid));
  }
}

void run(std::span<const std::uint8_t> input) {
  const Result<Geometry> geometry = Geometry::of(kPayloadBytes, kDepth);
  const Result<UniqueFd> ring =
      create_ring({{"fuzz", 0, "pc1"}, 1, std::chrono::milliseconds(10), 8}, *geometry);
  if (!ring) std::abort();
  fill(*ring);
  scribble(*ring, *geometry, input);
  if (const auto mapping = RingMapping::open_untrusted(ring->get(), Access::read_only)) {
    read_everything(**mapping);
  }
}

}  // namespace
}  // namespace dssm::ring

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::ring::run(input); }
