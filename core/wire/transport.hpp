// SPDX-License-Identifier: Apache-2.0
//
// The seam between frames and what carries them: TCP today, TLS over TCP in a later round, a pair
// of buffers in tests.
#pragma once

#include <poll.h>
#include <sys/uio.h>

#include <chrono>
#include <dssm/result.hpp>
#include <span>

#include "core/wire/io_result.hpp"

namespace dssm::wire {

// One connection's bytes. A resource with one owner; one thread at a time. Never waits, but where
// it says so: whoever wants to wait polls fd().
class Transport {
 public:
  Transport() = default;
  Transport(const Transport&) = delete;
  Transport& operator=(const Transport&) = delete;
  virtual ~Transport() = default;

  // Sends as much of `parts` (at most 16), in order, as goes without waiting.
  //   returns  ok with the number of bytes (0 < bytes) | would_block | end (the peer is gone)
  virtual Result<IoResult> send(std::span<const iovec> parts) = 0;

  // Receives into `spaces`, in order.
  //   returns  ok with the number of bytes (0 < bytes) | would_block | end
  virtual Result<IoResult> receive(std::span<const iovec> spaces) = 0;

  // The same, waiting for bytes: for kReceiveWait, or until a signal handler runs. For programs
  // that have nothing else to do until an answer comes: one system call instead of two.
  //   returns  besides: would_block (nothing came) | interrupted
  virtual Result<IoResult> receive_waiting(std::span<const iovec> spaces) {
    pollfd ready{fd(), POLLIN, 0};
    ::poll(&ready, 1, static_cast<int>(kReceiveWait.count()));
    return receive(spaces);
  }
  static constexpr std::chrono::milliseconds kReceiveWait{10};

  // Readable or writable when receive() or send() may go on.
  virtual int fd() const noexcept = 0;
};

}  // namespace dssm::wire
