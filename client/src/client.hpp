// SPDX-License-Identifier: Apache-2.0
//
// What a Session uses: connects to dssmd, reconnects, and joins the parts that use the
// connection.
//
//   DaemonConnection  requests and their answers
//   OpenStreams       the streams that this process has open
//   StreamWatches     Session::watch()
//   RingCache         the rings that this process has mapped
//   NotifierPool      RawReader::ready_fd()
//   Opener            opens what Session::subscribe() awaits
//
// One thread reads the connection. When it ends, the thread reconnects until it succeeds, and
// offers all rings before any other thread may use the new connection.
#pragma once

#include <atomic>
#include <dssm/session.hpp>
#include <mutex>
#include <thread>

#include "client/src/daemon_connection.hpp"
#include "client/src/executor_state.hpp"
#include "client/src/notifier.hpp"
#include "client/src/open_streams.hpp"
#include "client/src/opener.hpp"
#include "client/src/stream_watches.hpp"
#include "core/clock/clock_page.hpp"
#include "core/clock/playback_record.hpp"

namespace dssm::detail {

// Thread-safe.
class Client : public std::enable_shared_from_this<Client> {
 public:
  static Result<std::shared_ptr<Client>> connect(SessionOptions options);
  explicit Client(SessionOptions options);
  ~Client();

  // Opens for reading or writing as `request` (Create or Open) asks.
  Result<std::shared_ptr<OpenStream>> open(local::Request request, Role role, std::uint32_t tag);
  Result<std::shared_ptr<OpenStream>> open_reader(const StreamId& id, std::uint32_t tag,
                                                  FetchHistory history);
  // A program reads what is missing in the stream's mirror: the thread tells dssmd. Takes no lock
  // and does not wait, so that a signal handler may read.
  void want_history(const OpenStream& stream) noexcept;
  Result<std::shared_ptr<OpenStream>> open_writer(const StreamId& id, std::uint32_t tag);

  Result<std::shared_ptr<clock::PlaybackRecord>> open_playback_clock();

  // The page with the bound of this PC's clock; nullptr in it: none.
  using ClockPlace = std::atomic<const clock::ClockPage*>;
  const ClockPlace& clock_page() const noexcept { return clock_page_; }

  DaemonConnection& connection() noexcept { return connection_; }
  StreamWatches& watches() noexcept { return watches_; }
  NotifierPool& notifiers() noexcept { return notifiers_; }
  // Each is started by the first call.
  Result<Opener*> opener();
  Result<std::shared_ptr<ExecutorState>> executor();

  // Gives a line for people to SessionOptions::on_notice.
  void notice(const std::string& text) const;

 private:
  friend struct OpenStream;

  Result<void> set_up();  // one attempt
  Result<void> open_clock_page(NewConnection& connection);
  Result<void> offer_playback_clock(NewConnection& connection);
  void run();                       // the thread
  bool pause(Duration time) const;  // false: the client is being destroyed
  void close(const OpenStream& stream);

  const SessionOptions options_;
  const int owner_pid_;  // a forked child must not use our connection
  NotifierPool notifiers_;
  RingCache rings_;
  DaemonConnection connection_;
  OpenStreams streams_{connection_};
  StreamWatches watches_{connection_};
  ClockPlace clock_page_ = nullptr;

  std::mutex playback_mutex_;  // guards these two, which are set once
  std::shared_ptr<clock::PlaybackRecord> playback_;
  UniqueFd playback_fd_;

  std::mutex subscribing_mutex_;  // guards these two, which are set once
  std::unique_ptr<Opener> opener_;
  std::shared_ptr<ExecutorState> executor_;

  std::uint64_t connections_ = 0;  // of the thread, which counts them
  UniqueFd stop_fd_;               // eventfd: readable when the thread must end
  UniqueFd wish_fd_;               // eventfd, non-blocking: when a stream has a wish
  std::thread thread_;
};

// The page that a session of this process received last.
Client::ClockPlace& latest_clock_page() noexcept;

}  // namespace dssm::detail
