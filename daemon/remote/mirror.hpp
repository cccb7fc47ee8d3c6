// SPDX-License-Identifier: Apache-2.0
//
// The copy of one stream of another host: one channel to its owner and one ring here, for any
// number of programs that read it. The newest sample comes first, and what is written from then on.
// What was written before, or while there was no connection, is fetched when a program reads it or
// asked for it with its open: want_history(), with_history(). Until then it is the ring's hole. A
// program that opens the stream gets the ring when what is fetched is here, or after kFillTimeout.
// While the owner is away, those that read one sample after the other wait before what is missing.
//
//   ring      has the owner's type, cycle and incarnation, and its depth or, by the key
//             mirror_streams, less. When the owner's stream has another incarnation, the mirror
//             makes a new ring, and readers of the old one are notified as soon as the new one is
//             filled
//   error     while the owner is unavailable, or has removed the stream, the ring stays as it is
//             for its readers, and the mirror always retries
//   end       when no program has used the ring for mirror_linger
//
// The states are drawn in remote_stream.hpp; `live` when what is fetched is here. If there is a
// ring, a program gets it at once while the channel is closed, opening or live. While it is
// subscribing and filling, and after the catalog or the owner said that the stream was removed, its
// open() waits; while it is filling, not if the newest sample is here and the program has not asked
// for history.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "common.pb.h"
#include "daemon/remote/mirror_ring.hpp"
#include "daemon/remote/remote_stream.hpp"

namespace dssm::daemon {

class Mirror final : public RemoteStream, private FrameConnection::SampleDelegate {
 public:
  // How long an open() waits for what is fetched. What has arrived by then can be read.
  static constexpr Duration kFillTimeout = std::chrono::seconds(1);
  static constexpr bool kSeveralRings = false;

  Mirror(const ChannelParts& parts, StreamId id, RingQuota quota, std::function<void()> on_done);

  // Fetches what is missing in the ring, also after a reconnect, until that has come once.
  void want_history();
  // The ring for a program that wants history at once: what is missing is fetched, also after each
  // reconnect, while the program holds the result.
  std::shared_ptr<Stream> with_history(const std::shared_ptr<Stream>& ring);
  // ChannelParts::mirrors has changed.
  void on_new_demand();

  void describe(proto::Mirror& out) const;
  // The stream as its ring here shows it. False: there is none yet.
  bool describe_stream(proto::Stream& out) const;

  void on_stream_added(const StreamInfo& theirs) override;
  void on_stream_removed(std::uint64_t incarnation) override;
  void on_owner_clock(MirrorClock::Report report) override {
    on_owner_clock(std::move(report), std::nullopt);
  }
  // This PC's clock was read again.
  void on_own_clock() { assess_clock(); }

 private:
  struct Totals {
    std::uint64_t gap_samples = 0, received_samples = 0, received_bytes = 0;
  };

  // ChannelClient::Delegate
  Result<void> on_opened(StreamInfo stream, bool created) override;
  Result<void> on_subscribed_untrusted(Tid first, bool newest_first, Tid oldest,
                                       Tid newest) override;
  Result<void> on_caught_up() override;
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count) override;
  Result<void> on_refused(channel::ChannelClient::Request request, const Error& why) override;
  Result<void> on_other_frame(net::Frame& frame) override;
  // FrameConnection::SampleDelegate
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  void on_batch_end() override;
  // RemoteStream
  std::shared_ptr<Stream> stream() const noexcept override;
  bool can_open_now(bool waits_for_history) const noexcept override;
  Duration open_timeout() const noexcept override;
  Result<void> check_open(const CreatePlan*) override { return clock_.check_opening(); }
  Result<void> use_offered(std::shared_ptr<Stream> stream) override;
  void on_unused() override;
  void on_connected(const wire::Greeting& them) override;
  void on_channel_end() override;

  // The ring
  Result<void> follow_untrusted(const StreamInfo& theirs);
  void describe_as_untrusted(const StreamInfo& theirs);
  void replace_ring(std::unique_ptr<MirrorRing> ring);
  void notify_replaced();
  void on_owner_clock(MirrorClock::Report report,
                      const std::optional<MirrorClock::OnChannel>& on_channel);
  void assess_clock();
  void log_new_gap() {
    const std::uint64_t lost = ring_->gap_samples();
    const std::uint64_t before = std::exchange(logged_gap_, lost);
    if (lost != before && max_rate_hz_ == 0) log_gap(lost - before, gap_reason());
  }
  std::string_view gap_reason() const noexcept;
  std::uint64_t depth_for(const StreamInfo& theirs) const noexcept;
  bool wants_history() const noexcept;
  double wanted_rate_hz() const noexcept;
  void subscribe();
  void subscribe_for_history();
  bool is_filling() const noexcept;
  proto::Mirror::State shown_state() const noexcept;

  bool newest_first_ = false;  // the owner has that feature
  Tid fresh_from_ = kNoTid;    // the owner's newest sample when it was asked
  bool is_fresh_ = false;      // that one, or a newer one, has come on this connection
  // History is wanted until it has come once, and while there are programs that want it at once.
  bool history_wanted_ = false;
  UseCount history_use_{[] {}};
  bool with_history_ = false;   // the present subscription, and
  double max_rate_hz_ = 0;      // its rate; 0: all samples
  bool is_shorter_ = false;     // the ring, than the owner's
  bool is_subscribed_ = false;  // on this connection
  bool is_ending_ = false;      // live, but the catalog knows that this ring was removed
  MirrorClock clock_;
  bool in_batch_ = false;  // samples have come, and on_batch_end() has not
  std::unique_ptr<MirrorRing> ring_;
  std::uint64_t logged_gap_ = 0;                   // of this ring
  std::vector<std::shared_ptr<Stream>> replaced_;  // their readers are still to be notified
  Totals earlier_;                                 // of the rings that were replaced
  std::uint64_t subscriptions_ = 0, restarts_ = 0;
  EventSource fill_timer_, linger_timer_;
};

}  // namespace dssm::daemon
