// SPDX-License-Identifier: Apache-2.0
//
// Transport: moves the bytes of one connection: over TCP (tcp.hpp), encrypted (tls.hpp), in tests
// between buffers.
// Frames, limits and greeting are above it (FrameConnection in dssmd, NetworkConnection in libdssm)
// and use nothing of the socket but fd().
#pragma once

#include <poll.h>
#include <sys/uio.h>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <span>

namespace dssm::wire {

// The outcome of sending or receiving without waiting.
enum class IoStatus : unsigned char {
  ok,
  would_block,
  interrupted,  // a signal handler ran; only from functions that wait
  end,          // the other side closed the connection, or its process died
};

struct IoResult {
  IoStatus status = IoStatus::ok;
  std::size_t bytes = 0;
};

struct CertifiedPeer;  // tls_credentials.hpp

// Which end of the connection a transport is.
enum class TransportEnd : unsigned char { connected, accepted };

// How packets are treated where several wait: by this PC's queues (SO_PRIORITY), by Wi-Fi, and by
// switches that look at it (DSCP, RFC 4594; RFC 8325 says how Wi-Fi maps it).
enum class Priority : unsigned char {
  high,    // CS4: video on Wi-Fi
  normal,  // best effort
  low,     // CS1: background
};

// What became of the bytes that were sent.
struct Progress {
  std::uint32_t delivered_packets = 0;  // since the connection began; may begin anew at 0
  std::uint32_t packet_bytes = 0;
  std::uint64_t waiting_bytes = 0;  // not sent, or not acknowledged
  std::uint64_t unsent_bytes = 0;   // of these, those that were not sent
  // Lately, while there was enough to send; 0: not known.
  std::uint64_t carried_bytes_per_s = 0;
  Duration round_trip{}, round_trip_now{};  // the least of late; smoothed
  // Since the connection began:
  Duration sending{};           // so long some were on their way or waited to be sent
  Duration waiting_for_peer{};  // and so long of that the receiver took no more
};

// A resource with one owner; one thread at a time. Its functions never wait, except for
// receive_waiting(); callers that want to wait poll fd().
class Transport {
 public:
  Transport() = default;
  Transport(const Transport&) = delete;
  Transport& operator=(const Transport&) = delete;
  virtual ~Transport() = default;

  // Sends as much of `parts` (at most 16), in order, as is possible without waiting.
  //   returns  ok with the number of bytes (0 < bytes) | would_block | end (the peer closed)
  virtual Result<IoResult> send(std::span<const iovec> parts) = 0;

  // Receives into `spaces`, in order.
  //   returns  ok with the number of bytes (0 < bytes) | would_block | end
  virtual Result<IoResult> receive(std::span<const iovec> spaces) = 0;

  // The same, but waits for bytes: up to kReceiveWait, or until a signal handler runs. For programs
  // that have nothing else to do until an answer arrives: one system call instead of two.
  //   returns  ok | would_block (nothing arrived) | interrupted | end
  virtual Result<IoResult> receive_waiting(std::span<const iovec> spaces) {
    pollfd ready{fd(), POLLIN, 0};
    ::poll(&ready, 1, static_cast<int>(kReceiveWait.count()));
    return receive(spaces);
  }
  static constexpr std::chrono::milliseconds kReceiveWait{10};

  // Whether receive() has more at once, whatever fd() says: what was received and decrypted may
  // not have fit into the spaces. Check it before waiting for fd().
  virtual bool has_buffered_input() const noexcept { return false; }
  // Whether bytes that send() took wait here for fd() to become writable; then call flush().
  virtual bool has_unsent_output() const noexcept { return false; }
  //   returns  ok (nothing waits here) | would_block | end
  virtual Result<IoStatus> flush() { return IoStatus::ok; }

  // Who the other side is, by its certificate. nullptr: the connection is not encrypted, and nobody
  // knows. Valid as long as the transport.
  virtual const CertifiedPeer* peer() const noexcept { return nullptr; }

  // From now on the kernel stamps the bytes that arrive, if it can, and arrived() returns that.
  virtual void stamp_arrivals() noexcept {}
  // When the last bytes of the last receive() arrived, by this PC's wall clock, however late
  // receive() is called. nullopt: not known.
  virtual std::optional<Time> arrived() const noexcept { return std::nullopt; }

  // From now on send() takes no more while so many bytes wait that are not on the network yet, if
  // the kernel can do that: what it has taken cannot be replaced by something newer. 0: the
  // system's usual limit.
  virtual void limit_unsent(std::size_t /*bytes*/) noexcept {}
  // Of all that send() takes from now on, if the kernel can do that.
  virtual void set_priority(Priority /*priority*/) noexcept {}
  // nullopt: not known.
  virtual std::optional<Progress> progress() const noexcept { return std::nullopt; }

  // Readable or writable when receive() or send() can continue.
  virtual int fd() const noexcept = 0;
};

}  // namespace dssm::wire
