// SPDX-License-Identifier: Apache-2.0
//
// What the tests of recordings share: a folder, random samples, and all that a recording holds.
#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "client/recording/records.hpp"

namespace dssm::test {

using Bytes = std::vector<std::byte>;

// With a folder of its own.
class RecordingTest : public testing::Test {
 protected:
  RecordingTest() {
    std::string name = testing::TempDir() + "dssm-recording-XXXXXX";
    EXPECT_NE(::mkdtemp(name.data()), nullptr);
    folder_ = name;
  }
  ~RecordingTest() override { std::filesystem::remove_all(folder_); }

  std::filesystem::path path(const std::string& name) const { return folder_ / name; }
  std::filesystem::path folder_;
};

// A sample as it is written and read.
struct Recorded {
  SampleInfo info;
  Duration clock_error = kUnknownClockError;
  Bytes payload;
  std::size_t stream = 0;

  friend bool operator==(const Recorded& a, const Recorded& b) {
    return a.info.tid == b.info.tid && a.info.time == b.info.time &&
           a.info.clock_error == b.info.clock_error &&
           a.info.payload_bytes == b.info.payload_bytes && a.clock_error == b.clock_error &&
           a.payload == b.payload && a.stream == b.stream;
  }
};

inline RecordedStream plain_stream(const std::string& name, std::uint64_t payload_bytes,
                                   std::uint64_t incarnation = 1) {
  RecordedStream stream;
  stream.id = {name, 0, "pc1"};
  stream.type.payload_bytes = payload_bytes;
  stream.depth = 16;
  stream.cycle = std::chrono::milliseconds(10);
  stream.incarnation = incarnation;
  return stream;
}

// A payload that differs from sample to sample, and compresses as sensor data does.
inline Bytes payload_of(Tid tid, std::size_t bytes) {
  Bytes payload(bytes);
  for (std::size_t i = 0; i < bytes; ++i) {
    payload[i] = static_cast<std::byte>(i < 8 ? tid >> (8 * i) : i * 7 % 13);
  }
  return payload;
}

inline Recorded sample_at(Tid tid, std::int64_t time_ns, std::size_t bytes = 24) {
  Recorded sample;
  sample.info = {tid, time_from_ns(time_ns), Duration(100 + tid % 7), bytes};
  sample.clock_error = Duration(200 + tid % 3);
  sample.payload = payload_of(tid, bytes);
  return sample;
}

inline void write(RecordingWriter& writer, std::uint32_t stream, const Recorded& sample) {
  const Result<void> written =
      writer.write(stream, sample.info, sample.clock_error, sample.payload);
  ASSERT_TRUE(written) << written.error().message;
}

// All samples, in the order of recording.
inline std::vector<Recorded> all_of(const Recording& recording) {
  std::vector<Recorded> samples;
  RecordingCursor cursor = recording.cursor();
  RecordedSample sample;
  while (cursor.next(sample)) {
    samples.push_back({sample.info, sample.clock_error,
                       Bytes(sample.payload.begin(), sample.payload.end()), sample.stream});
  }
  return samples;
}

inline Recording open_recording(const std::filesystem::path& path) {
  Result<Recording> recording = Recording::open(path);
  if (!recording) ADD_FAILURE() << recording.error().message;
  return std::move(recording).value();
}

inline std::string content_of(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

inline void write_file(const std::filesystem::path& path, std::string_view content) {
  std::filesystem::remove(path);  // ext4 flushes a file that is truncated and written again
  std::ofstream(path, std::ios::binary)
      .write(content.data(), static_cast<std::streamsize>(content.size()));
}

struct FoundRecord {
  recording::Op op;
  std::size_t start, end;
};

// All records of an MCAP file.
inline std::vector<FoundRecord> records_of(std::string_view file) {
  std::vector<FoundRecord> records;
  for (std::size_t at = recording::kMagic.size(); at + recording::kRecordHeadBytes < file.size();) {
    std::uint64_t length = 0;
    std::memcpy(&length, file.data() + at + 1, sizeof length);
    const std::size_t end = at + recording::kRecordHeadBytes + length;
    records.push_back({static_cast<recording::Op>(file[at]), at, end});
    at = end;
  }
  return records;
}

inline bool begins_with(const std::vector<Recorded>& all, const std::vector<Recorded>& first) {
  return first.size() <= all.size() && std::equal(first.begin(), first.end(), all.begin());
}

}  // namespace dssm::test
