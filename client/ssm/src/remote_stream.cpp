// SPDX-License-Identifier: Apache-2.0
#include "remote_stream.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <cstring>
#include <mutex>

#include "interruptible.hpp"
#include "messages.hpp"
#include "socket_path.hpp"
#include "stream_arguments.hpp"
#include "tid_convert.hpp"
#include "time_convert.hpp"

namespace dssm::ssm {
namespace {

using namespace std::chrono_literals;

// How long one call tries: Ctrl-C is seen after it. More for samples that take long to come.
constexpr Duration kCallTimeout = 2s;
constexpr std::uint64_t kSlowestBytesPerSecond = 4'000'000;

constexpr Duration kRetryPause = 200ms;

// Programs of the oldest kind ask for "512" and mean samples, where it now means seconds: what is
// collected must not take the machine's memory away.
constexpr std::uint64_t kMaxCollectedBytes = 512U << 20;

// When connecting and opening give up: $DSSM_CONNECT_TIMEOUT [s] from now, else never.
MonoTime give_up_at() {
  const std::string text = environment("DSSM_CONNECT_TIMEOUT");
  double seconds = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), seconds);
  if (text.empty() || error != std::errc{} || end != text.data() + text.size()) return kNever;
  return deadline_in(Duration(std::max<std::int64_t>(0, ns_from_seconds(seconds))));
}

// Tries until it works, fails for good, is interrupted, or is given up. What is wrong is said once.
template <class Try>
auto retry(const std::string& what, Try attempt) -> decltype(attempt()) {
  const MonoTime give_up = give_up_at();
  Interruptible signals;
  std::string said;
  for (;;) {
    auto result = attempt();
    if (result || !is_retryable(result.error().code)) return result;
    if (MonoClock::now() >= give_up) return result;
    if (result.error().message != said) {
      said = result.error().message;
      report_error(std::string(what).append(" : ").append(said).append("; trying again"));
    }
    if (!signals.pause(std::min(kRetryPause, give_up - MonoClock::now()))) {
      return Error{Errc::closed, "interrupted by a signal"};
    }
  }
}

SSM_tid error_of(ReadStatus status, RemoteStream::Which which) noexcept {
  if (status != ReadStatus::not_yet) return SSM_ERROR_PAST;
  return which == RemoteStream::Which::tid || which == RemoteStream::Which::next
             ? SSM_ERROR_FUTURE
             : SSM_ERROR_NO_DATA;
}

}  // namespace

// One call inside the object; false when this thread is inside already. Over the network: inside
// any such object, because they share what a thread receives into.
class RemoteStream::Call {
 public:
  enum class Way : bool { network, memory };

  explicit Call(RemoteStream& stream, Way way = Way::network) noexcept
      : stream_(stream), way_(way) {
    stream_.lock_.lock();
    allowed_ = !stream_.inside_ && (way == Way::memory || !on_network);
    if (!allowed_) return;
    stream_.inside_ = true;
    if (way == Way::network) on_network = true;
  }
  Call(const Call&) = delete;
  Call& operator=(const Call&) = delete;
  ~Call() {
    if (allowed_) stream_.inside_ = false;
    if (allowed_ && way_ == Way::network) on_network = false;
    stream_.lock_.unlock();
  }
  explicit operator bool() const noexcept { return allowed_; }
  // Whether besides there is an open stream to work with.
  bool has_stream() const noexcept {
    return allowed_ && stream_.open_.load() && stream_.connector_.has_value();
  }

 private:
  static thread_local bool on_network;
  RemoteStream& stream_;
  const Way way_;
  bool allowed_ = false;
};
thread_local bool RemoteStream::Call::on_network = false;

// --- connecting, creating, opening

PConnectorOptions RemoteStream::options(const std::string& address,
                                        std::uint64_t payload_bytes) const {
  PConnectorOptions options;
  options.address = address;
  options.request_timeout =
      kCallTimeout + std::chrono::seconds(payload_bytes / kSlowestBytesPerSecond);
  return options;
}

std::string RemoteStream::quoted_name() const {
  return quoted(connector_->id().name, connector_->id().id);
}

void RemoteStream::complain(const Error& error) {
  if (error.message == complaint_) return remember_error(error.message);
  complaint_ = error.message;
  report_error(error.message);
}

bool RemoteStream::connect(const std::string& address) {
  const Call call(*this);
  if (!call) return false;
  const std::string what = "connect to '" + address + "'";
  const auto listed = retry(what, [&] { return PConnector::list_streams(options(address, 0)); });
  if (!listed) report_error(what + " : " + listed.error().message);
  return listed.has_value();
}

bool RemoteStream::take(Result<PConnector> opened, const std::string& what) {
  collector_.reset();
  connector_.reset();
  if (!opened) {
    report_error(what + " : " + opened.error().message);
    return false;
  }
  connector_ = std::move(*opened);
  sample_.resize(connector_->payload_bytes());
  offset_ = 0;
  seen_ = kNoTid;
  restarts_ = 0;
  complaint_.clear();
  open_.store(true);
  return true;
}

bool RemoteStream::create(const std::string& address, const StreamId& id, const TypeInfo& type,
                          const History& history) {
  const Call call(*this);
  if (!call) return false;
  open_.store(false);
  address_ = address;
  return take(PConnector::create(id, type, history, options(address, type.payload_bytes)),
              "create " + quoted(id.name, id.id));
}

bool RemoteStream::open(const std::string& address, const StreamId& id, std::size_t data_bytes) {
  const Call call(*this);
  if (!call) return false;
  open_.store(false);
  address_ = address;
  const std::string what = "open " + quoted(id.name, id.id);
  auto opened = retry(what, [&]() -> Result<PConnector> {
    auto connector = PConnector::open(id, options(address, data_bytes));
    if (connector && connector->payload_bytes() != data_bytes) {
      return Error{Errc::type_mismatch,
                   "the stream has " + std::to_string(connector->payload_bytes()) +
                       " bytes per sample, this program's type " + std::to_string(data_bytes) +
                       " : use the type that it was created with"};
    }
    return connector;
  });
  return take(std::move(opened), what);
}

// --- reading over the network

// After a restart of the stream, tids continue after the last one that the program got.
void RemoteStream::follow_restart() {
  if (connector_->restarts() == restarts_) return;
  restarts_ = connector_->restarts();
  offset_ = seen_ + 1;
}

template <class Ask>
ReadStatus RemoteStream::fetch_by(Ask ask, SampleInfo& info) {
  for (;;) {
    Result<ReadStatus> status = ask(*connector_);
    follow_restart();
    if (!status) {
      complain(status.error());
      return ReadStatus::not_yet;
    }
    complaint_.clear();
    if (*status == ReadStatus::restarted) continue;
    if (*status == ReadStatus::ok) {
      info.tid += offset_;
      seen_ = std::max(seen_, info.tid);
    }
    return *status;
  }
}

ReadStatus RemoteStream::fetch(Tid tid, SampleInfo& info) {
  return fetch_by([&](PConnector& from) { return from.read_tid(tid - offset_, sample_, info); },
                  info);
}

Tid RemoteStream::ask_newest() {
  const auto newest = connector_->newest_tid();
  follow_restart();
  if (!newest) return complain(newest.error()), kNoTid;
  complaint_.clear();
  const Tid tid = *newest + offset_;  // of a new ring that is empty: the last one of the old
  seen_ = std::max(seen_, tid);
  return tid;
}

Tid RemoteStream::ask_oldest() {
  const auto oldest = connector_->oldest_tid();
  follow_restart();
  if (!oldest) return complain(oldest.error()), kNoTid;
  complaint_.clear();
  return *oldest < 0 ? offset_ - 1 : *oldest + offset_;
}

// The 64-bit tid that a program means.
Tid RemoteStream::ring_tid_of(SSM_tid tid) {
  if (seen_ < 0) seen_ = ask_newest();
  return ring_tid(tid, seen_);
}

SSM_tid RemoteStream::hand_over(const SampleInfo& info, void* data, double* time) {
  std::memcpy(data, sample_.data(), sample_.size());
  if (time) *time = seconds_from_time(info.time);
  return ssm_tid(info.tid);
}

SSM_tid RemoteStream::read(const Request& request, void* data, std::size_t bytes, double* time) {
  const Call call(*this);
  if (!call.has_stream()) return SSM_ERROR_NO_DATA;
  if (bytes != sample_.size()) {
    complain({Errc::type_mismatch, "read " + quoted_name() + " : its samples have " +
                                       std::to_string(sample_.size()) +
                                       " bytes, this program's type " + std::to_string(bytes)});
    return SSM_ERROR_NO_DATA;
  }
  SampleInfo info;
  ReadStatus status = ReadStatus::not_yet;
  const auto newest = [&](PConnector& from) { return from.read_newest(sample_, info); };
  switch (request.which) {
    case Which::newest:
      status = fetch_by(newest, info);
      break;
    case Which::tid:
      status = fetch(ring_tid_of(request.tid), info);
      break;
    case Which::newer: {
      const Tid than = request.tid < 0 ? kNoTid : ring_tid_of(request.tid);
      status = fetch_by(
          [&](PConnector& from) {
            return from.read_newer(std::max(than - offset_, kNoTid), sample_, info);
          },
          info);
      break;
    }
    case Which::next: {
      if (request.tid < 0) {
        status = fetch_by(newest, info);
        break;
      }
      const Tid target = ring_tid_of(request.tid) + request.dt;
      status = fetch(target, info);
      // Again when a fast writer overtakes us between asking and reading.
      for (int attempt = 0; attempt < 100 && status == ReadStatus::too_old; ++attempt) {
        const Tid oldest = ask_oldest();
        if (oldest <= target) break;
        status = fetch(oldest, info);
        if (status == ReadStatus::ok) {
          report_error("readNext : skipping " + quoted_name() +
                       " TID: " + std::to_string(ssm_tid(target)) + " -> " +
                       std::to_string(ssm_tid(info.tid)));
        }
      }
      break;
    }
    case Which::at:
      status = request.time > 0
                   ? fetch_by(
                         [&](PConnector& from) {
                           return from.read_at(time_from_seconds(request.time), sample_, info);
                         },
                         info)
                   : fetch_by(newest, info);
      break;
  }
  if (status != ReadStatus::ok) return error_of(status, request.which);
  return hand_over(info, data, time);
}

SSM_tid RemoteStream::top() {
  const Call call(*this);
  return call.has_stream() ? ssm_tid(ask_newest()) : -1;
}

SSM_tid RemoteStream::bottom() {
  const Call call(*this);
  return call.has_stream() ? ssm_tid(ask_oldest()) : -1;
}

bool RemoteStream::is_newer(SSM_tid tid) {
  const Call call(*this);
  if (!call.has_stream()) return false;
  const Tid newest = ask_newest();
  return newest >= 0 && (tid < 0 || newest > ring_tid(tid, newest));
}

SSM_tid RemoteStream::tid_at(double time) {
  const Call call(*this);
  if (!call.has_stream()) return -1;
  // Strictly before, as getTID() has it: at most one nanosecond less.
  const Time t = time_from_seconds(time);
  const auto found = connector_->find(t > Time::min() ? t - Duration(1) : t);
  follow_restart();
  if (!found) return complain(found.error()), SSM_ERROR_NO_DATA;
  if (*found >= 0) {
    seen_ = std::max(seen_, *found + offset_);
    return ssm_tid(*found + offset_);
  }
  return ask_newest() < 0 ? SSM_ERROR_NO_DATA : SSM_ERROR_PAST;
}

// --- writing and properties

bool RemoteStream::write(const void* data, std::size_t bytes, double time) {
  const Call call(*this);
  if (!call.has_stream()) return false;
  const auto posted =
      connector_->post({static_cast<const std::byte*>(data), bytes}, time_from_seconds(time));
  if (!posted) return complain(posted.error()), false;
  if (connector_->is_connected()) {
    complaint_.clear();
  } else {
    complain({Errc::unavailable, "write " + quoted_name() + " : '" + address_ +
                                     "' is away; the newest samples are kept and sent later"});
  }
  return true;
}

bool RemoteStream::set_property(const void* data, std::size_t bytes) {
  const Call call(*this);
  if (!call.has_stream()) return false;
  const auto set = connector_->set_property({static_cast<const std::byte*>(data), bytes});
  if (!set) complain(set.error());
  return set.has_value();
}

bool RemoteStream::get_property(void* data, std::size_t bytes) {
  const Call call(*this);
  if (!call.has_stream()) return false;
  const auto property = connector_->property();
  if (!property) {
    if (property.error().code == Errc::not_found) {
      remember_error(property.error().message);
    } else {
      complain(property.error());
    }
    return false;
  }
  if (property->size() != bytes) {
    report_error("get the property of " + quoted_name() + " : it has " +
                 std::to_string(property->size()) + " bytes, this program's type " +
                 std::to_string(bytes) + "; use the type that it was set with");
    return false;
  }
  std::memcpy(data, property->data(), bytes);
  return true;
}

// --- buffered

bool RemoteStream::buffer(double life, double cycle) {
  const Call call(*this);
  if (!call.has_stream()) return false;
  collector_.reset();
  const std::string what = "readyRingBuf " + quoted_name() + " : ";
  std::uint64_t depth = connector_->depth();
  if (life != 0 || cycle != 0) {
    const double own_cycle = seconds_from_ns(to_ns(connector_->cycle()));
    if (cycle == 0) cycle = own_cycle;
    if (life == 0) life = static_cast<double>(depth - 1) * own_cycle / SSM_BUFFER_MARGIN;
    const double wanted = slots(life, cycle);
    if (!(life > 0 && cycle > 0 && life >= cycle && wanted <= static_cast<double>(kMaxDepth))) {
      report_error(fmt::format(
          "{}a life of {:f} s at a cycle of {:f} s cannot be; both must be more than 0, life not "
          "less than cycle, and together not more than 2^24 samples",
          what, life, cycle));
      return false;
    }
    depth = std::max(static_cast<std::uint64_t>(wanted), kMinDepth);
  }
  auto connector =
      PConnector::open(connector_->id(), options(address_, sample_.size()), &connector_->type());
  if (!connector) return report_error(what + connector.error().message), false;
  const std::uint64_t max_depth =
      std::max(kMinDepth, kMaxCollectedBytes / connector->payload_bytes());
  if (depth > max_depth) {
    report_error(fmt::format(
        "keep samples of '{}' : {} instead of {}, which would take more than {} MiB; ask for less "
        "life",
        connector->id().str(), max_depth - 1, depth - 1, kMaxCollectedBytes >> 20));
  }
  // From the oldest: programs read by time, and what happened before they came is worth having.
  auto collector = SampleCollector::start(
      std::move(*connector), {.start = Subscription::Start::oldest},
      {.depth = std::min(depth, max_depth),
       .on_error = [](const Error& error) { report_error(error.message + "; trying again"); }});
  if (!collector) return report_error(what + collector.error().message), false;
  collector_ = std::move(*collector);
  return true;
}

SSM_tid RemoteStream::top_buffered() {
  const Call call(*this, Call::Way::memory);
  return call.has_stream() && collector_ ? ssm_tid(collector_->newest_tid()) : -1;
}

SSM_tid RemoteStream::read_buffered(const Request& request, void* data, std::size_t bytes,
                                    double* time) {
  const Call call(*this, Call::Way::memory);
  if (!call.has_stream() || !collector_ || bytes != sample_.size()) return SSM_ERROR_NO_DATA;
  const SampleCollector& from = *collector_;
  const Tid newest = from.newest_tid();
  SampleInfo info;
  ReadStatus status = ReadStatus::not_yet;
  switch (request.which) {
    case Which::newest:
      status = from.read_newest(sample_, info);
      break;
    case Which::tid:
      status = from.read_tid(ring_tid(request.tid, newest), sample_, info);
      break;
    case Which::newer:
      status =
          from.read_newer(request.tid < 0 ? kNoTid : ring_tid(request.tid, newest), sample_, info);
      break;
    case Which::next: {
      if (request.tid < 0) {
        status = from.read_newest(sample_, info);
        break;
      }
      Tid target = ring_tid(request.tid, newest) + request.dt;
      status = from.read_tid(target, sample_, info);
      for (int attempt = 0; attempt < 100 && status == ReadStatus::too_old; ++attempt) {
        const Tid oldest = from.oldest_tid();
        if (oldest <= target) break;
        target = oldest;
        status = from.read_tid(target, sample_, info);
      }
      break;
    }
    case Which::at:
      status = request.time > 0 ? from.read_at(time_from_seconds(request.time), sample_, info)
                                : from.read_newest(sample_, info);
      break;
  }
  if (status != ReadStatus::ok) return error_of(status, request.which);
  return hand_over(info, data, time);
}

}  // namespace dssm::ssm
