// SPDX-License-Identifier: Apache-2.0
//
// Recording samples and reading them again, in payload MB/s: until the file is finished and synced,
// and from the page cache to the program. The raw limit beside it is write() and fsync(), and
// read(), of the same payloads in pieces of 1 MiB.
//
// Small payloads are slowly changing doubles, large ones a gradient with noise, which hardly
// compresses. The files are in $TMPDIR.
#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <dssm/recording.hpp>
#include <random>

#include "tests/bench/harness.hpp"

using namespace dssm;
using namespace dssm::bench;

namespace {

constexpr int kRounds = 7;
constexpr std::size_t kPieceBytes = 1U << 20;

std::vector<std::byte> payloads_of(std::size_t payload_bytes, std::size_t total_bytes) {
  std::vector<std::byte> all(total_bytes);
  if (payload_bytes <= 1024) {
    for (std::size_t i = 0; i < total_bytes / sizeof(double); ++i) {
      const double value = 1000.0 + static_cast<double>(i / 8) * 0.001 + static_cast<double>(i % 8);
      std::memcpy(all.data() + i * sizeof value, &value, sizeof value);
    }
  } else {
    std::mt19937 random(20);
    for (std::size_t i = 0; i < total_bytes; ++i) {
      all[i] = static_cast<std::byte>(i / 4096 + random() % 64);
    }
  }
  return all;
}

double rate(std::size_t bytes, std::int64_t began_ns) {
  return static_cast<double>(bytes) * 1000 / static_cast<double>(now_ns() - began_ns);
}

double raw_write(const std::filesystem::path& file, const std::vector<std::byte>& payloads) {
  std::filesystem::remove(file);
  const std::int64_t began = now_ns();
  const int fd = ::open(file.c_str(), O_CREAT | O_WRONLY | O_CLOEXEC, 0600);
  for (std::size_t at = 0; at < payloads.size(); at += kPieceBytes) {
    if (::write(fd, payloads.data() + at, std::min(kPieceBytes, payloads.size() - at)) < 0) {
      std::abort();
    }
  }
  if (::fsync(fd) != 0) std::abort();
  const double result = rate(payloads.size(), began);
  ::close(fd);
  return result;
}

double raw_read(const std::filesystem::path& file, std::size_t bytes) {
  std::vector<std::byte> piece(kPieceBytes);
  const std::int64_t began = now_ns();
  const int fd = ::open(file.c_str(), O_RDONLY | O_CLOEXEC);
  while (::read(fd, piece.data(), piece.size()) > 0) keep(piece);
  ::close(fd);
  return rate(bytes, began);
}

double our_write(const std::filesystem::path& file, const std::vector<std::byte>& payloads,
                 std::size_t payload_bytes, Compression compression) {
  std::filesystem::remove(file);
  RecordingOptions options;
  options.compression = compression;
  const std::int64_t began = now_ns();
  RecordingWriter writer = RecordingWriter::create(file, options).value();
  RecordedStream stream;
  stream.id = {"bench", 0, "pc1"};
  stream.type.payload_bytes = payload_bytes;
  const std::uint32_t number = writer.add_stream(stream).value();
  Tid tid = 0;
  for (std::size_t at = 0; at + payload_bytes <= payloads.size(); at += payload_bytes, ++tid) {
    writer
        .write(number, {tid, time_from_ns(tid * 1000), Duration(50000), payload_bytes}, Duration(0),
               std::span(payloads).subspan(at, payload_bytes))
        .value();
  }
  writer.finish().value();
  return rate(payloads.size(), began);
}

double our_read(const std::filesystem::path& file, std::size_t bytes) {
  const std::int64_t began = now_ns();
  const Recording recording = Recording::open(file).value();
  RecordingCursor cursor = recording.cursor();
  RecordedSample sample;
  std::uint64_t read = 0;
  while (cursor.next(sample)) read += sample.payload.size();
  if (read != bytes) std::abort();
  return rate(bytes, began);
}

void print(const std::string& name, std::vector<double> raw, std::vector<double> ours,
           const std::string& target) {
  const Figures limit = figures_of(std::move(raw)), figures = figures_of(std::move(ours));
  char rest[80];
  std::snprintf(rest, sizeof rest, "%7.2f  %s", figures.median / limit.median, target.c_str());
  print_row("  raw [MB/s], " + name, limit);
  print_row(name + " [MB/s]", figures, rest);
}

}  // namespace

int main() {
  const char* folder = std::getenv("TMPDIR");
  std::string name = std::string(folder != nullptr ? folder : "/tmp") + "/bench-recording-XXXXXX";
  if (::mkdtemp(name.data()) == nullptr) return 1;
  const std::filesystem::path raw = name + "/raw", ours = name + "/ours.mcap";
  print_head();
  for (const std::size_t payload_bytes : {std::size_t{64}, kPieceBytes}) {
    const std::vector<std::byte> payloads = payloads_of(payload_bytes, 64U << 20);
    for (const Compression compression : {Compression::none, Compression::lz4, Compression::zstd}) {
      constexpr const char* kNames[] = {"none", "lz4", "zstd"};
      std::vector<double> raw_writes, our_writes, raw_reads, our_reads;
      for (int i = 0; i < kRounds; ++i) {
        raw_writes.push_back(raw_write(raw, payloads));
        our_writes.push_back(our_write(ours, payloads, payload_bytes, compression));
        raw_reads.push_back(raw_read(raw, payloads.size()));
        our_reads.push_back(our_read(ours, payloads.size()));
      }
      const std::string what = std::string(kNames[static_cast<int>(compression)]) + ", " +
                               std::to_string(payload_bytes) + " bytes";
      const bool has_target = payload_bytes == 64 && compression == Compression::none;
      print("write, " + what, raw_writes, our_writes, has_target ? ">= 500 MB/s" : "");
      print("read, " + what, raw_reads, our_reads, "");
    }
  }
  std::filesystem::remove_all(name);
  return 0;
}
