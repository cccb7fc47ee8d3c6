// SPDX-License-Identifier: Apache-2.0
//
// Files that are opened as recordings, read and repaired. The input is the file. Reading it may
// fail, but must not crash or hang, and repairing it must not change what is read.
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <dssm/recording.hpp>
#include <string>
#include <vector>

#include "tests/fuzz/fuzzer.hpp"

namespace dssm {
namespace {

// A chunk may become so long as it says, up to the largest sample and a margin.
constexpr std::uint64_t kMaxChunkBytes = 72U << 20;
// So many bytes may take what LZ4's decoder takes, whatever is compressed: two blocks of 4 MiB.
constexpr std::uint64_t kDecoderBytes = 512U << 10;

void count_chunks(std::span<const std::uint8_t> input) {
  constexpr std::size_t kHeadBytes = 9;
  for (std::size_t at = 8; at + kHeadBytes + 24 <= input.size();) {
    std::uint64_t length = 0, chunk_bytes = 0;
    std::memcpy(&length, input.data() + at + 1, sizeof length);
    std::memcpy(&chunk_bytes, input.data() + at + kHeadBytes + 16, sizeof chunk_bytes);
    if (length > input.size() - at - kHeadBytes) return;
    const bool is_possible = chunk_bytes <= kMaxChunkBytes && chunk_bytes / 32768 <= length;
    if (input[at] == 6 && is_possible) fuzz::count_bytes(chunk_bytes);
    at += kHeadBytes + length;
  }
}

struct Seen {
  Tid tid;
  Time time;
  std::size_t stream;
  std::vector<std::byte> payload;
  bool operator==(const Seen&) const = default;
};

std::vector<Seen> read_everything(const Recording& recording) {
  std::vector<Seen> samples;
  RecordingCursor cursor = recording.cursor();
  RecordedSample sample;
  while (cursor.next(sample)) {
    samples.push_back({sample.info.tid,
                       sample.info.time,
                       sample.stream,
                       {sample.payload.begin(), sample.payload.end()}});
  }
  for (const RecordedStreamInfo& stream : recording.streams()) {
    Result<RecordedRawReader> reader = recording.open_raw_reader(stream.id);
    if (!reader) continue;
    std::vector<std::byte> payload(reader->payload_bytes()), other = payload;
    SampleInfo info;
    Neighbours around;
    while (reader->read_next(payload, info) == ReadStatus::ok) {
    }
    while (reader->read_previous(payload, info) == ReadStatus::ok) {
    }
    for (const std::int64_t t : {INT64_MIN, INT64_MAX, std::int64_t{0}, to_ns(stream.first_time)}) {
      static_cast<void>(reader->read_at(time_from_ns(t), payload, info));
      static_cast<void>(reader->read_at_or_after(time_from_ns(t), payload, info));
      static_cast<void>(reader->read_nearest(time_from_ns(t), payload, info));
      static_cast<void>(reader->read_neighbours(time_from_ns(t), payload, other, around));
      static_cast<void>(reader->read_tid(t, payload, info));
      static_cast<void>(reader->clock_error(info));
    }
  }
  return samples;
}

}  // namespace

void fuzz::run_input(std::span<const std::uint8_t> input) {
  count_chunks(input);
  fuzz::count_bytes(kDecoderBytes);
  const int fd = ::memfd_create("fuzz-recording", MFD_CLOEXEC);
  const auto size = static_cast<ssize_t>(input.size());
  if (fd < 0 || ::write(fd, input.data(), input.size()) != size) std::abort();
  const std::string path = "/proc/self/fd/" + std::to_string(fd);
  if (const Result<Recording> before = Recording::open(path)) {
    const std::vector<Seen> samples = read_everything(*before);
    if (repair_recording(path)) {
      const Result<Recording> after = Recording::open(path);
      if (!after || read_everything(*after) != samples) std::abort();
    }
  }
  ::close(fd);
}

}  // namespace dssm
