// SPDX-License-Identifier: Apache-2.0
//
// A sink that writes down all that a decoder hands out, so that two ways of decoding can be
// compared, and the feeding of a decoder as a socket would do it.
#pragma once

#include <algorithm>
#include <cstring>
#include <functional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/wire/frame_decoder.hpp"

namespace dssm::wire {

class Recorder : public FrameDelegate {
 public:
  virtual ~Recorder() = default;

  // An entry per sample, "sample SERIAL/TID/TIME/CLOCK_ERROR [torn] PAYLOAD", or frame, "frame
  // BYTES".
  std::vector<std::string> log;
  bool drops_payloads = false;                         // gives no place for payloads
  std::function<void(const net::Frame&)> then;         // called in on_frame()
  std::function<bool()> holds = [] { return false; };  // asked in each callback
  FrameDecoder* decoder = nullptr;                     // for holds
  int begun = 0;                                       // calls of on_sample_begin()
  int collected = 0;  // samples whose whole frame was collected first, as `decoder` has it

  Result<void> on_sample_begin(const IncomingSample& sample, std::byte*& out) override {
    ++begun;
    if (holds()) {
      decoder->hold();
      return {};
    }
    payload_.assign(sample.info.payload_bytes, '?');
    out = drops_payloads ? nullptr : reinterpret_cast<std::byte*>(payload_.data());
    return {};
  }

  Result<void> on_sample_end(const IncomingSample& sample, bool torn) override {
    if (decoder && decoder->collected_bytes() > 0) ++collected;
    log.push_back("sample " + std::to_string(sample.serial) + "/" +
                  std::to_string(sample.info.tid) + "/" + std::to_string(to_ns(sample.info.time)) +
                  "/" + std::to_string(to_ns(sample.info.clock_error)) + (torn ? " torn " : " ") +
                  payload_);
    if (holds()) decoder->hold();
    return {};
  }

  Result<void> on_frame(net::Frame& frame) override {
    log.push_back("frame " + frame.SerializeAsString());
    if (then) then(frame);
    if (holds()) decoder->hold();
    return {};
  }

 private:
  std::string payload_;
};

// As a socket that has `bytes` and no more: fills the decoder's spaces, calls commit(); with
// `at_most` bytes each time. Goes on with commits of 0 bytes while the sink holds back. Ends with
// the first error.
inline Result<void> feed(
    FrameDecoder& decoder, std::string_view bytes, std::size_t at_most = SIZE_MAX,
    const std::function<bool()>& held = [] { return false; }) {
  while (!bytes.empty()) {
    std::size_t received = 0;
    std::size_t room = 0;
    for (const iovec& space : decoder.spaces()) {
      room += space.iov_len;
      const std::size_t part = std::min({space.iov_len, bytes.size(), at_most - received});
      std::memcpy(space.iov_base, bytes.data(), part);
      bytes.remove_prefix(part);
      received += part;
    }
    if (room < 4096) return Error{Errc::system, "spaces() gave less than 4 KiB"};
    if (Result<void> done = decoder.commit(received); !done) return done;
    while (held()) {
      if (Result<void> done = decoder.commit(0); !done) return done;
    }
  }
  return {};
}

}  // namespace dssm::wire
