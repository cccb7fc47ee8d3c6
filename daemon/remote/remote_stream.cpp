// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/remote_stream.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <iterator>
#include <utility>

#include "core/base/try.hpp"
#include "daemon/base/memory_budget.hpp"

namespace dssm::daemon {

// --- the connection to the owner

OwnerConnection::OwnerConnection(const ChannelParts& parts, const std::string& stream,
                                 Dialer::Observer& observer)
    : parts_(parts),
      stream_(stream),
      observer_(observer),
      retry_timer_(EventSource::timer(parts.loop, [this] { reopen(); })) {}

void OwnerConnection::connect(const KnownHost& host) {
  owner_ = host.greeting.host_id;
  if (!dialer_) {
    address_ = host.address;
    dialer_.reset(new Dialer(parts_.loop, parts_.resolver,
                             {{address_}, parts_.self, parts_.handshakes}, *this));
    return;
  }
  if (address_ != host.address) {
    address_ = host.address;
    dialer_->set_addresses({address_});
    dialer_->restart({Errc::unavailable, host.str() + " has another address now"});
  }
  dialer_->retry_now();
}

void OwnerConnection::on_owner_down(const Error& why) {
  if (dialer_) dialer_->stop(why);
}

void OwnerConnection::reopen() {
  retry_timer_.disable();
  if (!dialer_) return;
  if (dialer_->connection()) {
    reopening_ = true;
    dialer_->restart({Errc::closed, "stream '" + stream_ + "' is about to be reopened"});
  }
  dialer_->retry_now();
}

void OwnerConnection::on_up(FrameConnection& connection, const wire::Greeting& them) {
  if (them.host_id == *owner_) return observer_.on_up(connection, them);
  dialer_->restart(
      {Errc::conflict, fmt::format("{} answers at '{}', which is not the owner of stream '{}'",
                                   them.str(), address_.str(), stream_)});
}

void OwnerConnection::on_down(const Error& why) {
  retry_timer_.disable();
  observer_.on_down(why);
  reopening_ = false;
}

// --- the channel

void RemoteStream::end_channel() {
  channel_.reset();
  stated_users_.Clear();
  users_serial_ = 0;
  on_channel_end();
}

// One at a time, so that a program that opens and closes without end costs one frame a round trip.
void RemoteStream::send_users() {
  const std::shared_ptr<Stream> ring = stream();
  const bool is_open = channel_.stream() == channel::ChannelClient::Stream::open;
  if (!wants_users_ || !is_open || !ring || users_serial_ != 0) return;
  net::Frame frame;
  net::SetUsers& request = *frame.mutable_set_users();
  for (const StreamUser& user : parts_.opens->users(*ring)) {
    const bool writes = user.role == Role::writer;
    writes ? request.set_writers(request.writers() + 1)
           : request.set_readers(request.readers() + 1);
    if (static_cast<std::size_t>(request.users_size()) == wire::kMaxChannelUsers) continue;
    wire::to_message(user, *request.add_users());
  }
  if (request.SerializeAsString() == stated_users_.SerializeAsString()) return;
  stated_users_ = request;
  users_serial_ = channel_.next_serial();
  frame.set_serial(users_serial_);
  send(frame);
}

void RemoteStream::on_down(const Error& why) {
  end_channel();
  if (connection_.is_reopening()) return;
  last_error_ = why;
  if (!is_removed_) log_stopped();
}

Result<void> RemoteStream::on_ended(const Error& why) {
  stop(why, true);
  return {};
}

// After stop() late answers may come.
Result<void> RemoteStream::on_other_frame(net::Frame& frame) {
  if (frame.serial() != 0 && frame.serial() == users_serial_) {
    users_serial_ = 0;
    wants_users_ = !frame.has_failure();
    begin_users();  // others may use it by now
    return {};
  }
  const bool is_in_use = channel_.stream() != channel::ChannelClient::Stream::closed;
  if (frame.serial() == 0 || !is_in_use) return {};
  return channel::ChannelClient::unexpected("an answer that was not asked for");
}

void RemoteStream::stop(const Error& why, bool removed) {
  end_channel();
  is_removed_ = removed;
  last_error_ = why;
  log_stopped();
  stream() && !removed ? answer_pending(false) : fail_pending(why);
  connection_.reopen_later();
}

// --- programs

RemoteStream::RemoteStream(const ChannelParts& parts, Kind kind, StreamId id, RingQuota quota,
                           std::function<void()> on_done)
    : parts_(parts),
      id_(std::move(id)),
      name_(id_.str()),
      kind_(kind),
      quota_(std::move(quota)),
      on_done_(std::move(on_done)),
      pending_timer_(EventSource::timer(parts.loop, [this] { on_pending_timer(); })),
      users_timer_(EventSource::timer(parts.loop, [this] { send_users(); })),
      use_count_([this] {
        users_timer_.enable_in(Duration::zero());
        if (use_count_.in_use()) return;
        unused_since_ = parts_.loop.now();
        on_unused();
      }),
      connection_(parts, name_, *this) {}

std::shared_ptr<Stream> RemoteStream::acquire() {
  const std::shared_ptr<Stream> ring = stream();
  if (!ring) return nullptr;
  done_ = false;
  return use_count_.acquire(ring);
}

Result<OpenedRing> RemoteStream::opened(const CreatePlan* plan) {
  DSSM_TRY(check_open(plan));
  return OpenedRing{acquire(), false};
}

void RemoteStream::open(const CreatePlan* plan, Then then, bool waits_for_history) {
  done_ = false;
  if (can_open_now(waits_for_history)) {
    then(opened(plan));
    return after_pending();
  }
  pending_.push_back({std::move(then), plan ? std::optional(*plan) : std::nullopt,
                      parts_.loop.deadline_in(open_timeout()), waits_for_history});
  arm_pending_timer();
  if (is_removed_) connection_.reopen();
}

Result<std::shared_ptr<Stream>> RemoteStream::adopt_untrusted(OfferedFiles&& files) {
  const std::string context = "stream '" + name_ + "'";
  const bool may_create = files.may_create;
  if (const std::shared_ptr<Stream> ring = stream()) {
    if (!ring->is_ring(files.ring.get())) {
      return Error{Errc::conflict, context + " has another ring here now; close it and reopen it"};
    }
    ring->take_doorbell_untrusted(files.client, std::move(files.doorbell));
    if (may_create) allow_create();
    return acquire();
  }
  std::shared_ptr<Stream> offered =
      DSSM_TRY(Stream::adopt_untrusted(std::move(files), parts_.registry.budgets()), context);
  if (offered->id() != id_ || offered->purpose() != kind_.purpose) {
    return Error{Errc::protocol, fmt::format("{}: the offered ring belongs to '{}', or has "
                                             "another purpose",
                                             context, offered->id().str())};
  }
  DSSM_TRY(use_offered(std::move(offered)), context);
  if (may_create) allow_create();
  return acquire();
}

void RemoteStream::on_stream_added(const StreamInfo&) {
  if (is_removed_) connection_.reopen();
}

const std::optional<CreatePlan>* RemoteStream::first_pending() const noexcept {
  return pending_.empty() ? nullptr : &pending_.front().plan;
}

void RemoteStream::set_pending_deadline(MonoTime deadline) {
  for (PendingOpen& one : pending_) one.deadline = deadline;
  arm_pending_timer();
}

void RemoteStream::answer_pending(bool created) {
  if (pending_.empty()) return;
  for (const PendingOpen& one : std::exchange(pending_, {})) {
    answer_with(one.then, [&] {
      Result<OpenedRing> ring = opened(one.plan ? &*one.plan : nullptr);
      if (ring) ring->created = std::exchange(created, false);
      return ring;
    });
  }
  after_pending();
}

template <typename Condition>
std::vector<RemoteStream::PendingOpen> RemoteStream::take_pending(Condition condition) {
  const auto rest = std::stable_partition(pending_.begin(), pending_.end(), condition);
  std::vector<PendingOpen> taken(std::make_move_iterator(pending_.begin()),
                                 std::make_move_iterator(rest));
  pending_.erase(pending_.begin(), rest);
  return taken;
}

void RemoteStream::answer_ready() {
  const std::vector<PendingOpen> ready =
      take_pending([this](const PendingOpen& one) { return can_open_now(one.waits_for_history); });
  if (ready.empty()) return;
  for (const PendingOpen& one : ready) {
    answer_with(one.then, [&] { return opened(one.plan ? &*one.plan : nullptr); });
  }
  after_pending();
}

void RemoteStream::fail_pending(const Error& why) {
  if (pending_.empty()) return;
  for (const PendingOpen& one : std::exchange(pending_, {})) {
    answer_with(one.then, [&]() -> Result<OpenedRing> { return why; });
  }
  after_pending();
}

void RemoteStream::fail_first_pending(const Error& why) {
  const PendingOpen first = std::move(pending_.front());
  pending_.erase(pending_.begin());
  answer_with(first.then, [&]() -> Result<OpenedRing> { return why; });
  after_pending();
}

// Programs have got an answer, perhaps not the ring.
void RemoteStream::after_pending() {
  arm_pending_timer();
  if (!is_unused()) return;
  stream() ? on_unused() : finish();
}

void RemoteStream::finish() {
  done_ = true;
  on_done_();
}

void RemoteStream::arm_pending_timer() {
  if (pending_.empty()) return pending_timer_.disable();
  MonoTime first = kNever;
  for (const PendingOpen& one : pending_) first = std::min(first, one.deadline);
  pending_timer_.enable_in(std::max(first - parts_.loop.now(), Duration::zero()));
}

// A mirror that is being filled is handed out with what it holds.
void RemoteStream::on_pending_timer() {
  const MonoTime now = parts_.loop.now();
  const std::vector<PendingOpen> overdue =
      take_pending([now](const PendingOpen& one) { return one.deadline <= now; });
  for (const PendingOpen& one : overdue) {
    answer_with(one.then, [&]() -> Result<OpenedRing> {
      if (stream() && !is_removed_) return opened(one.plan ? &*one.plan : nullptr);
      return Error{Errc::unavailable,
                   fmt::format("stream '{}': host '{}' does not answer at '{}'{}; see `dssmctl "
                               "hosts`, and retry",
                               name_, id_.host, connection_.address().str(),
                               last_error_ ? ": " + last_error_->message : "")};
    });
  }
  after_pending();
}

// --- the log

LogFields RemoteStream::log_fields() const {
  return {.stream = name_, .peer = id_.host, .message_id = kind_.message_id};
}

// Why the stream is not live, once until clear_error().
void RemoteStream::log_stopped() {
  if (!stream() || std::exchange(error_logged_, true)) return;
  parts_.logger.notice(
      fmt::format("{}: {}; retrying", fmt::format(kind_.stopped, name_), last_error_->message),
      log_fields());
}

bool RemoteStream::clear_error() {
  last_error_.reset();
  return std::exchange(error_logged_, false);
}

void RemoteStream::log_gap(std::uint64_t samples, std::string_view reason) {
  gap_samples_ += samples;
  const auto unlogged = gap_lines_.admit(parts_.loop.now(), samples);
  if (!unlogged) return;
  parts_.logger.warning(fmt::format("stream '{}' lacks {} samples, {} in all: {}", name_, *unlogged,
                                    gap_samples_, reason.empty() ? kind_.gap_reason : reason),
                        log_fields());
}

}  // namespace dssm::daemon
