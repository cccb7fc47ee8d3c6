// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/connection.hpp"

#include <fmt/format.h>

#include <utility>

#include "core/wire/fd_socket.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {

Connection::Connection(const EventLoop& loop, UniqueFd socket, const Identity& identity,
                       LocalService& service, Logger& logger, std::function<void()> on_closed)
    : socket_(std::move(socket)),
      service_(service),
      logger_(logger),
      on_closed_(std::move(on_closed)),
      number_(service.connect(identity, *this)),
      input_(wire::kMaxLocalFrameBytes),
      readable_(EventSource::readable(loop, socket_.get(), [this] { on_readable(); })),
      writable_(EventSource::writable(loop, socket_.get(), [this] { on_writable(); })),
      next_turn_(EventSource::timer(loop, [this] { serve_frames(); })) {
  readable_.enable();
}

Connection::~Connection() {
  if (is_open()) service_.disconnect(number_);
}

void Connection::on_readable() {
  std::vector<UniqueFd> descriptors;
  const Result<wire::IoResult> got = wire::recv_some(socket_.get(), input_.space(), descriptors);
  if (!got) return end_with(got.error());
  if (got->status == wire::IoStatus::would_block) return;
  if (got->status == wire::IoStatus::end) return close();
  input_.commit(got->bytes);
  if (take_descriptors(std::move(descriptors))) serve_frames();
}

bool Connection::take_descriptors(std::vector<UniqueFd> arrived) {
  if (arrived.empty()) return true;
  std::size_t unclaimed = arrived.size();
  for (const std::vector<UniqueFd>& some : arrived_) unclaimed += some.size();
  if (unclaimed > kMaxUnclaimedDescriptors) {
    end_with({Errc::protocol, fmt::format("more than {} descriptors came that no request takes",
                                          kMaxUnclaimedDescriptors)});
    return false;
  }
  arrived_.push_back(std::move(arrived));
  return true;
}

void Connection::serve_frames() {
  for (int served = 0; is_open() && !is_paused(); ++served) {
    if (served == kRequestsPerTurn) {
      readable_.disable();
      return next_turn_.enable_in(Duration::zero());
    }
    const auto frame = input_.next();
    if (!frame) return end_with(frame.error());
    if (!*frame) {
      readable_.enable();
      return;
    }
    if (!service_.on_frame_untrusted(number_, **frame, arrived_)) return close();
  }
  if (is_open()) readable_.disable();  // paused: on_writable() continues
}

void Connection::send(const std::string& frame, std::vector<UniqueFd> descriptors) {
  if (!is_open()) return;
  Outgoing outgoing{frame, 0, std::move(descriptors)};
  if (output_.empty()) {
    if (!send_some(outgoing)) return;
    if (outgoing.sent == outgoing.frame.size()) return;
    writable_.enable();
  }
  queued_bytes_ += outgoing.frame.size();
  queued_descriptors_ += outgoing.descriptors.size();
  output_.push_back(std::move(outgoing));
  if (queued_bytes_ <= kMaxQueuedBytes) return;
  logger_.warning(
      fmt::format("close a connection: the program does not read, and {} bytes wait for it",
                  queued_bytes_),
      {.message_id = message_id::kClientRefused});
  close();
}

// False when the connection ended over it.
bool Connection::send_some(Outgoing& outgoing) {
  std::vector<int> fds;
  for (const UniqueFd& fd : outgoing.descriptors) fds.push_back(fd.get());
  const auto rest = std::as_bytes(std::span(outgoing.frame)).subspan(outgoing.sent);
  const Result<wire::IoResult> sent = wire::send_some(socket_.get(), rest, fds);
  if (!sent || sent->status == wire::IoStatus::end) {
    if (!sent) logger_.warning("close a connection: " + sent.error().message);
    close();
    return false;
  }
  outgoing.sent += sent->bytes;
  if (sent->bytes > 0) outgoing.descriptors.clear();  // they went with the first byte
  return true;
}

void Connection::on_writable() {
  while (!output_.empty()) {
    Outgoing& next = output_.front();
    const std::size_t descriptors = next.descriptors.size();
    if (!send_some(next)) return;
    queued_descriptors_ -= descriptors - next.descriptors.size();
    if (next.sent < next.frame.size()) break;
    queued_bytes_ -= next.frame.size();
    output_.pop_front();
  }
  if (output_.empty()) writable_.disable();
  // Whole frames may be waiting in input_; for them the socket does not become readable.
  if (!is_paused()) next_turn_.enable_in(Duration::zero());
}

// The final failure is sent as far as the socket takes it at once; the connection does not wait for
// a client that does not read.
void Connection::end_with(const Error& error) {
  logger_.warning("close a connection: " + error.message,
                  {.message_id = message_id::kClientRefused});
  send(wire::final_failure(error), {});
  close();
}

void Connection::close() {
  if (!is_open()) return;
  readable_.disable();
  writable_.disable();
  next_turn_.disable();
  socket_.reset();
  output_.clear();
  arrived_.clear();
  service_.disconnect(number_);
  on_closed_();
}

}  // namespace dssm::daemon
