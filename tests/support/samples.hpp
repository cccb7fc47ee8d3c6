// SPDX-License-Identifier: Apache-2.0
//
// Samples that readers can check, and threads that write and read them. (Programs that stand alone
// have their own.)
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <dssm/dssm.hpp>
#include <span>
#include <thread>

#include "tests/support/await.hpp"

namespace dssm::test {

struct Numbered {
  std::int64_t number = -1;
  std::int64_t again[15] = {};  // the same number, to detect tearing
};
DSSM_DESCRIBE(Numbered, number, again)

inline Numbered numbered(std::int64_t number) {
  Numbered sample;
  sample.number = number;
  std::ranges::fill(sample.again, number);
  return sample;
}

inline bool is_whole(const Numbered& sample) {
  return std::ranges::all_of(sample.again,
                             [&](std::int64_t word) { return word == sample.number; });
}

template <class T>
std::span<std::byte> writable_bytes(T& value) {
  return std::as_writable_bytes(std::span(&value, 1));
}
template <class T>
std::span<const std::byte> bytes_of(const T& value) {
  return std::as_bytes(std::span(&value, 1));
}

// Writes samples 0, 1, 2 ... until it is destroyed.
class WriterThread {
 public:
  explicit WriterThread(Writer<Numbered>& writer, Duration pause = std::chrono::microseconds(200))
      : writer_(writer), thread_([this, pause] {
          while (!done_) {
            EXPECT_EQ(writer_.write(numbered(written_.load())), written_.load());
            ++written_;
            std::this_thread::sleep_for(pause);  // the load's rate, not a wait for anything
          }
        }) {}
  WriterThread(const WriterThread&) = delete;
  WriterThread& operator=(const WriterThread&) = delete;
  ~WriterThread() { stop(); }

  std::int64_t written() const { return written_.load(); }
  void await_more(std::int64_t samples) const {
    await([&, wanted = written() + samples] { return written() >= wanted; });
  }
  // Returns how many samples it wrote.
  std::int64_t stop() {
    done_ = true;
    if (thread_.joinable()) thread_.join();
    return written();
  }

 private:
  Writer<Numbered>& writer_;
  std::atomic<bool> done_ = false;
  std::atomic<std::int64_t> written_ = 0;
  std::thread thread_;
};

// Reads every sample from the first one on, and checks each.
class ReaderThread {
 public:
  explicit ReaderThread(Reader<Numbered>& reader) : reader_(reader), thread_([this] { read(); }) {}
  ReaderThread(const ReaderThread&) = delete;
  ReaderThread& operator=(const ReaderThread&) = delete;
  ~ReaderThread() {
    done_ = true;
    if (thread_.joinable()) thread_.join();
  }

  std::int64_t taken() const { return taken_.load(); }
  // Returns early when a sample was wrong.
  void await_taken(std::int64_t count) const {
    await([&] { return taken() >= count || wrong_; });
  }

 private:
  void read() {
    reader_.seek(kNoTid);
    Numbered sample;
    SampleInfo info;
    while (!done_ && !wrong_) {
      if (reader_.wait(deadline_in(std::chrono::milliseconds(50))) != WaitStatus::ready) continue;
      const ReadStatus status = reader_.read_next(sample, info);
      if (status == ReadStatus::not_yet) continue;
      check(status, sample, info);
      ++taken_;
    }
  }

  // Only the first wrong sample is reported: all after it are wrong as well.
  void check(ReadStatus status, const Numbered& sample, const SampleInfo& info) {
    const std::int64_t next = taken_.load();
    wrong_ =
        status != ReadStatus::ok || info.tid != next || sample.number != next || !is_whole(sample);
    EXPECT_EQ(status, ReadStatus::ok);
    EXPECT_EQ(info.tid, next);
    EXPECT_EQ(sample.number, next);
    EXPECT_TRUE(is_whole(sample));
  }

  Reader<Numbered>& reader_;
  std::atomic<bool> done_ = false, wrong_ = false;
  std::atomic<std::int64_t> taken_ = 0;
  std::thread thread_;
};

}  // namespace dssm::test
