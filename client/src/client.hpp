// SPDX-License-Identifier: Apache-2.0
//
// The connection behind a Session: requests and their answers, the thread that keeps it alive, and
// what this process has open.
//
// The keeper thread reads everything that dssmd sends and hands answers to the threads that wait
// for them. When the connection breaks it connects anew, for ever, and before anything else offers
// back every ring that is still held. Requests that were under way are sent again: all of them
// may be repeated without harm.
#pragma once

#include <atomic>
#include <condition_variable>
#include <dssm/session.hpp>
#include <map>
#include <thread>

#include "client/src/notifier.hpp"
#include "client/src/shared_ring.hpp"
#include "core/clock/clock_page.hpp"
#include "core/clock/playback_record.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"

namespace dssm::detail {

class Client;

// One stream opened by one reader or writer; ends at dssmd when destroyed.
struct OpenStream {
  OpenStream(std::shared_ptr<Client> owner, StreamId asked_for, StreamId stream,
             TypeInfo payload_type, Role user_role, std::uint32_t user_tag,
             std::shared_ptr<const SharedRing> shared)
      : client(std::move(owner)),
        asked(std::move(asked_for)),
        id(std::move(stream)),
        type(std::move(payload_type)),
        role(user_role),
        tag(user_tag),
        ring(std::move(shared)) {}
  OpenStream(const OpenStream&) = delete;
  OpenStream& operator=(const OpenStream&) = delete;
  ~OpenStream();

  // The stream has another ring by now: says so to the reader, awake or asleep.
  void supersede() const noexcept;

  const std::shared_ptr<Client> client;
  const StreamId asked;  // by which the user named it, perhaps without host
  const StreamId id;
  const TypeInfo type;
  const Role role;
  const std::uint32_t tag;
  const std::shared_ptr<const SharedRing> ring;
  // Set once: the stream has another ring by now. Shared with the reader's ReadyFd.
  const std::shared_ptr<std::atomic<bool>> superseded = std::make_shared<std::atomic<bool>>(false);
  std::uint64_t key = 0;     // ours, unique in the client; under Client's mutex, as is
  std::uint64_t handle = 0;  // dssmd's name for it; 0: none at the moment
};

struct Answer {
  local::Response response;
  std::vector<UniqueFd> fds;
  std::uint64_t connection = 0;  // which connection it came by; they are counted
};

// Thread-safe.
class Client : public std::enable_shared_from_this<Client> {
 public:
  static Result<std::shared_ptr<Client>> connect(SessionOptions options);
  explicit Client(SessionOptions options);
  ~Client();

  // Sends the request and waits for its answer, over reconnects, at most request_timeout. A Failure
  // comes back as its Error. `fds` stay the caller's.
  Result<Answer> call(local::Request request, std::span<const int> fds = {});

  // Opens for reading or writing by what `request` says (Create or Open).
  Result<std::shared_ptr<OpenStream>> open(local::Request request, Role role, std::uint32_t tag);
  Result<std::shared_ptr<OpenStream>> open_reader(const StreamId& id, std::uint32_t tag);
  Result<std::shared_ptr<OpenStream>> open_writer(const StreamId& id, std::uint32_t tag);

  Result<std::shared_ptr<clock::PlaybackRecord>> playback_clock();

  using OnEvent = std::function<void(const StreamEvent&)>;
  Result<std::uint64_t> add_watch(OnEvent on_event);
  void remove_watch(std::uint64_t key);  // waits for a running callback

  // Where the page is found that says how good this PC's clock is; nullptr in it: there is none.
  using ClockPlace = std::atomic<const clock::ClockPage*>;
  const ClockPlace& clock_page() const noexcept { return clock_page_; }

  bool connected() const;
  NotifierPool& notifiers() { return notifiers_; }

 private:
  friend struct OpenStream;

  // A thread that waits for an answer.
  struct Waiter {
    std::optional<Answer> answer;
    bool broken = false;  // the connection went before the answer came
  };
  struct InFlight {
    Waiter* waiter = nullptr;  // nullptr: nobody waits any more
    std::size_t fds = 0;       // that come with a success
  };

  // What came by the connection and was not yet looked at.
  struct Input {
    wire::FrameBuffer frames{wire::kMaxLocalFrameBytes};
    std::vector<UniqueFd> fds;
  };

  // A connection while it is being set up, before other threads may use it.
  struct Handshake;
  Result<Handshake> shake_hands();
  void offer_streams(Handshake& link);
  void offer_clock(Handshake& link);
  void open_clock_page(Handshake& link);

  void keep();  // the keeper thread
  Result<void> read_connection(int socket);
  Result<void> dispatch(local::Response response);
  void on_stream_event(const proto::StreamEvent& message);
  void on_replaced(std::uint64_t handle);
  void on_rewatched();
  void start_using(Handshake link);
  void stop_using();
  bool pause(Duration time) const;  // false: the client is being destroyed
  Result<void> send_locked(const local::Request& request, std::span<const int> fds);
  Result<void> register_stream(OpenStream& stream, const Answer& answer);
  void close(OpenStream& stream);

  const SessionOptions options_;
  const int owner_pid_;  // a forked child must not speak on our connection
  NotifierPool notifiers_;
  RingCache rings_;
  UniqueFd stop_fd_;  // eventfd: readable when the keeper shall end

  Input input_;  // the keeper's
  ClockPlace clock_page_ = nullptr;

  mutable std::mutex mutex_;         // guards all up to clock_fd_
  std::condition_variable changed_;  // an answer came, or the connection came or went
  UniqueFd socket_;
  std::uint64_t connection_ = 0;  // counts connections
  std::uint64_t next_serial_ = 1;
  std::uint64_t rewatch_serial_ = 0;  // of the Watch that was repeated after a reconnect
  std::map<std::uint64_t, InFlight> in_flight_;
  std::uint64_t next_key_ = 1;
  std::map<std::uint64_t, OpenStream*> open_streams_;  // by OpenStream::key
  std::vector<std::uint64_t> replaced_early_;          // handles told of before they were noted
  std::shared_ptr<clock::PlaybackRecord> clock_;
  UniqueFd clock_fd_;

  std::mutex watch_mutex_;  // guards what follows; held while callbacks run, never under mutex_
  std::uint64_t next_watch_ = 1;
  std::map<std::uint64_t, OnEvent> watches_;
  std::map<std::string, StreamInfo> known_streams_;  // told to the watches, by full name
  std::map<std::string, StreamInfo> told_before_;    // those not confirmed since a reconnect
  bool watching_ = false;

  std::thread keeper_;
};

// The page that a session of this process got last.
Client::ClockPlace& latest_clock_page() noexcept;

}  // namespace dssm::detail
