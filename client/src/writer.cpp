// SPDX-License-Identifier: Apache-2.0
#include <dssm/writer.hpp>
#include <utility>

#include "client/src/states.hpp"

namespace dssm {

LoanedSample::LoanedSample(detail::WriterState* state) noexcept : state_(state) {
  if (std::byte* slot = state->ring.begin()) payload_ = {slot, state->payload_bytes};
}

Tid LoanedSample::publish(Time time, Duration clock_error) noexcept {
  if (!*this) return kNoTid;
  const std::size_t bytes = std::exchange(payload_, {}).size();
  return state_->ring.commit(bytes, time, state_->clock_error_for(time, clock_error));
}

void LoanedSample::abandon() noexcept {
  if (!*this) return;
  payload_ = {};
  state_->ring.cancel();
}

RawWriter::RawWriter(std::unique_ptr<detail::WriterState> state) noexcept
    : state_(std::move(state)) {}
RawWriter::RawWriter(RawWriter&&) noexcept = default;
RawWriter& RawWriter::operator=(RawWriter&&) noexcept = default;
RawWriter::~RawWriter() = default;

[[gnu::hot]] Tid RawWriter::write(std::span<const std::byte> payload, Time time,
                                  Duration clock_error) noexcept {
  if (payload.size() > state_->payload_bytes) return kNoTid;
  return state_->ring.write_with(payload, time,
                                 [&] { return state_->clock_error_for(time, clock_error); });
}

LoanedSample RawWriter::loan() noexcept { return LoanedSample(state_.get()); }

Result<void> RawWriter::set_property(std::span<const std::byte> property) {
  return detail::set_property(*state_->stream->client, id(), property);
}

Tid RawWriter::newest_tid() const noexcept { return state_->ring.newest(); }
const StreamId& RawWriter::id() const noexcept { return state_->stream->id; }
const TypeInfo& RawWriter::type() const noexcept { return state_->stream->type; }
std::uint64_t RawWriter::payload_bytes() const noexcept { return state_->payload_bytes; }

std::uint64_t RawWriter::depth() const noexcept {
  return state_->stream->ring->mapping->geometry().depth;
}
Duration RawWriter::cycle() const noexcept {
  return state_->stream->ring->mapping->identity().cycle;
}
std::uint64_t RawWriter::incarnation() const noexcept {
  return state_->stream->ring->mapping->identity().incarnation;
}

}  // namespace dssm
