// SPDX-License-Identifier: Apache-2.0
//
// Two dssmd on this machine's loopback: pc1 owns the streams, pc2 reads and writes them. What is
// sent says which sample it is, and shows tearing.
#pragma once

#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <cstring>
#include <dssm/dssm.hpp>
#include <string>
#include <thread>
#include <utility>

#include "tests/process/fleet/fleet_tools.hpp"

namespace dssm::test {

using namespace std::chrono_literals;

struct Counted {
  std::int64_t number;
  std::int64_t again[15];
};
DSSM_DESCRIBE(Counted, number, again)

inline Counted counted(std::int64_t number) {
  Counted sample{number, {}};
  for (auto& word : sample.again) word = number;
  return sample;
}

inline bool is_whole(const Counted& sample) {
  for (const std::int64_t word : sample.again) {
    if (word != sample.number) return false;
  }
  return true;
}

class TwoHosts : public testing::Test {
 protected:
  explicit TwoHosts(const std::string& linger = "5 s", std::vector<std::string> of_pc1 = {})
      : linger_(linger), pc1(std::move(of_pc1), "pc1") {
    await_state(there, pc1, HostState::up);
  }

  // What pc2 says about its copy of `name`, a stream of pc1.
  MirrorInfo mirror(const std::string& name) {
    const auto info = there.stream_info({name, 0, "pc1"});
    return info && info->mirror ? *info->mirror : MirrorInfo{};
  }
  std::uint32_t channels(const std::string& name) {
    return here.stream_info({name, 0, ""}).value().channels;
  }

  const std::string linger_;
  DaemonProcess pc1;
  DaemonProcess pc2{{"--peer", pc1.address(), "--mirror-linger", linger_}, "pc2"};
  Session here = connect(pc1), there = connect(pc2);
};

// Writes samples 0, 1, 2 ... at about 5 kHz until it is destroyed.
class Writing {
 public:
  explicit Writing(Writer<Counted>& writer)
      : writer_(writer), thread_([this] {
          while (!done_) {
            EXPECT_EQ(writer_.write(counted(written_.load())), written_.load());
            ++written_;
            std::this_thread::sleep_for(200us);  // the load's rate, not a wait for anything
          }
        }) {}
  ~Writing() { stop(); }
  Writing(const Writing&) = delete;
  Writing& operator=(const Writing&) = delete;

  std::int64_t written() const { return written_.load(); }
  void more(std::int64_t samples) const {
    const std::int64_t before = written();
    await([&] { return written() >= before + samples; });
  }
  std::int64_t stop() {
    done_ = true;
    if (thread_.joinable()) thread_.join();
    return written();
  }

 private:
  Writer<Counted>& writer_;
  std::atomic<bool> done_ = false;
  std::atomic<std::int64_t> written_ = 0;
  std::thread thread_;
};

// Takes every sample from the first one on, in a thread of its own, and checks each.
class Reading {
 public:
  explicit Reading(Reader<Counted>& reader) : reader_(reader), thread_([this] { read(); }) {}
  ~Reading() {
    done_ = true;
    if (thread_.joinable()) thread_.join();
  }
  Reading(const Reading&) = delete;
  Reading& operator=(const Reading&) = delete;

  std::int64_t taken() const { return taken_.load(); }
  void await_taken(std::int64_t count) const {
    await([&] { return taken() >= count; });
  }

 private:
  void read() {
    reader_.seek(kNoTid);
    Counted sample{};
    SampleInfo info;
    while (!done_) {
      if (reader_.wait(deadline_in(50ms)) != WaitStatus::ready) continue;
      if (reader_.read_next(sample, info) != ReadStatus::ok) continue;
      if (!wrong_) check(sample, info);
      ++taken_;
    }
  }

  // The first sample that is not the one to come tells enough: all after it are others, too.
  void check(const Counted& sample, const SampleInfo& info) {
    const std::int64_t next = taken_.load();
    wrong_ = info.tid != next || sample.number != next || !is_whole(sample);
    EXPECT_EQ(info.tid, next);
    EXPECT_EQ(sample.number, next);
    EXPECT_TRUE(is_whole(sample));
  }

  Reader<Counted>& reader_;
  std::atomic<bool> done_ = false;
  std::atomic<std::int64_t> taken_ = 0;
  bool wrong_ = false;
  std::thread thread_;
};

}  // namespace dssm::test
