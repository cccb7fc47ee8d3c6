// SPDX-License-Identifier: Apache-2.0
//
// Owns the one playback clock of this PC (core/clock/playback_record.hpp). It is made when first
// requested, or after a restart of dssmd taken back from the first program that still has it.
//
// A program on any host may have the clocks of all hosts follow that of its own PC: it repeats that
// once a second; a clock that gets no renewal for kLease shows the real time again.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <memory>
#include <string>

#include "catalog.pb.h"
#include "core/base/unique_fd.hpp"
#include "core/clock/playback_record.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class PlaybackClockOwner {
 public:
  static constexpr Duration kLease = std::chrono::seconds(5);

  bool has_one() const noexcept { return static_cast<bool>(clock_); }

  // Takes `offered` when there is no clock yet and it is one that dssmd created.
  //   fails  protocol, no_permission; also when there is one already and it is not the same:
  //          conflict. The clock that counts is what get() gives.
  Result<void> adopt_untrusted(UniqueFd offered);

  // A descriptor (read and write) for a client; its own.
  Result<UniqueFd> get();

  // Called with each new clock from now on; {}: no call.
  void on_new_clock(std::function<void(int fd)> then) { on_new_clock_ = std::move(then); }

  // For a program of this PC that drives this clock, and perhaps those of other hosts: what they
  // shall follow, as a request to them.
  //   fails  as follow_untrusted(), and no_memory
  Result<proto::FollowPlayback> lead(const proto::FollowPlayback& request, std::string driver_name,
                                     ClientNumber client, MonoTime now);
  // That program has ended, or lost its connection: others may drive the clock from now on. If none
  // does, it shows the real time again when the lease ends.
  void on_client_gone(ClientNumber client) noexcept;

  // The clock is what `request` of another host says.
  //   fails  invalid_argument; conflict (another driver's lease has not ended); unavailable (a
  //          program holds the clock's lock); no_memory
  Result<void> follow_untrusted(const proto::FollowPlayback& request, MonoTime now);

  // The program of another host that drives this clock, for people: "dssmctl play@pc1". Empty: none
  // does, or one of this PC.
  std::string followed_driver(MonoTime now) const;

  // Called with each renewal; {}: no call. After kLease check_lease() is to be called.
  void on_lease(std::function<void()> then) { on_lease_ = std::move(then); }
  // Lets the clock show the real time again if the driver has not renewed it.
  //   returns  when to call it again; kNever: no driver
  MonoTime check_lease(MonoTime now) noexcept;

 private:
  void take(UniqueFd clock);
  Result<void> renew(const proto::FollowPlayback& request, const std::string& name, MonoTime now);
  Result<clock::PlaybackRecord*> record();

  UniqueFd clock_;
  std::shared_ptr<clock::PlaybackRecord> record_;
  std::function<void(int)> on_new_clock_;
  std::function<void()> on_lease_;
  std::uint64_t driver_ = 0;  // 0: none
  std::string driver_name_;
  ClientNumber client_ = 0;      // the driver, while it runs on this PC
  bool is_driver_gone_ = false;  // others need not wait for the end of its lease
  bool follows_ = false;         // the driver runs on another host
  MonoTime lease_end_{};
};

}  // namespace dssm::daemon
