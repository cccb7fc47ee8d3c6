// SPDX-License-Identifier: Apache-2.0
//
// The program's side of lockstep (core/clock/lockstep_page.hpp): where a thread would wait, it
// waits for its turn.
#pragma once

#include <dssm/sample.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <memory>
#include <optional>

#include "core/base/sealed_memory.hpp"
#include "core/base/unique_fd.hpp"
#include "core/clock/lockstep_page.hpp"

namespace dssm::detail {

// Thread-safe.
class Lockstep {
 public:
  // Of this process; nullptr when no player runs it in lockstep.
  static Lockstep* of_process() noexcept;

  // Waits until ready(), which may be called often, or for `time` of the playback clock.
  //   returns  empty: lockstep is over, or this thread has no place; wait in another way
  std::optional<WaitStatus> wait_for(Duration time, const std::function<bool()>& ready) noexcept;

  // The same until `deadline`: for as long by the playback clock as it is until then, in
  // milliseconds, so that the few microseconds that a program took make no difference.
  std::optional<WaitStatus> wait_until(MonoTime deadline,
                                       const std::function<bool()>& ready) noexcept;

  // All threads of this process that wait here call their ready() again.
  void recheck() noexcept;

  // For as long as it exists its thread waits for an answer of dssmd: the player waits for that.
  class Request {
   public:
    Request() noexcept;
    ~Request();
    Request(const Request&) = delete;
    Request& operator=(const Request&) = delete;
  };

 private:
  static std::unique_ptr<Lockstep> from_environment() noexcept;
  Lockstep(SharedMapping mapping, UniqueFd player) noexcept
      : mapping_(std::move(mapping)), player_(std::move(player)) {}
  clock::LockstepPage& page() const noexcept { return mapping_.as<clock::LockstepPage>(); }
  clock::LockstepPlace* own_place() noexcept;
  bool await_turn(clock::LockstepPlace& place) noexcept;  // false: a signal came
  bool has_ended() const noexcept;

  SharedMapping mapping_;
  UniqueFd player_;  // eventfd
};

}  // namespace dssm::detail
