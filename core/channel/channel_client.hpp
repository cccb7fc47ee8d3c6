// SPDX-License-Identifier: Apache-2.0
//
// The client end of a channel (network.proto): what is asked of a stream's owner, and what its
// answers and events mean. It has no connection and no memory of samples: its delegate sends the
// frames, and keeps the stream's ring or buffers. dssmd drives it from its loop (Mirror,
// RemoteWriter), PConnector from its calls (StreamClient).
//
//   connect_plan.hpp     which address, and when; then wire::server_greeting_untrusted()
//   ChannelClient        Open or Create; then Subscribe, StartPublishing or both
//   SampleCursor         which sample comes next, what is lost, where to resume
//
// Its state is of one connection. What leads from one to the next:
//
//              open()           Opened
//   stream   closed ----> opening ----> open
//
//            subscribe()       Subscribed          CaughtUp
//   reading  none ------> asked --------> filling --------> live
//
//            publish()         Publishing
//   writing  none ------> asked --------> granted
//
//   reset()             everything -> closed, none, none: the connection has ended, or is not
//                       used for this stream any more
//   Failure             the state before that request; on_refused()
//   Ended               the state stays; on_ended()
//
// The rules of the protocol are enforced here: an answer or event that cannot come now is an error,
// which costs the connection.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <string_view>

#include "core/wire/messages.hpp"
#include "network.pb.h"

namespace dssm::channel {

// Greater tids do not exist: they come from a program that wrote invalid values into a ring. Far
// enough from the greatest number to add to them.
inline constexpr Tid kMaxTid = Tid{1} << 61;

// Which sample of a subscription comes next, and how many never will: what a receiver asks for when
// its connection is back, and what it accepts. A value; one thread. After an error it is as before.
class SampleCursor {
 public:
  // The tid of the next sample; kNoTid: not known, it is where the owner begins.
  Tid next() const noexcept { return next_; }
  // Samples that this receiver will never get.
  std::uint64_t lost() const noexcept { return lost_; }

  // Continues with that sample, of the ring that the receiver follows now. kNoTid: with whichever
  // comes first.
  void set_next(Tid next) noexcept { next_ = next; }
  // Whether the owner leaves samples out to keep to a rate: then only what it reports is lost.
  void set_thinned(bool thinned) noexcept { is_thinned_ = thinned; }

  // The request that continues with next(), a tid of that ring, else from the oldest sample on.
  void resume(std::uint64_t incarnation, net::Subscribe& out) const;

  // The owner begins with sample `first`; what it left out is lost.
  //   fails  protocol: it has come already, or is no tid
  Result<void> on_subscribed_untrusted(Tid first);
  // Whether sample `tid` may come now. If not: unexpected().
  bool accepts(Tid tid) const noexcept { return tid >= next_ && tid <= kMaxTid; }
  Error unexpected(Tid tid) const;
  // Sample `tid`, which it accepts, has come; those before it are lost.
  void on_sample(Tid tid) noexcept {
    if (!is_thinned_) lost_ += static_cast<std::uint64_t>(tid - next_);
    next_ = tid + 1;
  }
  // The owner's ring no longer has these.
  //   fails  protocol: they have come already, or are no tids
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count);
  // The tid after the last one of a gap.
  //   fails  protocol: they are no tids
  static Result<Tid> end_of_gap_untrusted(Tid first, std::uint64_t count);

 private:
  Tid next_ = kNoTid;
  bool is_thinned_ = false;
  std::uint64_t lost_ = 0;
};

// What a stream shall be like that is created unless it is there.
struct CreatePlan {
  TypeInfo type;
  History history;
  bool keep_existing = false;  // as in proto::Create
  // How far the request goes. join: opens a stream that is there, and whoever asks checks that it
  // fits; create: also makes one that is missing; replace: also one that does not fit.
  enum class Scope : std::uint8_t { join, create, replace } scope = Scope::replace;
};

// A value; one thread. Its functions call the delegate, which may call open(), subscribe(),
// publish() and reset() in return.
class ChannelClient {
 public:
  enum class Stream : std::uint8_t { closed, opening, open };
  enum class Reading : std::uint8_t { none, asked, filling, live };
  enum class Writing : std::uint8_t { none, asked, granted };
  enum class Request : std::uint8_t { open, subscribe, publish };

  // An error that a function returns is to end the connection.
  class Delegate {
   public:
    virtual void send(const net::Frame& frame) = 0;
    // The stream is open; `stream` is checked, and has the name that was asked for.
    virtual Result<void> on_opened(StreamInfo stream, bool created) = 0;
    // Samples come from now on, beginning with `first`, for
    // SampleCursor::on_subscribed_untrusted(). newest_first: as it was asked for. oldest and
    // newest: what the owner's ring holds.
    virtual Result<void> on_subscribed_untrusted(Tid /*first*/, bool /*newest_first*/,
                                                 Tid /*oldest*/, Tid /*newest*/) {
      return {};
    }
    // All samples that the owner had when it was asked have come.
    virtual Result<void> on_caught_up() { return {}; }
    // For SampleCursor::on_gap_untrusted().
    virtual Result<void> on_gap_untrusted(Tid /*first*/, std::uint64_t /*count*/) { return {}; }
    // The owner has written samples of this publisher: all up to its number `last`, which has the
    // tid `last_tid` there. -1: none that it knows of.
    //   begins  the answer to publish(): the samples after `last` may be sent
    virtual Result<void> on_published_untrusted(std::int64_t /*last*/, Tid /*last_tid*/,
                                                bool /*begins*/) {
      return {};
    }
    // The owner refused the request.
    virtual Result<void> on_refused(Request request, const Error& why) = 0;
    // The owner has removed the stream, after its last samples; `why` is Errc::not_found.
    virtual Result<void> on_ended(const Error& why) = 0;
    // Any other frame: an answer to a request of the delegate's own, or an event that is not of the
    // channel. One that the delegate does not know is of a later version: it is ignored.
    virtual Result<void> on_other_frame(net::Frame& frame) = 0;

   protected:
    ~Delegate() = default;
  };

  explicit ChannelClient(Delegate& delegate) noexcept : delegate_(delegate) {}

  Stream stream() const noexcept { return stream_; }
  Reading reading() const noexcept { return reading_; }
  Writing writing() const noexcept { return writing_; }
  // Also of the subscription that the present request replaces.
  bool takes_samples() const noexcept {
    return reading_ >= Reading::filling ||
           (reading_ == Reading::asked && before_asked_ >= Reading::filling);
  }
  // Whether no request of these waits for its answer.
  bool is_settled() const noexcept {
    return stream_ == Stream::open && reading_ != Reading::asked && writing_ != Writing::asked;
  }

  // --- requests. Serials are shared with the delegate's own requests.

  std::uint64_t next_serial() noexcept { return next_serial_++; }
  // First, and again after a refusal.
  //   id    with a host: the owner's
  //   plan  nullptr: the stream must exist
  void open(const StreamId& id, const CreatePlan* plan);
  // Begins or replaces the subscription.
  void subscribe(const net::Subscribe& request);
  void publish(std::uint64_t publisher);
  // The connection has ended.
  void reset() noexcept;

  // --- what arrives

  Result<void> on_frame(net::Frame& frame);
  // Of a sample with serial 0 while takes_samples() is false.
  static Error unexpected(std::string_view frame);

 private:
  Result<void> on_open_answer(const net::Frame& frame);
  Result<void> on_subscribe_answer(const net::Frame& frame);
  Result<void> on_publish_answer(const net::Frame& frame);
  Result<void> on_event(net::Frame& frame);

  Delegate& delegate_;
  StreamId id_;
  Stream stream_ = Stream::closed;
  Reading reading_ = Reading::none;
  Reading before_asked_ = Reading::none;  // what it was before `asked`
  Writing writing_ = Writing::none;
  std::uint64_t incarnation_ = 0;  // of the ring that is open
  // Of the requests that wait for their answers; 0: none.
  std::uint64_t open_serial_ = 0, subscribe_serial_ = 0, publish_serial_ = 0;
  std::uint64_t next_serial_ = 1;
};

}  // namespace dssm::channel
