// SPDX-License-Identifier: Apache-2.0
#include "tests/process/network/follower.hpp"

#include <algorithm>

namespace dssm::test {

Follower::Follower(const KnownStream& known, RawReader reader, std::optional<RawReader> owner)
    : known_(known),
      source_(std::move(reader)),
      owner_(std::move(owner)),
      payload_(known.payload_bytes) {
  this->reader().seek(kNoTid);
}

Follower::Follower(const KnownStream& known, PConnector connector, std::optional<RawReader> owner)
    : known_(known),
      source_(std::move(connector)),
      owner_(std::move(owner)),
      payload_(known.payload_bytes) {}

std::uint64_t Follower::lost() const {
  return std::visit([](const auto& source) { return source.lost_samples(); }, source_);
}

ReadStatus Follower::next(SampleInfo& info) {
  if (auto* reader = std::get_if<RawReader>(&source_)) return reader->read_next(payload_, info);
  const Result<ReadStatus> status = connector().read_next(payload_, info);
  return status ? *status : ReadStatus::not_yet;  // unavailable: the next call tries again
}

void Follower::take(int most) {
  SampleInfo info;
  for (int i = 0; i < most; ++i) {
    const ReadStatus status = next(info);
    switch (status) {
      case ReadStatus::ok:
        check(info);
        break;
      case ReadStatus::restarted:
        if (owner_) fault("restarted, although its owner's ring always existed");
        ++restarts_;
        earlier_life_ = life_;
        life_ = 0;
        last_ = kNoTid;
        break;
      case ReadStatus::not_yet:
      case ReadStatus::clock_out_of_bounds:  // this one and the next are not of reads by tid
      case ReadStatus::stale:
      case ReadStatus::lapped:  // repeatedly; the next call continues
        return;
      case ReadStatus::too_old:
      case ReadStatus::arriving:
      case ReadStatus::lost:
        fault("next() returned " + std::string(name_of(status)));
        return;
    }
  }
}

void Follower::check(const SampleInfo& info) {
  if (life_ == 0) life_ = KnownStream::life(payload_);
  const bool is_reader = std::holds_alternative<RawReader>(source_);
  if (last_ == kNoTid) {
    // A reader counts losses from tid 0, a subscription from the oldest sample at its start.
    first_ = is_reader ? 0 : info.tid - static_cast<Tid>(lost() - lost_);
    last_ = first_ - 1;
    first_taken_ = info.tid;
  }
  if (life_ <= earlier_life_) fault("a new ring with samples of an earlier life");
  if (const std::string wrong = known_.fault(payload_, info, life_); !wrong.empty()) fault(wrong);
  if (info.tid <= last_) {
    fault("tid " + std::to_string(info.tid) + " after " + std::to_string(last_));
  }
  const auto left_out = static_cast<std::uint64_t>(info.tid - last_ - 1);
  std::uint64_t counted = lost() - lost_;
  // A subscription counts a gap when it is notified of it, which may be before this sample is
  // taken. Losses that were counted when the first sample was taken may belong to a gap after that
  // sample.
  if (!is_reader && left_out > counted) {
    const auto behind_first =
        std::min(left_out - counted, static_cast<std::uint64_t>(first_taken_ - first_));
    first_ += static_cast<Tid>(behind_first);
    lost_ -= behind_first;
    counted += behind_first;
  }
  if (is_reader ? left_out != counted : left_out > counted) {
    fault(std::to_string(left_out) + " samples before tid " + std::to_string(info.tid) +
          " are missing, and " + std::to_string(counted) + " were counted");
  }
  // Queried after the loss: the samples of the ring now were in it when they were counted as lost.
  const Tid oldest = left_out > 0 && owner_ ? owner_->oldest_tid() : info.tid;
  if (oldest < info.tid && is_thinned_) {
    lost_though_held_ += std::min(left_out, static_cast<std::uint64_t>(info.tid - oldest));
  } else if (oldest < info.tid) {
    fault("tids " + std::to_string(last_ + 1) + " to " + std::to_string(info.tid - 1) +
          " were lost, and the owner's ring holds those from " + std::to_string(oldest));
  }
  last_ = info.tid;
  lost_ += left_out;
  ++taken_;
}

void Follower::fault(const std::string& what) {
  constexpr int kEnough = 10;
  if (++fault_count_ <= kEnough) faults_ += "'" + known_.id.str() + "': " + what + "\n";
}

}  // namespace dssm::test
