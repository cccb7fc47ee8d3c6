// SPDX-License-Identifier: Apache-2.0
//
// PConnector's requests in the network protocol's words; the rest is StreamClient's.
#include <fmt/format.h>
#include <poll.h>

#include <algorithm>
#include <dssm/pconnector.hpp>

#include "client/src/find_host.hpp"
#include "client/src/program_name.hpp"
#include "client/src/states.hpp"
#include "client/src/stream_client.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm {
namespace detail {

struct PConnectorState {
  explicit PConnectorState(std::unique_ptr<StreamClient> opened) : client(std::move(opened)) {}
  std::unique_ptr<StreamClient> client;
};

namespace {

// A connection that only lists streams receives no samples.
class ListDelegate final : public wire::FrameDelegate {
 public:
  Result<void> on_sample_begin(const wire::IncomingSample&, std::byte*&) override {
    return Error{Errc::protocol, "a sample came on a connection that carries none"};
  }
  Result<void> on_sample_end(const wire::IncomingSample&, bool) override { return {}; }
  Result<void> on_frame(net::Frame& frame) override {
    if (frame.has_failure()) return wire::failure(frame.failure());
    if (!frame.has_stream_list()) return {};
    streams.emplace();
    for (const proto::Stream& stream : frame.stream_list().streams()) {
      streams->push_back(wire::stream_info(stream));
    }
    return {};
  }
  std::optional<std::vector<StreamInfo>> streams;
};

Result<std::vector<StreamInfo>> list_streams(const wire::Address& host,
                                             const PConnectorOptions& options) {
  const MonoTime deadline = deadline_in(options.request_timeout);
  ListDelegate delegate;
  NetworkConnection connection(
      delegate, options.program.empty() ? default_program() : options.program,
      options.request_timeout, DSSM_TRY(load_credentials(options.credentials)));
  DSSM_TRY(connection.start(find_host(host)));
  for (bool asked = false; !delegate.streams;) {
    DSSM_TRY(connection.advance());
    if (connection.is_up() && !asked) {
      asked = true;
      net::Frame frame;
      frame.set_serial(1);
      frame.mutable_list();
      connection.queue(frame);
    }
    if (connection.is_up() && connection.has_queued()) DSSM_TRY(connection.send_queued());
    const MonoTime now = MonoClock::now();
    const timespec timeout = timespec_of(connection.has_buffered_input()
                                             ? Duration::zero()
                                             : std::min(deadline, connection.next_step()) - now);
    pollfd ready{connection.fd(), connection.events(false), 0};
    if (::ppoll(&ready, 1, &timeout, nullptr) > 0 || connection.has_buffered_input()) {
      DSSM_TRY(connection.receive());
    }
    // After what has arrived was looked at: this program may have been stalled.
    if (now >= deadline && !delegate.streams) return connection.no_answer_error();
  }
  return std::move(*delegate.streams);
}

// "open 'lidar:0' at '10.0.0.2'"
std::string attempt(const char* verb, const StreamId& id, const PConnectorOptions& options) {
  std::string text = verb + (" '" + id.str() + "'");
  if (!options.address.empty()) text += " at '" + options.address + "'";
  return text;
}

}  // namespace
}  // namespace detail

PConnector::PConnector(std::unique_ptr<detail::PConnectorState> state) noexcept
    : state_(std::move(state)) {}
PConnector::PConnector(PConnector&&) noexcept = default;
PConnector& PConnector::operator=(PConnector&&) noexcept = default;
PConnector::~PConnector() = default;

Result<PConnector> PConnector::open(const StreamId& id, PConnectorOptions options,
                                    const TypeInfo* wanted) {
  const std::string what = detail::attempt("open", id, options);
  DSSM_TRY(id.check(), what);
  auto client = DSSM_TRY(detail::StreamClient::open({id}, std::move(options)), what);
  if (wanted) DSSM_TRY(client->stream().type.check_usable_as(*wanted), what);
  return PConnector(std::make_unique<detail::PConnectorState>(std::move(client)));
}

Result<PConnector> PConnector::create(const StreamId& id, const TypeInfo& type,
                                      const History& history, PConnectorOptions options) {
  const std::string what = detail::attempt("create", id, options);
  DSSM_TRY(id.check(), what);
  DSSM_TRY(type.check(), what);
  const channel::CreatePlan plan{type, history, options.keep_existing};
  auto client = DSSM_TRY(detail::StreamClient::open({id, plan}, std::move(options)), what);
  return PConnector(std::make_unique<detail::PConnectorState>(std::move(client)));
}

Result<std::vector<StreamInfo>> PConnector::list_streams(const PConnectorOptions& options) {
  const std::string what = "list the streams of '" + options.address + "'";
  const wire::Address host = DSSM_TRY(detail::parse_host(options.address), what);
  return DSSM_TRY(detail::list_streams(host, options), what);
}

// --- reading

using Which = wire::ReadRequest::Which;

Result<ReadStatus> PConnector::read_newest(std::span<std::byte> payload, SampleInfo& info) {
  return state_->client->read({Which::newest}, payload, info);
}

Result<ReadStatus> PConnector::read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) {
  return state_->client->read({Which::tid, tid}, payload, info);
}

Result<ReadStatus> PConnector::read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                                       Duration max_age) {
  SampleInfo seen;
  Result<ReadStatus> status = state_->client->read({Which::time, to_ns(t)}, payload, seen);
  if (status && *status == ReadStatus::ok) {
    if (is_stale(t, seen.time, max_age)) return ReadStatus::stale;
    info = seen;
  }
  return status;
}

Result<ReadStatus> PConnector::read_newer(Tid than, std::span<std::byte> payload,
                                          SampleInfo& info) {
  return state_->client->read({Which::newer_than, than}, payload, info);
}

namespace {

Result<net::Range> ask_range(detail::StreamClient& client, std::optional<Time> t) {
  net::Frame frame;
  frame.mutable_get_range();
  if (t) frame.mutable_get_range()->set_time_ns(to_ns(*t));
  net::Frame answer =
      DSSM_TRY(client.ask(std::move(frame)), "look at '" + client.stream().id.str() + "'");
  return std::move(*answer.mutable_range());
}

}  // namespace

Result<Tid> PConnector::newest_tid() {
  return std::max(DSSM_TRY(ask_range(*state_->client, std::nullopt)).newest(), kNoTid);
}

Result<Tid> PConnector::oldest_tid() {
  return std::max(DSSM_TRY(ask_range(*state_->client, std::nullopt)).oldest(), kNoTid);
}

Result<Tid> PConnector::find(Time t) {
  return std::max(DSSM_TRY(ask_range(*state_->client, t)).at_tid(), kNoTid);
}

// --- subscription

Result<void> PConnector::subscribe(const Subscription& what) {
  return state_->client->subscribe(what);
}

Result<void> PConnector::unsubscribe() { return state_->client->unsubscribe(); }

Result<ReadStatus> PConnector::read_next(std::span<std::byte> payload, SampleInfo& info) {
  return state_->client->next(payload, info);
}

WaitStatus PConnector::wait(MonoTime deadline) { return state_->client->wait(deadline); }
std::uint64_t PConnector::lost_samples() const noexcept { return state_->client->lost(); }
std::uint64_t PConnector::restarts() const noexcept { return state_->client->restarts(); }
int PConnector::ready_fd() const noexcept { return state_->client->ready_fd(); }

// --- writing

Result<Tid> PConnector::write(std::span<const std::byte> payload, Time time, Duration clock_error) {
  DSSM_TRY(post(payload, time, clock_error));
  return flush(deadline_in(state_->client->request_timeout()));
}

Result<void> PConnector::post(std::span<const std::byte> payload, Time time, Duration clock_error) {
  return state_->client->post(payload, time,
                              clock_error == kOwnClockError
                                  ? detail::clock_error_by(detail::latest_clock_page(), time)
                                  : clock_error);
}

Result<Tid> PConnector::flush(MonoTime deadline) { return state_->client->flush(deadline); }
std::uint64_t PConnector::dropped_samples() const noexcept { return state_->client->dropped(); }

// --- about the stream

Result<std::vector<std::byte>> PConnector::property() {
  net::Frame frame;
  frame.mutable_get_property();
  const net::Frame answer =
      DSSM_TRY(state_->client->ask(std::move(frame)), "get the property of '" + id().str() + "'");
  const std::string& property = answer.property().property();
  const auto* bytes = reinterpret_cast<const std::byte*>(property.data());
  return std::vector<std::byte>(bytes, bytes + property.size());
}

Result<void> PConnector::set_property(std::span<const std::byte> property) {
  const std::string what = "set the property of '" + id().str() + "'";
  if (property.size() > wire::kMaxPropertyBytes) {
    return Error{Errc::limit_exceeded, fmt::format("{}: it has {} bytes; at most {} are taken",
                                                   what, property.size(), wire::kMaxPropertyBytes)};
  }
  net::Frame frame;
  frame.mutable_set_property()->set_property(property.data(), property.size());
  DSSM_TRY(state_->client->ask(std::move(frame)), what);
  return {};
}

const StreamId& PConnector::id() const noexcept { return state_->client->stream().id; }
const TypeInfo& PConnector::type() const noexcept { return state_->client->stream().type; }
std::uint64_t PConnector::payload_bytes() const noexcept { return type().payload_bytes; }
std::uint64_t PConnector::depth() const noexcept { return state_->client->stream().depth; }
Duration PConnector::cycle() const noexcept { return state_->client->stream().cycle; }
std::uint64_t PConnector::incarnation() const noexcept {
  return state_->client->stream().incarnation;
}
bool PConnector::is_connected() const noexcept { return state_->client->is_connected(); }
const std::string& PConnector::address() const noexcept { return state_->client->address(); }
PConnector::Counters PConnector::counters() const noexcept { return state_->client->counters(); }

}  // namespace dssm
