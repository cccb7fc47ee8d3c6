// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/served_stream.hpp"

#include <utility>

#include "core/base/try.hpp"

namespace dssm::daemon {
namespace {

// What `pointer` still points to, or what `open` makes.
template <class T, class Open>
Result<std::shared_ptr<T>> shared(std::weak_ptr<T>& pointer, Open open) {
  if (std::shared_ptr<T> there = pointer.lock()) return there;
  Result<std::shared_ptr<T>> opened = open();
  if (opened) pointer = *opened;
  return opened;
}

}  // namespace

Result<std::shared_ptr<OwnWriter>> OwnWriter::open(const Stream& stream) {
  std::shared_ptr<const ring::RingMapping> mapping = DSSM_TRY(stream.map_for_writing());
  std::shared_ptr<ring::Bell> bell = DSSM_TRY(stream.map_bell());
  return std::shared_ptr<OwnWriter>(new OwnWriter(std::move(mapping), std::move(bell)));
}

OwnWriter::OwnWriter(std::shared_ptr<const ring::RingMapping> mapping,
                     std::shared_ptr<ring::Bell> bell)
    : mapping_(std::move(mapping)), bell_(std::move(bell)), writer_(*mapping_, *bell_, -1) {}

Result<std::shared_ptr<StreamFeed>> ServedStream::feed() {
  return shared(feed_, [this] { return StreamFeed::open(loop_, stream_); });
}

Result<std::shared_ptr<OwnWriter>> ServedStream::writer() {
  return shared(writer_, [this] { return OwnWriter::open(*stream_); });
}

Result<void> ServedStream::assess(const ring::ClockAssessment& assessment) {
  if (!assessed_) {
    assessed_ = DSSM_TRY(this->writer());
  }
  assessed_->set_clock(assessment);
  return {};
}

void ServedStream::check() {
  if (const std::shared_ptr<StreamFeed> feed = feed_.lock()) feed->poll();
}

std::shared_ptr<ServedStream> ServedStreams::get(const std::shared_ptr<Stream>& stream) {
  if (const auto found = streams_.find(stream.get()); found != streams_.end()) {
    return found->second;
  }
  auto served = std::make_shared<ServedStream>(loop_, stream);
  streams_.emplace(stream.get(), served);
  return served;
}

void ServedStreams::check_all() {
  for (const auto& [key, served] : streams_) served->check();
}

}  // namespace dssm::daemon
