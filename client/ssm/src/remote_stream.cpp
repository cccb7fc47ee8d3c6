// SPDX-License-Identifier: Apache-2.0
#include "remote_stream.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <cstring>
#include <mutex>

#include "convert.hpp"
#include "messages.hpp"
#include "socket_path.hpp"

namespace dssm::ssm {
namespace {

using namespace std::chrono_literals;

// How long one call tries: Ctrl-C is seen after it. More for samples that take long to come.
constexpr Duration kCallTimeout = 2s;
constexpr std::uint64_t kMinBytesPerSecond = 4'000'000;

constexpr Duration kRetryPause = 200ms;

// Programs of the oldest kind ask for "512" and mean samples, where it now means seconds: what is
// collected must not use up the machine's memory.
constexpr std::uint64_t kMaxCollectedBytes = 512U << 20;

// When connecting and opening give up: $DSSM_CONNECT_TIMEOUT [s] from now, else never.
MonoTime give_up_at() {
  const std::string text = environment("DSSM_CONNECT_TIMEOUT");
  double seconds = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), seconds);
  if (text.empty() || error != std::errc{} || end != text.data() + text.size()) return kNever;
  return deadline_in(Duration(std::max<std::int64_t>(0, ns_from_seconds(seconds))));
}

// Tries until it succeeds, fails with an error that is not retryable, is interrupted, or is given
// up. Each error is reported once.
template <class Try>
auto retry(const std::string& what, Try attempt) -> decltype(attempt()) {
  const MonoTime give_up = give_up_at();
  Interruptible signals;
  std::string reported;
  for (;;) {
    auto result = attempt();
    if (result || !is_retryable(result.error().code)) return result;
    if (MonoClock::now() >= give_up) return result;
    if (result.error().message != reported) {
      reported = result.error().message;
      report_error(fmt::format("{} : {}; trying again", what, reported));
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
  // Whether there is an open stream besides.
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
  options.request_timeout = kCallTimeout + std::chrono::seconds(payload_bytes / kMinBytesPerSecond);
  return options;
}

std::string RemoteStream::quoted_name() const {
  return quoted(connector_->id().name, connector_->id().id);
}

std::size_t RemoteStream::data_bytes() const noexcept {
  return ssm::data_bytes(connector_->type());
}

void RemoteStream::report_once(const Error& error) {
  if (error.message == reported_) return remember_error(error.message);
  reported_ = error.message;
  report_error(error.message);
}

bool RemoteStream::connect(const std::string& address) {
  const Call call(*this);
  if (!call) return false;
  const std::string what = fmt::format("connect to '{}'", address);
  const auto listed = retry(what, [&] { return PConnector::list_streams(options(address, 0)); });
  if (!listed) report_failure(what, listed.error());
  return listed.has_value();
}

bool RemoteStream::take(Result<PConnector> opened, const std::string& what) {
  collector_.reset();
  connector_.reset();
  if (!opened) {
    report_failure(what, opened.error());
    return false;
  }
  connector_ = std::move(*opened);
  sample_.resize(connector_->payload_bytes());
  offset_ = 0;
  seen_ = kNoTid;
  restarts_ = 0;
  reported_.clear();
  open_.store(true);
  return true;
}

bool RemoteStream::create(const std::string& address, const StreamId& id, const TypeInfo& type,
                          const History& history) {
  const Call call(*this);
  if (!call) return false;
  open_.store(false);
  address_ = address;
  PConnectorOptions with = options(address, type.payload_bytes);
  with.keep_existing = true;
  return take(PConnector::create(id, type, history, std::move(with)),
              "create " + quoted(id.name, id.id));
}

bool RemoteStream::open(const std::string& address, const StreamId& id, std::size_t wanted_bytes) {
  const Call call(*this);
  if (!call) return false;
  open_.store(false);
  address_ = address;
  const std::string what = "open " + quoted(id.name, id.id);
  auto opened = retry(what, [&]() -> Result<PConnector> {
    auto connector = PConnector::open(id, options(address, wanted_bytes));
    if (!connector) return connector;
    const std::uint64_t bytes = ssm::data_bytes(connector->type());
    if (bytes == wanted_bytes) return connector;
    return Error{Errc::type_mismatch,
                 fmt::format("the stream has {} bytes per sample, this program's type {} : use the "
                             "type that it was created with",
                             bytes, wanted_bytes)};
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
ReadStatus RemoteStream::fetch(Ask ask, SampleInfo& info) {
  for (;;) {
    Result<ReadStatus> status = ask(*connector_);
    follow_restart();
    if (!status) {
      report_once(status.error());
      return ReadStatus::not_yet;
    }
    reported_.clear();
    if (*status == ReadStatus::restarted) continue;
    if (*status == ReadStatus::ok) {
      info.tid += offset_;
      seen_ = std::max(seen_, info.tid);
    }
    return *status;
  }
}

Tid RemoteStream::ask_newest() {
  const auto newest = connector_->newest_tid();
  follow_restart();
  if (!newest) return report_once(newest.error()), kNoTid;
  reported_.clear();
  const Tid tid = *newest + offset_;  // of a new ring that is empty: the last one of the old
  seen_ = std::max(seen_, tid);
  return tid;
}

Tid RemoteStream::ask_oldest() {
  const auto oldest = connector_->oldest_tid();
  follow_restart();
  if (!oldest) return report_once(oldest.error()), kNoTid;
  reported_.clear();
  return *oldest < 0 ? offset_ - 1 : *oldest + offset_;
}

// Reads over the network, with the functions of SampleCollector.
class RemoteStream::Network {
 public:
  explicit Network(RemoteStream& stream) noexcept : stream_(stream) {}

  ReadStatus read_newest(std::span<std::byte> out, SampleInfo& info) const {
    return stream_.fetch([&](PConnector& from) { return from.read_newest(out, info); }, info);
  }
  ReadStatus read_tid(Tid tid, std::span<std::byte> out, SampleInfo& info) const {
    return stream_.fetch(
        [&](PConnector& from) { return from.read_tid(tid - stream_.offset_, out, info); }, info);
  }
  ReadStatus read_newer(Tid than, std::span<std::byte> out, SampleInfo& info) const {
    return stream_.fetch(
        [&](PConnector& from) {
          return from.read_newer(std::max(than - stream_.offset_, kNoTid), out, info);
        },
        info);
  }
  ReadStatus read_at(Time t, std::span<std::byte> out, SampleInfo& info) const {
    return stream_.fetch([&](PConnector& from) { return from.read_at(t, out, info); }, info);
  }
  // At least as new as any that the program got: near enough to find the one that it means.
  Tid newest_tid() const {
    if (stream_.seen_ < 0) stream_.seen_ = stream_.ask_newest();
    return stream_.seen_;
  }
  Tid oldest_tid() const { return stream_.ask_oldest(); }

 private:
  RemoteStream& stream_;
};

// Reads what is requested into sample_.
//   report_skip  what to call with the tids of the wanted and of the next one that is still held
template <class Source, class ReportSkip>
ReadStatus RemoteStream::read_from(const Source& source, const Request& request, SampleInfo& info,
                                   ReportSkip report_skip) {
  const auto meant = [&] { return ring_tid(request.tid, source.newest_tid()); };
  switch (request.which) {
    case Which::tid:
      return source.read_tid(meant(), sample_, info);
    case Which::newer:
      return source.read_newer(request.tid < 0 ? kNoTid : meant(), sample_, info);
    case Which::next: {
      if (request.tid < 0) break;
      const Tid target = meant() + request.dt;
      ReadStatus status = source.read_tid(target, sample_, info);
      // Again when a fast writer overtakes this thread between asking and reading.
      for (int attempt = 0; attempt < 100 && status == ReadStatus::too_old; ++attempt) {
        const Tid oldest = source.oldest_tid();
        if (oldest <= target) break;
        status = source.read_tid(oldest, sample_, info);
        if (status == ReadStatus::ok) report_skip(target, info.tid);
      }
      return status;
    }
    case Which::at:
      if (request.time > 0) {
        return source.read_at(time_from_seconds(request.time), sample_, info);
      }
      break;
    case Which::newest:
      break;
  }
  return source.read_newest(sample_, info);
}

SSM_tid RemoteStream::hand_over(ReadStatus status, const Request& request, const SampleInfo& info,
                                void* data, double* time) {
  if (status != ReadStatus::ok) return error_of(status, request.which);
  zero_rest(sample_, info);
  std::memcpy(data, sample_.data(), data_bytes());
  if (time) *time = seconds_from_time(info.time);
  return ssm_tid(info.tid);
}

// Whether the program's type is as long as the stream's; reports it if not.
bool RemoteStream::has_size(const char* verb, std::size_t bytes) {
  if (bytes == data_bytes()) return true;
  report_once(
      {Errc::type_mismatch, fmt::format("{} {} : its samples have {} bytes, this program's type {}",
                                        verb, quoted_name(), data_bytes(), bytes)});
  return false;
}

SSM_tid RemoteStream::read(const Request& request, void* data, std::size_t bytes, double* time) {
  const Call call(*this);
  if (!call.has_stream()) return SSM_ERROR_NO_DATA;
  if (!has_size("read", bytes)) return SSM_ERROR_NO_DATA;
  SampleInfo info;
  const auto report_skip = [&](Tid wanted, Tid got) {
    report_error(fmt::format("readNext : skipping {} TID: {} -> {}", quoted_name(), ssm_tid(wanted),
                             ssm_tid(got)));
  };
  const ReadStatus status = read_from(Network(*this), request, info, report_skip);
  return hand_over(status, request, info, data, time);
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
  const auto found = connector_->find(time_before(time));
  follow_restart();
  if (!found) return report_once(found.error()), SSM_ERROR_NO_DATA;
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
  if (!has_size("write", bytes)) return false;
  static constexpr std::byte kNothing{};  // of a stream of size 0
  const std::span<const std::byte> sample{
      bytes > 0 ? static_cast<const std::byte*>(data) : &kNothing, sample_.size()};
  const auto posted = connector_->post(sample, time_from_seconds(time));
  if (!posted) return report_once(posted.error()), false;
  if (connector_->is_connected()) {
    reported_.clear();
  } else {
    report_once({Errc::unavailable,
                 fmt::format("write {} : '{}' is away; the newest samples are kept and sent later",
                             quoted_name(), address_)});
  }
  return true;
}

bool RemoteStream::set_property(const void* data, std::size_t bytes) {
  const Call call(*this);
  if (!call.has_stream()) return false;
  const auto set = connector_->set_property({static_cast<const std::byte*>(data), bytes});
  if (!set) report_once(set.error());
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
      report_once(property.error());
    }
    return false;
  }
  if (property->size() != bytes) {
    report_error(property_size_error(quoted_name(), property->size(), bytes));
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
  const std::string what = "readyRingBuf " + quoted_name();
  std::uint64_t depth = connector_->depth();
  if (life != 0 || cycle != 0) {
    const double own_cycle = seconds_from_ns(to_ns(connector_->cycle()));
    if (cycle == 0) cycle = own_cycle;
    if (life == 0) life = static_cast<double>(depth - 1) * own_cycle / SSM_BUFFER_MARGIN;
    const double wanted = slots(life, cycle);
    if (!(life > 0 && cycle > 0 && life >= cycle && wanted <= static_cast<double>(kMaxDepth))) {
      report_error(
          fmt::format("{} : a life of {:f} s at a cycle of {:f} s cannot be; both must be more "
                      "than 0, life not "
                      "less than cycle, and together not more than 2^24 samples",
                      what, life, cycle));
      return false;
    }
    depth = std::max(static_cast<std::uint64_t>(wanted), kMinDepth);
  }
  auto connector =
      PConnector::open(connector_->id(), options(address_, sample_.size()), &connector_->type());
  if (!connector) return report_failure(what, connector.error()), false;
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
  if (!collector) return report_failure(what, collector.error()), false;
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
  if (!call.has_stream() || !collector_ || bytes != data_bytes()) return SSM_ERROR_NO_DATA;
  SampleInfo info;
  const ReadStatus status = read_from(*collector_, request, info, [](Tid, Tid) {});
  return hand_over(status, request, info, data, time);
}

}  // namespace dssm::ssm
