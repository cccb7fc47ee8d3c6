// SPDX-License-Identifier: Apache-2.0
#include "client/src/client.hpp"

#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>

#include "client/src/program_name.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

// Between attempts to reconnect. Shorter than dssmd's recovery_grace (500 ms), during which a
// restarted dssmd keeps names free for the rings that are offered to it.
constexpr Duration kFirstReconnectPause = 10ms;
constexpr Duration kMaxReconnectPause = 200ms;

SessionOptions completed(SessionOptions options) {
  if (options.socket_path.empty()) {
    const char* path =
        std::getenv("DSSM_SOCKET");  // NOLINT(concurrency-mt-unsafe): read once, at connect
    options.socket_path = path && *path ? path : wire::kDefaultSocketPath;
  }
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

}  // namespace

Client::ClockPlace& latest_clock_page() noexcept {
  static Client::ClockPlace place = nullptr;
  return place;
}

OpenStream::~OpenStream() { client->close(*this); }

// --- the connection

Client::Client(SessionOptions options)
    : options_(std::move(options)),
      owner_pid_(::getpid()),
      connection_(options_.socket_path, options_.request_timeout),
      stop_fd_(::eventfd(0, EFD_CLOEXEC)),
      wish_fd_(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {}

Client::~Client() {
  opener_.reset();
  if (executor_) executor_->close();
  if (!thread_.joinable()) return;
  if (::getpid() != owner_pid_) {  // the thread runs in the parent only
    thread_.detach();
    return;
  }
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(stop_fd_.get(), &one, sizeof one);
  thread_.join();
}

Result<std::shared_ptr<Client>> Client::connect(SessionOptions options) {
  auto client = std::make_shared<Client>(completed(std::move(options)));
  if (!client->stop_fd_ || !client->wish_fd_) return os_error("create an eventfd");
  DSSM_TRY(client->set_up());
  client->thread_ =
      DSSM_TRY(quiet_thread("the connection to dssmd", [self = client.get()] { self->run(); }));
  return client;
}

Result<void> Client::set_up() {
  NewConnection connection = DSSM_TRY(NewConnection::greet(options_, ++connections_));
  DSSM_TRY(open_clock_page(connection));
  DSSM_TRY(streams_.offer_all(connection));
  DSSM_TRY(offer_playback_clock(connection));
  connection.fds().clear();
  const std::vector<std::uint64_t> replaced = connection.replaced();
  connection_.use(std::move(connection));
  for (const std::uint64_t handle : replaced) streams_.on_replaced(handle);
  watches_.on_connected();
  streams_.post_wishes(true);
  return {};
}

// Without a page, or with one of another version, nothing is known of the clock; the connection
// works nevertheless.
Result<void> Client::open_clock_page(NewConnection& connection) {
  local::Request request;
  request.mutable_open_clock_page();
  const auto answer = connection.exchange(std::move(request));
  if (!answer && answer.error().code == Errc::unavailable) return answer.error();
  if (!answer || connection.fds().empty()) return {};
  const Result<const clock::ClockPage*> page =
      clock::map_clock_page_untrusted(connection.fds().front().get());
  if (!page) return {};
  clock_page_.store(*page, std::memory_order_release);
  latest_clock_page().store(*page, std::memory_order_release);
  return {};
}

Result<void> Client::offer_playback_clock(NewConnection& connection) {
  int fd = -1;
  {
    const std::lock_guard guard(playback_mutex_);
    fd = playback_fd_.get();  // set once, closed only with the client
  }
  if (fd < 0) return {};
  local::Request request;
  request.mutable_open_clock()->set_offered(true);
  const auto answer = connection.exchange(std::move(request), std::span(&fd, 1));
  if (!answer && answer.error().code == Errc::unavailable) return answer.error();
  return {};
}

bool Client::pause(Duration time) const {
  pollfd stop{stop_fd_.get(), POLLIN, 0};
  const timespec timeout = timespec_of(time);
  return ::ppoll(&stop, 1, &timeout, nullptr) <= 0;
}

void Client::run() {
  const auto on_message = [this](const local::Response& message) {
    if (message.serial() == 0 && message.has_replaced()) {
      streams_.on_replaced(message.replaced().handle());
    } else {
      watches_.on_message(message);
    }
  };
  const auto on_wish = [this] {
    std::uint64_t count = 0;
    [[maybe_unused]] const ssize_t got = ::read(wish_fd_.get(), &count, sizeof count);
    streams_.post_wishes(false);
  };
  for (;;) {
    const Result<void> stopped =
        connection_.read(stop_fd_.get(), on_message, wish_fd_.get(), on_wish);
    connection_.drop();
    if (stopped) return;
    Duration time = kFirstReconnectPause;
    while (!set_up()) {
      if (!pause(time)) return;
      time = std::min(2 * time, kMaxReconnectPause);
    }
  }
}

// --- subscriptions

Result<Opener*> Client::opener() {
  const std::lock_guard guard(subscribing_mutex_);
  if (!opener_) opener_ = DSSM_TRY(Opener::start(*this));
  return opener_.get();
}

Result<std::shared_ptr<ExecutorState>> Client::executor() {
  const std::lock_guard guard(subscribing_mutex_);
  if (executor_) return executor_;
  const auto executor = DSSM_TRY(ExecutorState::create());
  DSSM_TRY(ExecutorState::start(executor));
  return executor_ = executor;
}

void Client::notice(const std::string& text) const {
  if (options_.on_notice) return options_.on_notice(text);
  std::fprintf(stderr, "dssm: %s\n", text.c_str());
}

// --- streams

Result<std::shared_ptr<OpenStream>> Client::open(local::Request request, Role role,
                                                 std::uint32_t tag) {
  const proto::StreamId& name = request.has_create() ? request.create().id() : request.open().id();
  const StreamId requested{name.name(), name.id(), name.host()};
  const FetchHistory history = request.has_open() && request.open().history()
                                   ? FetchHistory::at_once
                                   : FetchHistory::when_read;
  Answer answer = DSSM_TRY(connection_.call(std::move(request)));
  if (!answer.response.has_opened()) {
    return Error{Errc::protocol, "dssmd's answer is not the opened stream"};
  }
  const proto::Opened& opened = answer.response.opened();
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(opened.stream().id()));
  const TypeInfo type = DSSM_TRY(wire::type_untrusted(opened.stream().type()));
  const auto access = role == Role::writer ? ring::Access::read_write : ring::Access::read_only;
  auto ring = rings_.get(std::move(answer.fds), access, opened.created());
  if (ring) {
    auto stream = std::make_shared<OpenStream>(shared_from_this(), requested, id, type, role, tag,
                                               history, *ring);
    DSSM_TRY(streams_.add(*stream, answer));
    if ((*ring)->mapping->geometry().payload_bytes != type.payload_bytes) {
      return Error{Errc::protocol, "the ring's payload size differs from the one dssmd reports"};
    }
    return stream;
  }
  local::Request undo;
  if (opened.created()) {  // there is no memory for its ring, so no program can use it
    wire::to_message(id, *undo.mutable_remove()->mutable_id());
  } else {
    undo.mutable_close()->set_handle(opened.handle());
  }
  [[maybe_unused]] const auto undone = connection_.call(std::move(undo));
  return std::move(ring).error();
}

Result<std::shared_ptr<OpenStream>> Client::open_reader(const StreamId& id, std::uint32_t tag,
                                                        FetchHistory history) {
  local::Request request = open_request(id, false, tag);
  request.mutable_open()->set_history(history == FetchHistory::at_once);
  return open(std::move(request), Role::reader, tag);
}

void Client::want_history(const OpenStream& stream) noexcept {
  if (::getpid() != owner_pid_) return;
  stream.wishes = true;
  stream.wish_is_new = true;
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(wish_fd_.get(), &one, sizeof one);
}

Result<std::shared_ptr<OpenStream>> Client::open_writer(const StreamId& id, std::uint32_t tag) {
  return open(open_request(id, true, tag), Role::writer, tag);
}

void Client::close(const OpenStream& stream) {
  if (::getpid() == owner_pid_) streams_.close(stream);
}

Result<std::shared_ptr<clock::PlaybackRecord>> Client::open_playback_clock() {
  {
    const std::lock_guard guard(playback_mutex_);
    if (playback_) return playback_;
  }
  local::Request request;
  request.mutable_open_clock();
  Answer answer = DSSM_TRY(connection_.call(std::move(request)));
  auto record = DSSM_TRY(clock::PlaybackRecord::open_untrusted(answer.fds[0].get()));
  const std::lock_guard guard(playback_mutex_);
  if (!playback_) {
    playback_ = std::move(record);
    playback_fd_ = std::move(answer.fds[0]);
  }
  return playback_;
}

}  // namespace dssm::detail
