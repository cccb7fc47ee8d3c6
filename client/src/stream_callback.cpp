// SPDX-License-Identifier: Apache-2.0
//
// Session::subscribe(): the opener opens the stream and passes its reader to the executor.
#include <algorithm>
#include <dssm/session.hpp>
#include <span>
#include <vector>

#include "client/src/client.hpp"
#include "core/base/try.hpp"

namespace dssm {
namespace {

// How long subscribe() waits for the first attempt to open the stream.
constexpr Duration kFirstAttempt = std::chrono::milliseconds(500);

class RawSampleCall final : public detail::SampleCall {
 public:
  explicit RawSampleCall(RawCallback callback) : callback_(std::move(callback)) {}

  RawReader& use(RawReader reader) override {
    blocks_.resize((reader.payload_bytes() + sizeof(Block) - 1) / sizeof(Block));
    return reader_.emplace(std::move(reader));
  }
  ReadStatus read_next() override { return reader_->read_next(payload(), info_); }
  ReadStatus read_newest() override { return reader_->read_newest(payload(), info_); }
  const SampleInfo& info() const override { return info_; }
  void call() override { callback_(payload().first(info_.payload_bytes), info_, *reader_); }

 private:
  struct alignas(64) Block {  // the greatest alignment that a payload may have
    std::byte bytes[64];
  };
  std::span<std::byte> payload() noexcept {
    return std::as_writable_bytes(std::span(blocks_)).first(reader_->payload_bytes());
  }

  std::optional<RawReader> reader_;
  std::vector<Block> blocks_;
  SampleInfo info_;
  RawCallback callback_;
};

// Where the calls begin, as WhichSamples says.
Result<void> set_start(Session& session, RawReader& reader, WhichSamples which, bool was_missing) {
  const Tid newest = reader.newest_tid();
  Tid before_first = std::max(newest, Tid{0}) - 1;
  if (which == WhichSamples::each_from_oldest) {
    before_first = kNoTid;
  } else if (was_missing || newest == kNoTid) {
    const bool is_own = DSSM_TRY(session.daemon_info()).host == reader.id().host;
    if (is_own) {
      before_first = kNoTid;
    } else if (newest == kNoTid && DSSM_TRY(session.stream_info(reader.id())).newest != kNoTid) {
      return {};  // its samples have not arrived yet: the first read takes the newest one
    }
  }
  reader.seek(before_first);
  return {};
}

}  // namespace

struct StreamCallback::State {
  std::shared_ptr<detail::Client> client;  // last to be destroyed
  std::shared_ptr<detail::ExecutorState> executor;
  std::shared_ptr<detail::CallbackState> callback;
  std::shared_ptr<detail::Opener::Request> request;

  ~State() {
    client->opener().value()->remove(*request);
    executor->end(*callback);
  }
};

StreamCallback::StreamCallback(std::unique_ptr<State> state) noexcept : state_(std::move(state)) {}
StreamCallback::StreamCallback(StreamCallback&&) noexcept = default;
StreamCallback& StreamCallback::operator=(StreamCallback&&) noexcept = default;
StreamCallback::~StreamCallback() = default;

bool StreamCallback::is_open() const noexcept { return state_->callback->is_open; }
std::uint64_t StreamCallback::lost_samples() const noexcept {
  return state_->callback->lost.load(std::memory_order_relaxed);
}
std::uint64_t StreamCallback::restarts() const noexcept {
  return state_->callback->restarts.load(std::memory_order_relaxed);
}

Result<StreamCallback> Session::subscribe_raw(const StreamId& id, RawCallback callback,
                                              const SubscribeOptions& options,
                                              const TypeInfo* wanted) {
  return subscribe_to(id, wanted, std::make_unique<RawSampleCall>(std::move(callback)), options);
}

Result<StreamCallback> Session::subscribe_to(const StreamId& id, const TypeInfo* wanted,
                                             std::unique_ptr<detail::SampleCall> call,
                                             SubscribeOptions options) {
  const std::string what = "subscribe to '" + id.str() + "'";
  DSSM_TRY(id.check(), what);
  detail::Opener* opener = DSSM_TRY(client_->opener(), what);
  std::shared_ptr<detail::ExecutorState> executor;
  if (options.executor) {
    executor = options.executor->state_;
  } else {
    executor = DSSM_TRY(client_->executor(), what);
  }
  if (!options.on_error) {
    options.on_error = [client = client_, what](const Error& error) {
      client->notice(what + ": " + error.message);
    };
  }
  auto request = std::make_shared<detail::Opener::Request>(id);
  request->open = [session = *this, executor, id,
                   type = wanted ? std::optional(*wanted) : std::nullopt, which = options.which,
                   history = options.history](bool was_missing) mutable -> Result<RawReader> {
    if (executor->is_closed()) return Error{Errc::closed, "its executor was destroyed"};
    RawReader reader = DSSM_TRY(session.open_raw_reader(id, type ? &*type : nullptr, 0, history));
    DSSM_TRY(reader.ready_fd());
    DSSM_TRY(set_start(session, reader, which, was_missing));
    return reader;
  };
  auto callback = std::make_shared<detail::CallbackState>(std::move(call), std::move(options));
  request->done = [executor, callback](Result<RawReader> opened) {
    executor->add(callback, std::move(opened));
  };
  StreamCallback handle(std::unique_ptr<StreamCallback::State>(
      new StreamCallback::State{client_, executor, callback, request}));
  // While there is no connection, an attempt would wait for one.
  const Duration at_most = is_connected() ? kFirstAttempt : Duration::zero();
  if (std::optional<Error> failed = opener->add(request, at_most)) return *std::move(failed);
  return handle;
}

}  // namespace dssm
