// SPDX-License-Identifier: Apache-2.0
//
// Publishes what programs of this PC write into one stream of another host: one local ring, for any
// number of programs that write to it, and one channel to the owner.
//
//   ring     programs write to it and never wait. Samples that the network does not carry at once
//            stay in it; those that it no longer holds when their turn comes are counted and logged
//   once     samples are numbered by their local tids, and the owner stores in its ring which of
//            them it has, so that it can report, after a reconnect, where to continue
//   end      when the programs have closed it and all samples are published, at most kDrainTimeout
//            after the last one closed it
//   removed  a stream that is removed at its owner stays removed until a program creates it again;
//            then it gets what the ring still holds. But when an owner comes back without its ring,
//            the remote writer creates the stream again
//
// The states, and what leads from one to the next; "ring" where there may be one already:
//
//             on_up            Opened            Publishing
//   unavailable ----> opening -------> starting -----------> publishing
//       (ring)        (ring) ^
//             on_up          | Opened
//   removed ----> reopening -+
//     (ring)       (ring)
//
//   the connection ends      removed, reopening -> removed; any other state -> unavailable
//   Failure                  answers the first open() that waits; the next one is asked for in the
//                            same state. Without one: removed if there is no such stream and no
//                            program created it, else unavailable; reopened 2 s later
//   Ended                    any state -> removed; reopened 2 s later, or when the catalog has it
//
// `opening` asks for Create if a program created the stream, `reopening` only if one that waits
// does. A program gets the ring at once if there is one, except in removed and reopening.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>

#include "daemon/link/sample_pump.hpp"
#include "daemon/link/sample_sender.hpp"
#include "daemon/link/stream_feed.hpp"
#include "daemon/remote/outgoing_ring.hpp"
#include "daemon/remote/remote_stream.hpp"

namespace dssm::daemon {

class RemoteWriter final : public RemoteStream,
                           private StreamFeed::Observer,
                           private SamplePump::Observer {
 public:
  static constexpr Duration kDrainTimeout = std::chrono::seconds(10);
  static constexpr bool kSeveralRings = true;

  RemoteWriter(const ChannelParts& parts, StreamId id, RingQuota quota,
               std::function<void()> on_done);
  ~RemoteWriter() override { stop_publishing(); }

 private:
  enum class State : std::uint8_t {
    removed,
    reopening,
    unavailable,
    opening,
    starting,
    publishing,
  };

  // OwnerConnection::Observer
  void on_up(FrameConnection& connection, const wire::Greeting& them) override;
  Result<void> on_frame(net::Frame& frame) override;
  void on_output_empty() override { publish(); }
  void on_down(const Error& why) override;
  void on_reopen() override;
  // StreamFeed::Observer, SamplePump::Observer
  void on_sample_available() override { publish(); }
  void on_gap(Tid, std::uint64_t count) override { log_gap(count); }
  // RemoteStream
  std::shared_ptr<Stream> stream() const noexcept override;
  bool is_removed() const noexcept override { return state_ <= State::reopening; }
  Result<void> check_open(const CreatePlan* plan) override;
  Result<void> use_offered(std::shared_ptr<Stream> stream) override;
  void on_unused() override { drain_timer_.enable_in(Duration::zero()); }

  // Protocol steps
  bool is_opening() const noexcept {
    return state_ == State::opening || state_ == State::reopening;
  }
  void send_open();
  Result<void> on_opened_untrusted(const proto::Opened& opened);
  Result<void> on_publishing_untrusted(const net::Publishing& publishing);
  Result<void> on_published_untrusted(Tid last);
  void on_failure(const Error& why);
  void on_refused(const Error& why);

  // The ring
  Result<void> follow(const StreamInfo& theirs);
  Result<void> use_ring(std::unique_ptr<OutgoingRing> ring);
  void start_publishing();
  void publish();
  void stop_publishing() noexcept;
  void on_drain_timer();
  void log_stopped();

  State state_ = State::unavailable;
  bool creates_ = false;  // a program has created the stream, not only opened it
  History history_;       // of the owner's ring
  std::unique_ptr<OutgoingRing> ring_;
  std::shared_ptr<StreamFeed> feed_;
  bool may_tear_ = false;  // the owner has the feature "torn"
  std::optional<SampleSender> sender_;
  std::optional<SamplePump> pump_;
  EventSource drain_timer_, turn_timer_;
};

}  // namespace dssm::daemon
