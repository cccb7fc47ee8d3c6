// SPDX-License-Identifier: Apache-2.0
//
// A connection without a network: what is sent is kept, as much as the test allows, and what is
// received the test puts in. Its descriptor is always writable, and readable while there is input,
// so a real event loop can drive a link over it, turn by turn.
#pragma once

#include <gtest/gtest.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <deque>
#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/frame_decoder.hpp"
#include "core/wire/transport.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// What a test and its transport share. The link owns the transport; both may go first.
struct FakePeerState {
  static constexpr std::size_t kAll = std::numeric_limits<std::size_t>::max();

  std::vector<std::byte> sent;      // by the link
  std::size_t room = kAll;          // how many bytes it may still send before the socket is full
  std::size_t most_at_once = kAll;  // of one send
  std::function<void()> after_send;
  std::size_t sends = 0;  // that took something
  std::deque<std::vector<std::byte>> input;
  bool closed = false;  // by the link
  bool gone = false;    // the peer is: what was put in is still received
  UniqueFd readable{::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)};

  void put(std::vector<std::byte> bytes) {
    input.push_back(std::move(bytes));
    signal();
  }
  void put(const net::Frame& frame) {
    const std::string text = wire::encode_frame(frame);
    const auto bytes = std::as_bytes(std::span(text));
    put(std::vector(bytes.begin(), bytes.end()));
  }
  void vanish() {
    gone = true;
    signal();
  }
  void signal() const {
    const std::uint64_t one = 1;
    ASSERT_EQ(::write(readable.get(), &one, sizeof one), 8);
  }
};

class FakePeer : public FakePeerState {
 public:
  FakePeer() = default;
  FakePeer(const FakePeer&) = delete;
  FakePeer& operator=(const FakePeer&) = delete;
  ~FakePeer() { *alive_ = false; }

 private:
  friend class FakeTransport;
  std::shared_ptr<bool> alive_ = std::make_shared<bool>(true);
};

class FakeTransport final : public wire::Transport {
 public:
  explicit FakeTransport(FakePeer& peer)
      : peer_(peer), alive_(peer.alive_), fd_(::dup(peer.readable.get())) {}
  ~FakeTransport() override {
    if (*alive_) peer_.closed = true;
  }

  Result<wire::IoResult> send(std::span<const iovec> parts) override {
    if (!*alive_ || peer_.gone) return wire::IoResult{wire::IoStatus::end, 0};
    std::size_t left = std::min(peer_.room, peer_.most_at_once), sent = 0;
    for (const iovec& part : parts) {
      const std::size_t step = std::min(left, part.iov_len);
      const auto* bytes = static_cast<const std::byte*>(part.iov_base);
      peer_.sent.insert(peer_.sent.end(), bytes, bytes + step);
      left -= step;
      sent += step;
    }
    if (sent == 0) return wire::IoResult{wire::IoStatus::would_block, 0};
    if (peer_.room != FakePeer::kAll) peer_.room -= sent;
    ++peer_.sends;
    if (peer_.after_send) peer_.after_send();
    return wire::IoResult{wire::IoStatus::ok, sent};
  }

  Result<wire::IoResult> receive(std::span<const iovec> spaces) override {
    if (!*alive_) return wire::IoResult{wire::IoStatus::end, 0};
    if (peer_.input.empty()) {
      if (peer_.gone) return wire::IoResult{wire::IoStatus::end, 0};
      std::uint64_t count = 0;
      [[maybe_unused]] const ssize_t read = ::read(peer_.readable.get(), &count, sizeof count);
      return wire::IoResult{wire::IoStatus::would_block, 0};
    }
    std::vector<std::byte>& next = peer_.input.front();
    std::size_t taken = 0;
    for (const iovec& space : spaces) {
      const std::size_t step = std::min(next.size() - taken, space.iov_len);
      std::memcpy(space.iov_base, next.data() + taken, step);
      taken += step;
    }
    next.erase(next.begin(), next.begin() + static_cast<std::ptrdiff_t>(taken));
    if (next.empty()) peer_.input.pop_front();
    return wire::IoResult{wire::IoStatus::ok, taken};
  }

  int fd() const noexcept override { return fd_.get(); }

 private:
  FakePeer& peer_;
  std::shared_ptr<bool> alive_;
  UniqueFd fd_;
};

// One frame as the peer sees it.
struct SentItem {
  net::Frame frame;  // with `sample`, without payload
  std::vector<std::byte> payload;
  bool torn = false;
};

// Cuts what was sent into frames; a rest that is no whole frame is a failure of the test.
inline std::vector<SentItem> decode(const std::vector<std::byte>& bytes,
                                    std::size_t payload_bytes = 0) {
  struct Sink final : wire::FrameDelegate {
    Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override {
      SentItem item;
      item.frame.set_serial(sample.serial);
      item.frame.mutable_sample()->set_tid(sample.info.tid);
      item.frame.mutable_sample()->set_time_ns(to_ns(sample.info.time));
      item.payload.resize(sample.payload_bytes);
      items.push_back(std::move(item));
      out = items.back().payload.data();
      return {};
    }
    Result<void> on_sample_end(const wire::IncomingSample&, bool torn) override {
      items.back().torn = torn;
      return {};
    }
    Result<void> on_frame(net::Frame& frame) override {
      items.push_back({frame, {}, false});
      return {};
    }
    std::deque<SentItem> items;  // whose elements stay where they are
  } sink;
  wire::FrameDecoder decoder(sink, 17U << 20);
  decoder.set_payload_bytes(payload_bytes);
  for (std::size_t at = 0; at < bytes.size();) {
    std::size_t step = 0;
    for (const iovec& space : decoder.spaces()) {
      const std::size_t part = std::min(space.iov_len, bytes.size() - at - step);
      std::memcpy(space.iov_base, bytes.data() + at + step, part);
      step += part;
    }
    const Result<void> taken = decoder.commit(step);
    EXPECT_TRUE(taken) << taken.error().message;
    if (!taken) break;
    at += step;
  }
  EXPECT_TRUE(decoder.at_frame_end()) << "a frame is cut off";
  return {sink.items.begin(), sink.items.end()};
}

// Runs what is due in the loop, `turns` times.
void run_turns(const EventLoop& loop, int turns = 1);

// Runs the loop until `done`; for what waits for a timer.
template <class Done>
bool run_until(const EventLoop& loop, Done done) {
  const MonoTime deadline = deadline_in(std::chrono::seconds(60));
  while (!done()) {
    if (MonoClock::now() > deadline) return false;
    run_turns(loop);
  }
  return true;
}

}  // namespace dssm::daemon
