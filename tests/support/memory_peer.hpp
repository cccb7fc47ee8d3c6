// SPDX-License-Identifier: Apache-2.0
//
// A peer of dssmd without a network: it keeps what dssmd sends, as much as the test allows, and
// dssmd receives what the test puts in. The transport's descriptor is always writable, and readable
// while there is input, so a real event loop can drive a connection over it, turn by turn.
#pragma once

#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <deque>
#include <functional>
#include <limits>
#include <memory>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/transport.hpp"
#include "tests/support/frames.hpp"

namespace dssm::test {

class MemoryPeer {
 public:
  static constexpr std::size_t kAll = std::numeric_limits<std::size_t>::max();

  MemoryPeer() = default;
  MemoryPeer(const MemoryPeer&) = delete;
  MemoryPeer& operator=(const MemoryPeer&) = delete;
  ~MemoryPeer() { *alive_ = false; }

  void put(Bytes bytes) {
    if (bytes.empty()) return;
    input_.push_back(std::move(bytes));
    if (!hides_input) signal();
  }
  void put(const net::Frame& frame) { put(to_bytes(frame)); }
  // Input that dssmd has not received yet.
  bool has_input() const { return !input_.empty(); }
  void drop_input() {
    input_.clear();
    received_ = 0;
  }

  // The peer ends the connection: what was put in is still received.
  void end() {
    ended_ = true;
    signal();
  }
  // The same, but dssmd is notified only when it sends.
  void end_silently() { ended_ = true; }

  // What was sent since this was called last.
  std::vector<net::Frame> take() { return frames_of(std::exchange(sent, {})); }

  Bytes sent;                            // by dssmd
  std::size_t room = kAll;               // how many bytes it may still send before it must wait
  std::size_t max_send_bytes = kAll;     // of one send
  std::size_t max_receive_bytes = kAll;  // of one receive
  std::function<void()> after_send;
  std::optional<Time> arrived;  // what dssmd gets as the time of its input, once it asks for it
  std::size_t sends = 0;        // that took bytes
  std::optional<wire::Progress> progress;
  std::optional<wire::Priority> priority;  // that dssmd set
  std::size_t unsent_limit = 0;            // that dssmd set
  bool hides_input = false;  // as a transport does that decrypts: fd() does not show it
  bool closed = false;       // by dssmd

 private:
  friend class MemoryTransport;

  void signal() const {
    const std::uint64_t one = 1;
    EXPECT_EQ(::write(readable_.get(), &one, sizeof one), 8);
  }

  std::deque<Bytes> input_;
  std::size_t received_ = 0;  // of the first of them
  bool ended_ = false;
  UniqueFd readable_{::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)};
  std::shared_ptr<bool> alive_ = std::make_shared<bool>(true);
};

// The transport to a peer, which may be destroyed before it.
class MemoryTransport final : public wire::Transport {
 public:
  explicit MemoryTransport(MemoryPeer& peer)
      : peer_(peer), alive_(peer.alive_), fd_(::dup(peer.readable_.get())) {}
  ~MemoryTransport() override {
    if (*alive_) peer_.closed = true;
  }

  Result<wire::IoResult> send(std::span<const iovec> parts) override {
    if (!*alive_ || peer_.ended_) return wire::IoResult{wire::IoStatus::end, 0};
    std::size_t left = std::min(peer_.room, peer_.max_send_bytes), sent = 0;
    for (const iovec& part : parts) {
      const std::size_t step = std::min(left, part.iov_len);
      const auto* bytes = static_cast<const std::byte*>(part.iov_base);
      peer_.sent.insert(peer_.sent.end(), bytes, bytes + step);
      left -= step;
      sent += step;
    }
    if (sent == 0) return wire::IoResult{wire::IoStatus::would_block, 0};
    if (peer_.room != MemoryPeer::kAll) peer_.room -= sent;
    ++peer_.sends;
    if (peer_.after_send) peer_.after_send();
    return wire::IoResult{wire::IoStatus::ok, sent};
  }

  Result<wire::IoResult> receive(std::span<const iovec> spaces) override {
    if (!*alive_) return wire::IoResult{wire::IoStatus::end, 0};
    if (peer_.input_.empty()) {
      if (peer_.ended_) return wire::IoResult{wire::IoStatus::end, 0};
      std::uint64_t count = 0;
      [[maybe_unused]] const ssize_t read = ::read(fd_.get(), &count, sizeof count);
      return wire::IoResult{wire::IoStatus::would_block, 0};
    }
    const auto next = std::span(peer_.input_.front()).subspan(peer_.received_);
    const std::size_t all = std::min(next.size(), peer_.max_receive_bytes);
    std::size_t taken = 0;
    for (const iovec& space : spaces) {
      const std::size_t step = std::min(all - taken, space.iov_len);
      std::memcpy(space.iov_base, next.data() + taken, step);
      taken += step;
    }
    peer_.received_ += taken;
    if (taken == next.size()) {
      peer_.input_.pop_front();
      peer_.received_ = 0;
    }
    return wire::IoResult{wire::IoStatus::ok, taken};
  }

  bool has_buffered_input() const noexcept override {
    return *alive_ && peer_.hides_input && !peer_.input_.empty();
  }
  void stamp_arrivals() noexcept override { stamps_ = true; }
  std::optional<Time> arrived() const noexcept override {
    return stamps_ ? peer_.arrived : std::nullopt;
  }
  void limit_unsent(std::size_t bytes) noexcept override { peer_.unsent_limit = bytes; }
  void set_priority(wire::Priority priority) noexcept override { peer_.priority = priority; }
  std::optional<wire::Progress> progress() const noexcept override { return peer_.progress; }

  int fd() const noexcept override { return fd_.get(); }

 private:
  bool stamps_ = false;
  MemoryPeer& peer_;
  std::shared_ptr<bool> alive_;
  UniqueFd fd_;
};

}  // namespace dssm::test
