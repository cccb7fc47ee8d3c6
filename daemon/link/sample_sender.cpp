// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/sample_sender.hpp"

#include <algorithm>
#include <cstring>
#include <optional>
#include <utility>

#include "core/base/check.hpp"
#include "core/ring/copy.hpp"
#include "core/wire/varint.hpp"

namespace dssm::daemon {
namespace {

using ring::RingReader;

iovec part_of(const std::byte* bytes, std::size_t size) noexcept {
  return {const_cast<std::byte*>(bytes), size};  // the kernel only reads them
}

// The length of the frame at `begin`, which encode_sample_header() wrote.
std::size_t frame_bytes_at(const std::byte* begin, const std::byte* end) noexcept {
  const std::byte* at = begin;
  std::uint64_t bytes = 0;
  static_cast<void>(wire::read_varint(at, end, wire::kMaxLengthBytes, bytes));
  return static_cast<std::size_t>(at - begin) + bytes;
}

}  // namespace

SampleSender::SampleSender(const ring::RingMapping& mapping, FrameConnection& connection,
                           const Options& options)
    : reader_(mapping),
      connection_(connection),
      options_(options),
      payload_bytes_(mapping.geometry().payload_bytes) {}

[[gnu::hot]] SendStatus SampleSender::send(Tid tid, std::uint64_t serial, bool more_follow,
                                           const SliceLimits& limits) {
  DSSM_CHECK(!busy_);
  if (payload_bytes_ < kInPlaceBytes) return send_copy(tid, serial);
  SampleInfo info;
  if (reader_.locate(tid, place_, info) != ReadStatus::ok) return SendStatus::not_in_ring;
  const bool is_small = info.payload_bytes < kInPlaceBytes;
  const bool may_copy = info.payload_bytes <= kMaxCopiedBytes;
  const bool copy_pays = is_small || !more_follow || !options_.may_tear;
  return may_copy && copy_pays ? send_copy(tid, serial) : begin_in_place(info, serial, limits);
}

[[gnu::hot]] SendStatus SampleSender::send_copy(Tid tid, std::uint64_t serial) {
  std::byte staged[sizeof head_ + kMaxCopiedBytes];
  SampleInfo info;
  const std::span<std::byte> payload(staged + sizeof head_,
                                     std::min(payload_bytes_, kMaxCopiedBytes));
  if (reader_.read(tid, payload, info) != ReadStatus::ok) return SendStatus::not_in_ring;
  std::array<std::byte, wire::kMaxSampleHeaderBytes> header;
  const std::size_t header_bytes =
      wire::encode_sample_header(header, serial, info, wire::Trailer::none);
  // After the trailer of the sample before, if it is still here.
  const std::size_t kept_bytes = head_bytes_ - head_sent_;
  keep_head(std::span(header).first(header_bytes));
  const std::size_t bytes = kept_bytes + header_bytes + info.payload_bytes;
  std::byte* begin = payload.data() - header_bytes - kept_bytes;
  std::copy_n(head_.begin() + head_sent_, kept_bytes + header_bytes, begin);
  head_bytes_ -= header_bytes;
  const iovec part = part_of(begin, bytes);
  const std::size_t sent = connection_.send_now({&part, 1});
  if (sent <= kept_bytes) {
    head_sent_ += sent;
    connection_.want_output();
    return SendStatus::blocked;
  }
  head_bytes_ = head_sent_ = 0;
  // Charged with the connection: there is at most one such rest.
  if (sent < bytes) connection_.queue_rest(RawBytes::copy_of({begin + sent, bytes - sent}));
  counters_.copied_payload_bytes += info.payload_bytes;
  ++counters_.samples;
  return SendStatus::sent;
}

// --- small payloads, many at a time

[[gnu::hot]] SendStatus SampleSender::send_many(Tid first, Tid last, Tid& next) {
  next = first;
  std::byte staged[kBatchBytes];
  std::array<std::byte, wire::kMaxSampleHeaderBytes> header;
  // That of the longest samples. A shorter header is made for a shorter sample.
  SampleInfo longest;
  longest.payload_bytes = payload_bytes_;
  const std::size_t most_header_bytes =
      wire::encode_sample_header(header, 0, longest, wire::Trailer::none);
  const std::size_t most_bytes = most_header_bytes + payload_bytes_;
  std::size_t bytes = 0;
  for (; next <= last && bytes + most_bytes <= kBatchBytes; ++next) {
    SampleInfo info;
    const std::span<std::byte> payload(staged + bytes + most_header_bytes, payload_bytes_);
    if (reader_.read(next, payload, info) != ReadStatus::ok) break;
    const std::size_t header_bytes =
        wire::encode_sample_header(header, 0, info, wire::Trailer::none);
    std::copy_n(header.begin(), header_bytes, staged + bytes);
    bytes += header_bytes;
    if (header_bytes != most_header_bytes) {
      std::memmove(staged + bytes, payload.data(), info.payload_bytes);
    }
    bytes += info.payload_bytes;
    counters_.copied_payload_bytes += info.payload_bytes;
  }
  if (bytes == 0) return SendStatus::not_in_ring;
  const iovec part = part_of(staged, bytes);
  const std::size_t sent = connection_.send_now({&part, 1});
  if (sent == 0) {
    connection_.want_output();
    next = first;
    return SendStatus::blocked;
  }
  if (sent < bytes) {
    std::optional<MemoryShare> share;
    if (options_.budget) share = options_.budget->try_take(bytes - sent);
    if (options_.budget && !share) {
      // Only what completes the frame that is begun; the others are still in the ring.
      std::size_t complete_bytes = 0;
      for (next = first; complete_bytes < sent; ++next) {
        complete_bytes += frame_bytes_at(staged + complete_bytes, staged + bytes);
      }
      bytes = complete_bytes;
    }
    if (sent < bytes) {
      connection_.queue_rest(RawBytes::copy_of({staged + sent, bytes - sent}),
                             share ? *std::move(share) : MemoryShare());
    }
  }
  counters_.samples += static_cast<std::uint64_t>(next - first);
  return SendStatus::sent;
}

// --- large payloads

void SampleSender::keep_head(std::span<const std::byte> bytes) noexcept {
  std::copy(bytes.begin(), bytes.end(), head_.begin() + head_bytes_);
  head_bytes_ += bytes.size();
}

SendStatus SampleSender::begin_in_place(const SampleInfo& info, std::uint64_t serial,
                                        const SliceLimits& limits) {
  std::array<std::byte, wire::kMaxSampleHeaderBytes> header;
  const std::size_t header_bytes = wire::encode_sample_header(
      header, serial, info, options_.may_tear ? wire::Trailer::torn : wire::Trailer::none);
  const std::size_t kept_bytes = head_bytes_;
  keep_head(std::span(header).first(header_bytes));
  bytes_ = info.payload_bytes;
  offset_ = 0;
  busy_ = true;
  if (!options_.may_tear) {
    if (!begin_copying()) {
      busy_ = false;
      head_bytes_ = kept_bytes;
      return SendStatus::no_memory;
    }
    return copy_slice();
  }
  connection_.set_mid_frame(true);
  const SendStatus status = send_slice(limits);
  if (busy_ && head_sent_ <= kept_bytes && !copying_) {
    // No byte of this sample was sent: it is not begun.
    busy_ = false;
    head_bytes_ = kept_bytes;
    connection_.set_mid_frame(false);
    return SendStatus::blocked;
  }
  return status;
}

SendStatus SampleSender::go_on(const SliceLimits& limits) {
  DSSM_CHECK(busy_);
  return copying_ ? copy_slice() : send_slice(limits);
}

SendStatus SampleSender::send_slice(const SliceLimits& limits) {
  const std::size_t slice = std::min({bytes_ - offset_, limits.most_bytes, kSliceBytes});
  const std::size_t head = head_bytes_ - head_sent_;
  const iovec parts[] = {part_of(head_.data() + head_sent_, head),
                         part_of(place_.payload + offset_, slice)};
  const std::size_t sent = connection_.send_now(parts);
  head_sent_ += std::min(sent, head);
  const std::size_t of_payload = sent - std::min(sent, head);
  offset_ += of_payload;
  counters_.in_place_payload_bytes += of_payload;
  if (sent == head + slice) {
    if (offset_ < bytes_) return SendStatus::unfinished;
    head_bytes_ = head_sent_ = 0;
    return end_sample(RingReader::still_valid(*place_.sequence, place_.expected));
  }
  // The socket is full. A sample that is not begun, or is void already, is not copied aside.
  const bool begun = head_sent_ > 0;
  if (begun && limits.may_copy && RingReader::still_valid(*place_.sequence, place_.expected) &&
      begin_copying()) {
    return copy_slice();
  }
  connection_.want_output();
  return SendStatus::blocked;
}

// False when there is no memory for it.
bool SampleSender::begin_copying() {
  const std::size_t head = head_bytes_ - head_sent_;
  const std::size_t bytes =
      head + (bytes_ - offset_) + (options_.may_tear ? wire::kTornTrailerBytes : 0);
  if (options_.budget) {
    std::optional<MemoryShare> share = options_.budget->try_take(bytes);
    if (!share) return false;
    share_ = *std::move(share);
  }
  aside_ = RawBytes(bytes);
  std::copy_n(head_.begin() + head_sent_, head, aside_.data());
  aside_bytes_ = head;
  head_bytes_ = head_sent_ = 0;
  copying_ = true;
  return true;
}

SendStatus SampleSender::copy_slice() {
  const std::size_t slice = std::min(bytes_ - offset_, kSliceBytes);
  ring::copy_out(aside_.data() + aside_bytes_, place_.payload + offset_, slice);
  aside_bytes_ += slice;
  offset_ += slice;
  counters_.copied_payload_bytes += slice;
  return offset_ < bytes_ ? SendStatus::unfinished : end_copying();
}

SendStatus SampleSender::end_copying() {
  const bool valid = RingReader::still_valid(*place_.sequence, place_.expected);
  copying_ = false;
  if (!options_.may_tear && !valid) {
    busy_ = false;
    aside_ = {};
    share_ = {};
    return SendStatus::not_in_ring;
  }
  if (options_.may_tear) {
    const auto trailer = wire::torn_trailer(!valid);
    std::copy(trailer.begin(), trailer.end(), aside_.data() + aside_bytes_);
  }
  connection_.queue_rest(std::exchange(aside_, {}), std::exchange(share_, {}));
  const SendStatus status = end_sample(valid);
  head_bytes_ = 0;  // the trailer is queued already
  return status;
}

SendStatus SampleSender::end_sample(bool valid) {
  if (options_.may_tear) {
    keep_head(wire::torn_trailer(!valid));
    connection_.set_mid_frame(false);
  }
  busy_ = false;
  ++counters_.samples;
  if (!valid) ++counters_.torn;
  return valid ? SendStatus::sent : SendStatus::torn;
}

[[gnu::hot]] void SampleSender::end_run() {
  if (busy_ || head_bytes_ == 0) return;
  const std::size_t bytes = head_bytes_ - head_sent_;
  const iovec part = part_of(head_.data() + head_sent_, bytes);
  const std::size_t sent = bytes > 0 ? connection_.send_now({&part, 1}) : 0;
  if (sent < bytes) {
    connection_.queue_rest(
        RawBytes::copy_of(std::span(head_).subspan(head_sent_ + sent, bytes - sent)));
  }
  head_bytes_ = head_sent_ = 0;
}

}  // namespace dssm::daemon
