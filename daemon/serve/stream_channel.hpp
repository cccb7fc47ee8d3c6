// SPDX-License-Identifier: Apache-2.0
//
// The server end of a channel, once its stream is open: subscription, reads, publishing, property.
// DataCommunicator brings it requests one at a time and never while it is busy().
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <optional>

#include "core/ring/ring_reader.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/fleet/clock_assessor.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/link/sample_pump.hpp"
#include "daemon/link/sample_sender.hpp"
#include "daemon/serve/sample_receiver.hpp"
#include "daemon/serve/served_stream.hpp"
#include "daemon/service/config_values.hpp"
#include "daemon/streams/catalog_requests.hpp"

namespace dssm::daemon {

class StreamChannel final : private SamplePump::Observer,
                            private StreamFeed::Observer,
                            private FrameConnection::SampleDelegate {
 public:
  // How often a sample is looked for by its time in one turn. A writer can link the runs in its
  // ring so that each search ends without a result, after ring::kMaxHops.
  static constexpr int kMaxFinds = 8;

  // Calls work(): at once, or in the next turn of the loop.
  class Observer {
   public:
    virtual void work_now() = 0;
    virtual void work_soon() = 0;

   protected:
    ~Observer() = default;
  };
  struct Parts {
    const EventLoop& loop;
    CatalogRequests& catalog;
    FrameConnection& link;
    MemoryBudget& budget;  // of the peer
    Observer& observer;
    const wire::Greeting& self;
    const wire::Greeting& them;
    std::string account;   // of the client
    ClockAssessor* clock;  // nullptr: the clock is not watched
    const SendingDemands& sending;
  };

  // may_tear: the client has the feature "torn". All in `parts` outlive it.
  StreamChannel(const Parts& parts, std::shared_ptr<ServedStream> served, bool may_tear);
  StreamChannel(const StreamChannel&) = delete;
  StreamChannel& operator=(const StreamChannel&) = delete;
  ~StreamChannel();

  const Stream& stream() const noexcept { return served_->stream(); }

  // Does what the client asks for; the answer goes to the link now or, for Read, from work(). The
  // link's output is empty.
  //   fails  with the error for the client, also for requests that no channel knows
  Result<void> serve_untrusted(const net::Frame& request);

  // Whether a sample is on its way in several parts, or an answer is not complete: no request may
  // be served now.
  bool busy() const noexcept { return sender_.busy() || reading_.has_value(); }

  // Goes on with what can go on, for one turn.
  //   request_waits  no sample of the subscription is begun, so that busy() ends
  Result<void> work(bool request_waits);

  // The clock has a new generation.
  void on_new_clock();

  // The stream lost its name: what it holds is still sent, then the client is notified.
  void on_removed();

  const SampleSender::Counters& counters() const noexcept { return sender_.counters(); }
  std::uint64_t lost() const noexcept { return lost_; }

 private:
  // A Read that is not answered yet.
  struct Reading {
    std::uint64_t serial = 0;
    net::Read request;
    int attempts = 0;
  };

  Result<void> subscribe(std::uint64_t serial, const net::Subscribe& request);
  Tid first_tid(const net::Subscribe& request) const;
  Result<void> get_range(std::uint64_t serial, const net::GetRange& request);
  Result<void> start_publishing(std::uint64_t serial, const net::StartPublishing& request);
  Result<void> assess_writer();
  Result<void> serve_property(const net::Frame& request);
  Result<void> set_users(std::uint64_t serial, const net::SetUsers& request);
  void set_program(bool reads, bool writes);

  void go_on_reading();
  SendStatus begin_reading();
  ReadStatus find(const net::Read& request, Tid& tid) const;
  void answer_no_sample(ReadStatus status);
  void answer_failure(const Error& error);
  Result<void> go_on_pumping(bool request_waits);
  void end();

  void before_samples() override;
  void on_gap(Tid first, std::uint64_t count) override;
  void on_caught_up() override;
  void on_end() override;
  void on_sample_available() override;

  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  void on_batch_end() override;

  Parts parts_;
  std::shared_ptr<ServedStream> served_;
  const bool sends_clock_;  // the client has the feature "clock"
  ring::RingReader reader_;
  SampleSender sender_;
  std::shared_ptr<StreamFeed> feed_;  // while there is a subscription
  std::optional<SamplePump> pump_;
  std::unique_ptr<SampleReceiver> receiver_;
  std::optional<Reading> reading_;
  std::uint64_t lost_ = 0;
  bool reads_ = false, writes_ = false;            // the client
  std::optional<std::uint64_t> clock_generation_;  // last sent, and with it:
  bool sent_other_clocks_ = false;
  Time sent_settled_from_{};
  EventSource due_;  // for subscriptions with a highest rate, and for history's pace
};

}  // namespace dssm::daemon
