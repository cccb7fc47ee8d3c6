// SPDX-License-Identifier: Apache-2.0
#include "client/src/client.hpp"

#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdlib>

#include "client/src/program_name.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/timespec.hpp"
#include "core/base/try.hpp"
#include "core/wire/fd_socket.hpp"

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

// A local dssmd takes and answers within microseconds; one that does not for this long hangs.
constexpr timeval kSocketTimeout{.tv_sec = 2, .tv_usec = 0};

// Between attempts to connect anew. Shorter than dssmd's recovery_grace (500 ms), during which a
// restarted dssmd keeps names free for the rings that are offered back.
constexpr Duration kFirstReconnectPause = 10ms;
constexpr Duration kLongestReconnectPause = 200ms;

// Of events about opens that are not noted yet: as many as threads may be opening at once.
constexpr std::size_t kMaxReplacedEarly = 1024;

std::string default_socket_path() {
  const char* path =
      std::getenv("DSSM_SOCKET");  // NOLINT(concurrency-mt-unsafe): read once, at connect
  return path && *path ? path : wire::kDefaultSocketPath;
}

SessionOptions completed(SessionOptions options) {
  if (options.socket_path.empty()) options.socket_path = default_socket_path();
  if (options.program.empty()) options.program = default_program();
  return options;
}

local::Request open_request(const StreamId& id, bool for_writing, std::uint32_t tag) {
  local::Request request;
  wire::to_message(id, *request.mutable_open()->mutable_id());
  request.mutable_open()->set_for_writing(for_writing);
  request.mutable_open()->set_tag(tag);
  return request;
}

std::size_t fds_with_answer(const local::Request& request) {
  if (request.has_create()) return 4;
  if (request.has_open()) return request.open().for_writing() ? 4 : 3;
  if (request.has_open_clock() || request.has_open_clock_page()) return 1;
  return 0;
}

}  // namespace

Client::ClockPlace& latest_clock_page() noexcept {
  static Client::ClockPlace place = nullptr;
  return place;
}

OpenStream::~OpenStream() { client->close(*this); }

void OpenStream::supersede() const noexcept {
  superseded->store(true, std::memory_order_release);
  ring->bell->notify();  // who sleeps on the old ring shall look up
}

// --- setting up a connection

struct Client::Handshake {
  explicit Handshake(UniqueFd connected) : socket(std::move(connected)) {}

  UniqueFd socket;
  Input input;
  std::vector<std::uint64_t> replaced;  // handles whose Replaced came between the answers
  std::uint64_t serial = 0;

  // One request and its answer, with nobody else on the socket. What descriptors came with it is in
  // input.fds until the next one.
  Result<local::Response> exchange(local::Request request, std::span<const int> request_fds = {}) {
    input.fds.clear();
    request.set_serial(++serial);
    const std::string frame = wire::encode_frame(request);
    auto rest = std::as_bytes(std::span(frame));
    while (!rest.empty()) {
      auto sent = wire::send_some(socket.get(), rest, request_fds);
      if (!sent) return std::move(sent).error();
      if (sent->status == wire::IoStatus::end) break;  // its last words may be there to read
      if (sent->status != wire::IoStatus::ok) return silence();
      rest = rest.subspan(sent->bytes);
      request_fds = {};
    }
    for (;;) {
      auto message = input.frames.next();
      if (!message) return std::move(message).error();
      if (*message) {
        local::Response response;
        if (!response.ParseFromArray((*message)->data(), static_cast<int>((*message)->size()))) {
          return Error{Errc::protocol, "dssmd's answer is no message of the local protocol"};
        }
        if (response.has_failure() && (response.serial() == serial || response.serial() == 0)) {
          return wire::failure(response.failure());  // serial 0: dssmd's last words
        }
        if (response.serial() == serial) {
          return response;
        }
        if (response.has_replaced()) replaced.push_back(response.replaced().handle());
        continue;  // an event, or an answer to what was given up
      }
      auto received = wire::recv_some(socket.get(), input.frames.space(), input.fds);
      if (!received) return std::move(received).error();
      if (received->status != wire::IoStatus::ok) return silence();
      input.frames.commit(received->bytes);
    }
  }

  static Error silence() {
    return Error{Errc::unavailable, "dssmd closed the connection or does not answer"};
  }
};

Result<Client::Handshake> Client::shake_hands() {
  auto connected = wire::connect_unix(options_.socket_path);
  if (!connected) return std::move(connected).error();
  ::setsockopt(connected->get(), SOL_SOCKET, SO_SNDTIMEO, &kSocketTimeout, sizeof kSocketTimeout);
  ::setsockopt(connected->get(), SOL_SOCKET, SO_RCVTIMEO, &kSocketTimeout, sizeof kSocketTimeout);
  Handshake link(std::move(*connected));
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  hello.mutable_hello()->set_program(options_.program);
  hello.mutable_hello()->set_version(DSSM_VERSION);
  auto welcome = link.exchange(std::move(hello));
  if (!welcome)
    return std::move(welcome).error().context("greet dssmd at '" + options_.socket_path + "'");
  if (!welcome->has_hello() || welcome->hello().protocol_version() != wire::kLocalProtocolVersion) {
    return wire::other_protocol_version(
        {"local", wire::kLocalProtocolVersion}, "dssmd at '" + options_.socket_path + "'",
        welcome->hello().protocol_version(), welcome->hello().version());
  }
  open_clock_page(link);
  offer_streams(link);
  offer_clock(link);
  link.input.fds.clear();
  return link;
}

void Client::offer_streams(Handshake& link) {
  struct Held {
    std::uint64_t key;
    StreamId id;
    Role role;
    std::uint32_t tag;
    bool any_host;
    std::shared_ptr<const SharedRing> ring;
  };
  std::vector<Held> all_held;
  {
    const std::lock_guard guard(mutex_);
    for (const auto& [key, stream] : open_streams_) {
      stream->handle = 0;
      all_held.push_back(
          {key, stream->id, stream->role, stream->tag, stream->asked.host.empty(), stream->ring});
    }
  }
  for (const Held& held : all_held) {
    local::Request request;
    wire::to_message(held.id, *request.mutable_offer()->mutable_id());
    request.mutable_offer()->set_for_writing(held.role == Role::writer);
    request.mutable_offer()->set_tag(held.tag);
    request.mutable_offer()->set_any_host(held.any_host);
    const int fds[] = {held.ring->ring_fd.get(), held.ring->bell_fd.get(), held.ring->meta_fd.get(),
                       held.ring->doorbell_fd.get()};
    auto opened =
        link.exchange(std::move(request), std::span(fds).first(held.role == Role::writer ? 4 : 3));
    if (!opened || !opened->has_opened()) {
      // Refused. The holders keep this ring, for themselves; readers go on with the one that has
      // its name by now.
      const std::lock_guard guard(mutex_);
      const auto entry = open_streams_.find(held.key);
      if (!opened && opened.error().code == Errc::conflict && entry != open_streams_.end()) {
        entry->second->supersede();
      }
      continue;
    }
    bool closed_meanwhile = true;
    {
      const std::lock_guard guard(mutex_);
      if (auto entry = open_streams_.find(held.key); entry != open_streams_.end()) {
        entry->second->handle = opened->opened().handle();
        closed_meanwhile = false;
      }
    }
    if (closed_meanwhile) {
      local::Request request_close;
      request_close.mutable_close()->set_handle(opened->opened().handle());
      [[maybe_unused]] auto done = link.exchange(std::move(request_close));
    }
  }
}

// Without one, or with one of another version, nothing is known of the clock, which is no reason
// not to go on.
void Client::open_clock_page(Handshake& link) {
  local::Request request;
  request.mutable_open_clock_page();
  const auto answer = link.exchange(std::move(request));
  if (!answer || link.input.fds.empty()) return;
  const Result<const clock::ClockPage*> page =
      clock::map_clock_page_untrusted(link.input.fds.front().get());
  if (!page) return;
  clock_page_.store(*page, std::memory_order_release);
  latest_clock_page().store(*page, std::memory_order_release);
}

void Client::offer_clock(Handshake& link) {
  int fd = -1;
  {
    const std::lock_guard guard(mutex_);
    fd = clock_fd_.get();  // set once, closed only with the client
  }
  if (fd < 0) return;
  local::Request request;
  request.mutable_open_clock()->set_offered(true);
  [[maybe_unused]] auto answer = link.exchange(std::move(request), std::span(&fd, 1));
}

Result<std::shared_ptr<Client>> Client::connect(SessionOptions options) {
  auto client = std::make_shared<Client>(completed(std::move(options)));
  if (!client->stop_fd_) return os_error("create an eventfd");
  auto link = client->shake_hands();
  if (!link) return std::move(link).error();
  client->start_using(std::move(*link));
  client->keeper_ =
      DSSM_TRY(quiet_thread("the connection to dssmd", [self = client.get()] { self->keep(); }));
  return client;
}

Client::Client(SessionOptions options)
    : options_(std::move(options)), owner_pid_(::getpid()), stop_fd_(::eventfd(0, EFD_CLOEXEC)) {}

Client::~Client() {
  if (!keeper_.joinable()) return;
  if (::getpid() != owner_pid_) {  // the thread stayed with the parent
    keeper_.detach();
    return;
  }
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(stop_fd_.get(), &one, sizeof one);
  keeper_.join();
}

// --- requests

bool Client::connected() const {
  const std::lock_guard guard(mutex_);
  return static_cast<bool>(socket_);
}

Result<void> Client::send_locked(const local::Request& request, std::span<const int> fds) {
  const std::string frame = wire::encode_frame(request);
  auto rest = std::as_bytes(std::span(frame));
  while (!rest.empty()) {
    auto sent = wire::send_some(socket_.get(), rest, fds);
    if (!sent) return std::move(sent).error();
    if (sent->status != wire::IoStatus::ok) return Handshake::silence();
    rest = rest.subspan(sent->bytes);
    fds = {};
  }
  return {};
}

Result<Answer> Client::call(local::Request request, std::span<const int> fds) {
  const std::size_t fds_expected = fds_with_answer(request);
  // steady_clock is CLOCK_MONOTONIC too, with the same origin.
  const std::chrono::steady_clock::time_point deadline(
      deadline_in(options_.request_timeout).time_since_epoch());
  const auto too_late = [&](const char* why) {
    return Error{Errc::unavailable, "dssmd at '" + options_.socket_path + "' " + why +
                                        "; look at `systemctl status dssmd`, then try again"};
  };
  std::unique_lock lock(mutex_);
  for (;;) {
    if (!changed_.wait_until(lock, deadline, [&] { return static_cast<bool>(socket_); })) {
      return too_late("is away and did not come back in time");
    }
    Waiter waiter;
    const std::uint64_t serial = next_serial_++;
    request.set_serial(serial);
    in_flight_[serial] = {&waiter, fds_expected};
    if (!send_locked(request, fds)) ::shutdown(socket_.get(), SHUT_RDWR);  // the keeper takes over
    const bool in_time = changed_.wait_until(
        lock, deadline, [&] { return waiter.answer.has_value() || waiter.broken; });
    if (waiter.answer) {
      if (waiter.answer->response.has_failure()) {
        return wire::failure(waiter.answer->response.failure());
      }
      return std::move(*waiter.answer);
    }
    if (!in_time) {
      in_flight_[serial].waiter = nullptr;
      return too_late("does not answer");
    }
  }
}

Result<std::shared_ptr<OpenStream>> Client::open(local::Request request, Role role,
                                                 std::uint32_t tag) {
  const proto::StreamId& name = request.has_create() ? request.create().id() : request.open().id();
  const StreamId asked{name.name(), name.id(), name.host()};
  auto answer = call(std::move(request));
  if (!answer) return std::move(answer).error();
  if (!answer->response.has_opened()) {
    return Error{Errc::protocol, "dssmd answered something else than the opened stream"};
  }
  const proto::Opened& opened = answer->response.opened();
  auto id = wire::stream_id_untrusted(opened.stream().id());
  if (!id) return std::move(id).error();
  auto type = wire::type_untrusted(opened.stream().type());
  if (!type) return std::move(type).error();
  auto ring = rings_.get(std::move(answer->fds),
                         role == Role::writer ? ring::Access::read_write : ring::Access::read_only,
                         opened.created());
  std::shared_ptr<OpenStream> stream;
  if (ring) {
    stream = std::make_shared<OpenStream>(shared_from_this(), asked, *id, *type, role, tag, *ring);
    if (Result<void> done = register_stream(*stream, *answer); !done)
      return std::move(done).error();
    if ((*ring)->mapping->geometry().payload_bytes != type->payload_bytes) {
      return Error{Errc::protocol, "the ring's payload has another size than dssmd says"};
    }
    return stream;
  }
  local::Request undo;
  if (opened.created()) {  // nobody can use a ring that there is no memory for
    wire::to_message(*id, *undo.mutable_remove()->mutable_id());
  } else {
    undo.mutable_close()->set_handle(opened.handle());
  }
  [[maybe_unused]] auto undone = call(std::move(undo));
  return std::move(ring).error();
}

Result<std::shared_ptr<OpenStream>> Client::open_reader(const StreamId& id, std::uint32_t tag) {
  return open(open_request(id, false, tag), Role::reader, tag);
}

Result<std::shared_ptr<OpenStream>> Client::open_writer(const StreamId& id, std::uint32_t tag) {
  return open(open_request(id, true, tag), Role::writer, tag);
}

// Notes the stream under the handle of its answer. When the connection broke in between, a
// restarted dssmd does not know of us: offer the ring.
Result<void> Client::register_stream(OpenStream& stream, const Answer& answer) {
  {
    const std::lock_guard guard(mutex_);
    stream.key = next_key_++;
    open_streams_[stream.key] = &stream;
    if (answer.connection == connection_ && socket_) {
      stream.handle = answer.response.opened().handle();
      if (std::erase(replaced_early_, stream.handle) > 0) stream.supersede();
      return {};
    }
    if (!socket_) return {};  // the keeper offers it with the others
  }
  local::Request request;
  wire::to_message(stream.id, *request.mutable_offer()->mutable_id());
  request.mutable_offer()->set_for_writing(stream.role == Role::writer);
  request.mutable_offer()->set_tag(stream.tag);
  request.mutable_offer()->set_any_host(stream.asked.host.empty());
  const SharedRing& ring = *stream.ring;
  const int fds[] = {ring.ring_fd.get(), ring.bell_fd.get(), ring.meta_fd.get(),
                     ring.doorbell_fd.get()};
  auto offered =
      call(std::move(request), std::span(fds).first(stream.role == Role::writer ? 4 : 3));
  if (!offered) return std::move(offered).error();
  const std::lock_guard guard(mutex_);
  if (offered->connection == connection_) stream.handle = offered->response.opened().handle();
  return {};
}

void Client::close(OpenStream& stream) {
  if (::getpid() != owner_pid_) return;
  const std::lock_guard guard(mutex_);
  open_streams_.erase(stream.key);
  if (stream.handle == 0 || !socket_) return;
  local::Request request;
  request.set_serial(next_serial_++);  // nobody waits for the answer
  request.mutable_close()->set_handle(stream.handle);
  if (!send_locked(request, {})) ::shutdown(socket_.get(), SHUT_RDWR);
}

Result<std::shared_ptr<clock::PlaybackRecord>> Client::playback_clock() {
  {
    const std::lock_guard guard(mutex_);
    if (clock_) return clock_;
  }
  local::Request request;
  request.mutable_open_clock();
  auto answer = call(std::move(request));
  if (!answer) return std::move(answer).error();
  auto record = clock::PlaybackRecord::open_untrusted(answer->fds[0].get());
  if (!record) return std::move(record).error();
  const std::lock_guard guard(mutex_);
  if (!clock_) {
    clock_ = std::move(*record);
    clock_fd_ = std::move(answer->fds[0]);
  }
  return clock_;
}

// --- watches

Result<std::uint64_t> Client::add_watch(OnEvent on_event) {
  bool first = false;
  std::uint64_t key = 0;
  {
    const std::lock_guard guard(watch_mutex_);
    key = next_watch_++;
    for (const auto& [name, stream] : known_streams_) {
      on_event(StreamEvent{StreamEvent::Kind::added, stream});
    }
    watches_[key] = std::move(on_event);
    first = !std::exchange(watching_, true);
  }
  if (first) {
    local::Request request;
    request.mutable_watch();
    if (auto done = call(std::move(request)); !done) {
      const std::lock_guard guard(watch_mutex_);
      watching_ = false;
      watches_.erase(key);
      return std::move(done).error();
    }
  }
  return key;
}

void Client::remove_watch(std::uint64_t key) {
  const std::lock_guard guard(watch_mutex_);
  watches_.erase(key);
}

void Client::on_stream_event(const proto::StreamEvent& message) {
  StreamEvent event{message.removed() ? StreamEvent::Kind::removed : StreamEvent::Kind::added,
                    wire::stream_info(message.stream())};
  const std::string name = event.stream.id.str();
  const std::lock_guard guard(watch_mutex_);
  told_before_.erase(name);
  if (message.removed()) {
    if (known_streams_.erase(name) == 0) return;
  } else {
    const auto [entry, is_new] = known_streams_.try_emplace(name, event.stream);
    if (!is_new && entry->second.incarnation == event.stream.incarnation) return;
    entry->second = event.stream;
  }
  for (const auto& [key, on_event] : watches_) on_event(event);
}

void Client::on_replaced(std::uint64_t handle) {
  const std::lock_guard guard(mutex_);
  for (const auto& [key, stream] : open_streams_) {
    if (stream->handle == handle) return stream->supersede();
  }
  // Its open was answered, but the thread that asked has not noted it yet; or it is closed.
  if (replaced_early_.size() < kMaxReplacedEarly) replaced_early_.push_back(handle);
}

// The answer to Watch comes behind the events for the streams that are there: what was not among
// them went while dssmd was away.
void Client::on_rewatched() {
  const std::lock_guard guard(watch_mutex_);
  for (const auto& [name, stream] : std::exchange(told_before_, {})) {
    known_streams_.erase(name);
    StreamEvent event;
    event.kind = StreamEvent::Kind::removed;
    event.stream.id = stream.id;
    for (const auto& [key, on_event] : watches_) on_event(event);
  }
}

// --- the keeper

void Client::start_using(Handshake link) {
  input_ = std::move(link.input);
  for (const std::uint64_t handle : link.replaced) on_replaced(handle);
  bool watching = false;
  {
    const std::lock_guard guard(watch_mutex_);
    watching = watching_;
    told_before_ = known_streams_;
  }
  const std::lock_guard guard(mutex_);
  socket_ = std::move(link.socket);
  ++connection_;
  if (watching) {
    local::Request request;
    rewatch_serial_ = next_serial_++;
    request.set_serial(rewatch_serial_);
    request.mutable_watch();
    if (!send_locked(request, {})) ::shutdown(socket_.get(), SHUT_RDWR);
  }
  changed_.notify_all();
}

void Client::stop_using() {
  const std::lock_guard guard(mutex_);
  socket_.reset();
  replaced_early_.clear();
  for (auto& [serial, in_flight] : in_flight_) {
    if (in_flight.waiter) in_flight.waiter->broken = true;
  }
  in_flight_.clear();
  changed_.notify_all();
}

bool Client::pause(Duration time) const {
  pollfd stop{stop_fd_.get(), POLLIN, 0};
  const timespec timeout = timespec_of(time);
  return ::ppoll(&stop, 1, &timeout, nullptr) <= 0;
}

void Client::keep() {
  for (;;) {
    int socket = -1;
    {
      const std::lock_guard guard(mutex_);
      socket = socket_.get();  // only this thread closes it
    }
    const Result<void> ended = read_connection(socket);
    stop_using();
    if (ended) return;  // told to stop
    for (Duration time = kFirstReconnectPause;; time = std::min(2 * time, kLongestReconnectPause)) {
      auto anew = shake_hands();
      if (anew) {
        start_using(std::move(*anew));
        break;
      }
      if (!pause(time)) return;
    }
  }
}

// Reads until the connection breaks (an error) or the client is being destroyed (success).
Result<void> Client::read_connection(int socket) {
  for (;;) {
    for (;;) {
      auto message = input_.frames.next();
      if (!message) return std::move(message).error();
      if (!*message) break;
      local::Response response;
      if (!response.ParseFromArray((*message)->data(), static_cast<int>((*message)->size()))) {
        return Error{Errc::protocol, "dssmd sent what is no message of the local protocol"};
      }
      if (Result<void> done = dispatch(std::move(response)); !done) return done;
    }
    pollfd ready[] = {{socket, POLLIN, 0}, {stop_fd_.get(), POLLIN, 0}};
    if (::poll(ready, 2, -1) < 0) continue;
    if (ready[1].revents) return {};
    auto received = wire::recv_some(socket, input_.frames.space(), input_.fds);
    if (!received) return std::move(received).error();
    if (received->status == wire::IoStatus::end) return Handshake::silence();
    input_.frames.commit(received->bytes);
  }
}

// Takes the descriptors that belong to this response from the front of those that came.
Result<void> Client::dispatch(local::Response response) {
  if (response.serial() == 0) {
    if (response.has_stream_event()) on_stream_event(response.stream_event());
    if (response.has_replaced()) on_replaced(response.replaced().handle());
    return {};
  }
  std::unique_lock lock(mutex_);
  if (response.serial() == rewatch_serial_) {
    lock.unlock();
    on_rewatched();
    return {};
  }
  const auto entry = in_flight_.find(response.serial());
  if (entry == in_flight_.end()) return {};  // to a Close
  const InFlight in_flight = entry->second;
  in_flight_.erase(entry);
  const std::size_t count = response.has_failure() ? 0 : in_flight.fds;
  std::vector<UniqueFd>& fds = input_.fds;
  if (fds.size() < count) {
    return Error{Errc::protocol, "dssmd sent fewer descriptors than belong to its answer"};
  }
  std::vector<UniqueFd> own(
      std::make_move_iterator(fds.begin()),
      std::make_move_iterator(fds.begin() + static_cast<std::ptrdiff_t>(count)));
  fds.erase(fds.begin(), fds.begin() + static_cast<std::ptrdiff_t>(count));
  if (in_flight.waiter) {
    in_flight.waiter->answer = Answer{std::move(response), std::move(own), connection_};
    changed_.notify_all();
  }
  return {};
}

}  // namespace dssm::detail
