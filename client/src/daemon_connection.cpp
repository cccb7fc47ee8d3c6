// SPDX-License-Identifier: Apache-2.0
#include "client/src/daemon_connection.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <sys/socket.h>

#include "client/src/lockstep.hpp"
#include "core/base/try.hpp"
#include "core/wire/local_protocol.hpp"

namespace dssm::detail {
namespace {

// A local dssmd receives and answers within microseconds; one that does not for so long hangs.
constexpr timeval kSocketTimeout{.tv_sec = 2, .tv_usec = 0};

Error no_answer_error() {
  return Error{Errc::unavailable, "dssmd closed the connection or does not answer"};
}

std::size_t fds_with_answer(const local::Request& request) {
  if (request.has_create()) return 4;
  if (request.has_open()) return request.open().for_writing() ? 4 : 3;
  if (request.has_open_clock() || request.has_open_clock_page()) return 1;
  return 0;
}

// Sends the whole frame. `closed_is_ok`: dssmd's final failure may be there to be read.
Result<void> send_frame(int socket, const local::Request& request, std::span<const int> fds,
                        bool closed_is_ok) {
  const std::string frame = wire::encode_frame(request);
  auto rest = std::as_bytes(std::span(frame));
  while (!rest.empty()) {
    const auto sent = DSSM_TRY(wire::send_some(socket, rest, fds));
    if (closed_is_ok && sent.status == wire::IoStatus::end) break;
    if (sent.status != wire::IoStatus::ok) return no_answer_error();
    rest = rest.subspan(sent.bytes);
    fds = {};
  }
  return {};
}

// The next message in `input`; empty: more bytes are needed.
Result<std::optional<local::Response>> next_message(LocalInput& input) {
  const auto message = DSSM_TRY(input.frames.next());
  if (!message) return std::optional<local::Response>();
  local::Response response;
  if (!response.ParseFromArray(message->data(), static_cast<int>(message->size()))) {
    return Error{Errc::protocol, "dssmd sent something other than a message of the local protocol"};
  }
  return std::optional<local::Response>(std::move(response));
}

}  // namespace

// --- setting up

Result<NewConnection> NewConnection::greet(const SessionOptions& options, std::uint64_t number) {
  UniqueFd socket = DSSM_TRY(wire::connect_unix(options.socket_path));
  ::setsockopt(socket.get(), SOL_SOCKET, SO_SNDTIMEO, &kSocketTimeout, sizeof kSocketTimeout);
  timeval patience = kSocketTimeout;
  // The program waits for the first connection itself, as for a request.
  if (number == 1) {
    const auto wanted = std::chrono::ceil<std::chrono::seconds>(options.request_timeout).count();
    patience.tv_sec = std::max<time_t>(patience.tv_sec, wanted);
  }
  ::setsockopt(socket.get(), SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
  NewConnection connection(std::move(socket), number);
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  hello.mutable_hello()->set_program(options.program);
  hello.mutable_hello()->set_version(DSSM_VERSION);
  const local::Response answer = DSSM_TRY(connection.exchange(std::move(hello)),
                                          fmt::format("greet dssmd at '{}'", options.socket_path));
  if (!answer.has_hello() || answer.hello().protocol_version() != wire::kLocalProtocolVersion) {
    return wire::other_protocol_version(
        {"local", wire::kLocalProtocolVersion}, fmt::format("dssmd at '{}'", options.socket_path),
        answer.hello().protocol_version(), answer.hello().version());
  }
  return connection;
}

Result<local::Response> NewConnection::exchange(local::Request request,
                                                std::span<const int> request_fds) {
  const Lockstep::Request in_lockstep;
  input_.fds.clear();
  request.set_serial(++serial_);
  DSSM_TRY(send_frame(socket_.get(), request, request_fds, true));
  for (;;) {
    auto message = DSSM_TRY(next_message(input_));
    if (!message) {
      const auto received =
          DSSM_TRY(wire::recv_some(socket_.get(), input_.frames.space(), input_.fds));
      if (received.status != wire::IoStatus::ok) return no_answer_error();
      input_.frames.commit(received.bytes);
      continue;
    }
    const bool is_answer = message->serial() == serial_;
    if (message->has_failure() && (is_answer || message->serial() == 0)) {
      return wire::failure(message->failure());  // serial 0: dssmd's final failure
    }
    if (is_answer) return *std::move(message);
    if (message->has_replaced()) replaced_.push_back(message->replaced().handle());
  }
}

// --- in use

void DaemonConnection::use(NewConnection connection) {
  input_ = std::move(connection.input_);
  const std::lock_guard guard(mutex_);
  socket_ = std::move(connection.socket_);
  number_ = connection.number_;
  changed_.notify_all();
}

void DaemonConnection::drop() {
  const std::lock_guard guard(mutex_);
  socket_.reset();
  for (auto& [serial, in_flight] : in_flight_) {
    if (in_flight.waiter) in_flight.waiter->dropped = true;
  }
  in_flight_.clear();
  changed_.notify_all();
}

bool DaemonConnection::is_up() const {
  const std::lock_guard guard(mutex_);
  return static_cast<bool>(socket_);
}

Result<Answer> DaemonConnection::call(local::Request request, std::span<const int> fds) {
  const Lockstep::Request in_lockstep;
  const std::size_t fds_expected = fds_with_answer(request);
  const MonoTime deadline = deadline_in(request_timeout_);
  const auto timed_out = [&](const char* reason) {
    return Error{Errc::unavailable,
                 fmt::format("dssmd at '{}' {}; check `systemctl status dssmd`, then try again",
                             socket_path_, reason)};
  };
  std::unique_lock lock(mutex_);
  for (;;) {
    if (!changed_.wait_until(lock, deadline, [&] { return static_cast<bool>(socket_); })) {
      return timed_out("is unavailable");
    }
    Waiter waiter;
    const std::uint64_t serial = next_serial_++;
    request.set_serial(serial);
    in_flight_[serial] = {&waiter, fds_expected};
    // On failure the thread that reads ends this connection and sets up another one.
    if (!send_locked(request, fds)) ::shutdown(socket_.get(), SHUT_RDWR);
    const bool in_time = changed_.wait_until(
        lock, deadline, [&] { return waiter.answer.has_value() || waiter.dropped; });
    if (waiter.answer) {
      if (waiter.answer->response.has_failure()) {
        return wire::failure(waiter.answer->response.failure());
      }
      return std::move(*waiter.answer);
    }
    if (!in_time) {
      in_flight_[serial].waiter = nullptr;
      return timed_out("does not answer");
    }
  }
}

std::uint64_t DaemonConnection::post(local::Request request, std::uint64_t number) {
  const std::lock_guard guard(mutex_);
  if (!socket_ || (number != 0 && number != number_)) return 0;
  const std::uint64_t serial = next_serial_++;
  request.set_serial(serial);
  if (!send_locked(request, {})) ::shutdown(socket_.get(), SHUT_RDWR);
  return serial;
}

Result<void> DaemonConnection::send_locked(const local::Request& request,
                                           std::span<const int> fds) {
  return send_frame(socket_.get(), request, fds, false);
}

Result<void> DaemonConnection::read(int stop_fd,
                                    const std::function<void(const local::Response&)>& on_message,
                                    int wake_fd, const std::function<void()>& on_wake) {
  int socket = -1;
  {
    const std::lock_guard guard(mutex_);
    socket = socket_.get();  // only this thread closes it
  }
  for (;;) {
    for (;;) {
      auto message = DSSM_TRY(next_message(input_));
      if (!message) break;
      const bool delivered = DSSM_TRY(deliver(*message));
      if (!delivered) on_message(*message);
    }
    pollfd ready[] = {{socket, POLLIN, 0}, {stop_fd, POLLIN, 0}, {wake_fd, POLLIN, 0}};
    if (::poll(ready, 3, -1) < 0) continue;
    if (ready[1].revents) return {};
    if (ready[2].revents) on_wake();
    if (!ready[0].revents) continue;
    const auto received = DSSM_TRY(wire::recv_some(socket, input_.frames.space(), input_.fds));
    if (received.status == wire::IoStatus::end) return no_answer_error();
    input_.frames.commit(received.bytes);
  }
}

Result<bool> DaemonConnection::deliver(local::Response& response) {
  const std::lock_guard guard(mutex_);
  const auto entry = in_flight_.find(response.serial());
  if (entry == in_flight_.end()) return false;
  const InFlight in_flight = entry->second;
  in_flight_.erase(entry);
  std::vector<UniqueFd> fds = DSSM_TRY(take_fds(response.has_failure() ? 0 : in_flight.fds));
  if (in_flight.waiter) {
    in_flight.waiter->answer = Answer{std::move(response), std::move(fds), number_};
    changed_.notify_all();
  } else if (response.has_opened()) {
    // Too late: nobody would close what dssmd has opened.
    local::Request close;
    close.set_serial(next_serial_++);
    close.mutable_close()->set_handle(response.opened().handle());
    DSSM_TRY(send_locked(close, {}));
  }
  return true;
}

Result<std::vector<UniqueFd>> DaemonConnection::take_fds(std::size_t count) {
  std::vector<UniqueFd>& fds = input_.fds;
  if (fds.size() < count) {
    return Error{Errc::protocol, "dssmd sent fewer descriptors than belong to its answer"};
  }
  const auto end = fds.begin() + static_cast<std::ptrdiff_t>(count);
  std::vector<UniqueFd> taken(std::make_move_iterator(fds.begin()), std::make_move_iterator(end));
  fds.erase(fds.begin(), end);
  return taken;
}

}  // namespace dssm::detail
