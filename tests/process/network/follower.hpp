// SPDX-License-Identifier: Apache-2.0
//
// A reader, or a PConnector's subscription, that reads every sample of a stream of known samples
// and checks them: each sample once, in order, untorn; gaps counted exactly; no sample counted as
// lost that the owner's ring still holds.
#pragma once

#include <dssm/dssm.hpp>
#include <dssm/pconnector.hpp>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "tests/process/network/known_samples.hpp"

namespace dssm::test {

// One thread, that of its reader.
class Follower {
 public:
  //   reader     begins with the oldest sample of its ring
  //   connector  has subscribed from the oldest sample on
  //   owner      a reader of the owner's ring, which exists as long as the stream; without it, the
  //              stream may restart, with a greater life
  Follower(const KnownStream& known, RawReader reader, std::optional<RawReader> owner);
  Follower(const KnownStream& known, PConnector connector, std::optional<RawReader> owner);

  // Takes the available samples, at most `most`.
  void take(int most);

  RawReader& reader() { return std::get<RawReader>(source_); }
  PConnector& connector() { return std::get<PConnector>(source_); }
  const KnownStream& known() const { return known_; }
  // The network may carry less than the stream: what is lost may still be in the owner's ring, and
  // is counted.
  void expect_thinning() { is_thinned_ = true; }
  std::uint64_t lost_though_held() const { return lost_though_held_; }
  // The newest sample of the owner's ring has been taken.
  bool has_all() const { return owner_ && last_ == owner_->newest_tid(); }

  Tid first() const { return first_; }  // the first available one of the last ring
  Tid last() const { return last_; }
  std::uint64_t life() const { return life_; }
  std::uint64_t taken() const { return taken_; }
  std::uint64_t lost() const;
  std::uint64_t restarts() const { return restarts_; }

  // All errors, one per line; empty if there are none.
  const std::string& faults() const { return faults_; }

 private:
  ReadStatus next(SampleInfo& info);
  void check(const SampleInfo& info);
  void fault(const std::string& what);

  KnownStream known_;
  std::variant<RawReader, PConnector> source_;
  bool is_thinned_ = false;
  std::optional<RawReader> owner_;
  std::vector<std::byte> payload_;
  std::uint64_t life_ = 0;  // 0: of the next sample
  std::uint64_t earlier_life_ = 0;
  Tid first_ = 0, last_ = kNoTid;
  Tid first_taken_ = kNoTid;
  std::uint64_t lost_ = 0;  // as the source counted, up to `last_`
  std::uint64_t taken_ = 0, restarts_ = 0, lost_though_held_ = 0;
  int fault_count_ = 0;
  std::string faults_;
};

}  // namespace dssm::test
