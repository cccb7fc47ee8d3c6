// SPDX-License-Identifier: Apache-2.0
//
// What is behind the handles of the public API.
#pragma once

#include <dssm/reader.hpp>
#include <dssm/writer.hpp>

#include "client/src/client.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"

namespace dssm::detail {

struct ReaderState {
  explicit ReaderState(std::shared_ptr<OpenStream> opened)
      : stream(std::move(opened)), ring(*stream->ring->mapping) {}

  // From now on next() goes on behind `tid`.
  void took(Tid tid) noexcept {
    cursor = tid;
    fresh = false;
  }

  std::shared_ptr<OpenStream> stream;
  ring::RingReader ring;
  Tid cursor = kNoTid;
  bool fresh = true;  // next() has not been told where to start
  std::uint64_t lost = 0;
  std::shared_ptr<ReadyFd> ready;
};

struct WriterState {
  explicit WriterState(std::shared_ptr<OpenStream> opened)
      : stream(std::move(opened)),
        ring(*stream->ring->mapping, *stream->ring->bell, stream->ring->doorbell_fd.get()),
        payload_bytes(stream->ring->mapping->geometry().payload_bytes) {}

  std::shared_ptr<OpenStream> stream;
  ring::RingWriter ring;
  std::uint64_t payload_bytes;
};

struct PlaybackClockState {
  std::shared_ptr<clock::PlaybackRecord> record;
};

Result<std::vector<std::byte>> get_property(Client& client, const StreamId& id);
Result<void> set_property(Client& client, const StreamId& id, std::span<const std::byte> property);

}  // namespace dssm::detail
