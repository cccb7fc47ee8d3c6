// SPDX-License-Identifier: Apache-2.0
//
// A program writes anything anywhere into its ring, while an honest writer writes to it and dssmd
// publishes into it and sends its samples to another host: StreamFeed, SamplePump and RingWriter.
// They may send and store wrong data, but must not crash, hang, or be busy without end. The lock is
// left alone: who waits for it waits in real time.
//
// An input's first byte chooses the size of the payload, the features of the receiver and the kind
// of subscription. Then comes a list of steps: 1 byte that says what happens; for a scribble
// 2 bytes offset (in units of 8 bytes), 1 byte length, and the bytes.
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <optional>

#include "core/clock/playback_record.hpp"
#include "core/ring/ring_writer.hpp"
#include "daemon/link/sample_pump.hpp"
#include "daemon/link/stream_feed.hpp"
#include "daemon/streams/registry.hpp"
#include "tests/fuzz/fuzzer.hpp"
#include "tests/support/memory_peer.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;

constexpr std::uint64_t kDepth = 8;

struct Choice {
  std::uint64_t payload_bytes;
  bool may_tear, newest_first, thinned;
};
Choice choice_of(unsigned byte) {
  constexpr std::uint64_t kPayloadBytes[] = {24, SampleSender::kInPlaceBytes,
                                             SampleSender::kMaxCopiedBytes + 1, 0};
  return {std::max<std::uint64_t>(kPayloadBytes[byte % 4], 1), (byte & 4) != 0, (byte & 8) != 0,
          (byte & 16) != 0};
}

class Rig final : private FrameConnection::Observer,
                  private SamplePump::Observer,
                  private StreamFeed::Observer {
 public:
  explicit Rig(const Choice& choice)
      : choice_(choice),
        stream_(registry_
                    .create({"a", 0, ""}, {"T", choice.payload_bytes, 8, {}},
                            {kDepth, std::chrono::milliseconds(1)}, 1)
                    .value()
                    .stream),
        mapping_(stream_->map_for_writing().value()),
        bell_(stream_->map_bell().value()),
        descriptors_(stream_->descriptors_for(Role::writer).value()),
        feed_(StreamFeed::open(loop_, stream_).value()),
        sender_(*mapping_, link_, {choice.may_tear, &budget_}) {
    subscribe(0);
  }
  Rig(const Rig&) = delete;
  Rig& operator=(const Rig&) = delete;
  ~Rig() { feed_->forget(*this); }

  void scribble(std::size_t offset, std::span<const std::uint8_t> bytes) {
    const std::size_t at = offset % mapping_->geometry().total_bytes;
    const std::size_t end = mapping_->geometry().total_bytes;
    std::size_t length = std::min(bytes.size(), end - at);
    constexpr std::size_t kLock = offsetof(ring::RingHeader, lock);
    if (at < kLock + ring::kLockBytes) length = at < kLock ? std::min(length, kLock - at) : 0;
    if (::pwrite(descriptors_.at(0).get(), bytes.data(), length, static_cast<off_t>(at)) < 0) {
      std::abort();
    }
  }

  void step(unsigned what) {
    const std::vector<std::byte> payload(choice_.payload_bytes);
    ring::RingWriter writer(*mapping_, *bell_, descriptors_.at(3).get());
    switch (what % 8) {
      case 0:
        writer.write(payload, time_from_ns(what), Duration(1));
        break;
      case 1:
        writer.try_publish({what / 8, what / 16}, payload, time_from_ns(what), Duration(1));
        feed_->poll();
        break;
      case 2:
        if (std::byte* const place = writer.begin()) {
          std::memset(place, 1, choice_.payload_bytes);
          what & 8 ? static_cast<void>(writer.commit(choice_.payload_bytes, time_from_ns(what), {}))
                   : writer.cancel();
        }
        break;
      case 3:
        return subscribe(what / 8);
      case 4:
        peer_.room = what * 64U;
        break;
      case 5:
        static_cast<void>(stream_->info());
        open_again();
        static_cast<void>(ring::PublisherCursors(mapping_->header()).last_untrusted(what / 8));
        break;
      case 6:
        now_ += std::chrono::milliseconds(what * 10);
        break;
      default:
        break;
    }
    run();
  }

 private:
  // As for the next remote program that writes.
  void open_again() {
    const auto again = stream_->map_for_writing();
    if (again && (*again)->geometry() != mapping_->geometry()) std::abort();
  }

  // Begins again at a sample near the newest one, or at one that the input says.
  void subscribe(unsigned what) {
    if (sender_.busy()) return;
    SamplePump::Plan plan;
    const Tid newest = newest_untrusted(ring::RingReader(*mapping_));
    plan.first = std::clamp<Tid>(newest - static_cast<Tid>(what % 8), 0, channel::kMaxTid);
    plan.caught_up_at = what & 8 ? newest : kNoTid;
    plan.newest_first = choice_.newest_first;
    plan.max_rate_hz = choice_.thinned ? 100 : 0;
    pump_.emplace(*mapping_, link_, sender_, static_cast<SamplePump::Observer&>(*this), plan);
    run();
  }

  // Until there is nothing to do: the input changes the ring only between its steps.
  void run() {
    for (int turns = 0; is_open_; ++turns) {
      if (turns > 200) std::abort();  // dssmd would be busy for ever
      run_turns(loop_);
      peer_.sent.clear();
      const Result<PumpWait> wait = pump_->pump(now_);
      if (!wait) {
        is_open_ = false;
      } else if (*wait == PumpWait::output) {
        if (peer_.room == 0) return;
      } else if (*wait == PumpWait::sample) {
        if (feed_->wait(*this, pump_->known())) return;
      } else if (*wait != PumpWait::turn) {
        return;
      }
    }
  }

  Result<void> on_frame(net::Frame&) override { return {}; }
  void on_closed(const Error&) override { is_open_ = false; }
  void on_gap(Tid first, std::uint64_t count) override {
    if (first < 0 || count == 0) std::abort();
    link_.send(gap_frame(first, count));
  }
  void on_sample_available() override {}

  const Choice choice_;
  EventLoop loop_ = EventLoop::open(TimerQueue::Time::simulated).value();
  MonoTime now_{std::chrono::seconds(1000)};
  Registry registry_{"pc1",
                     {.max_streams = 1, .max_memory_bytes = 4U << 20, .max_property_bytes = 1}};
  MemoryBudget budget_{1U << 20};
  std::shared_ptr<Stream> stream_;
  std::shared_ptr<const ring::RingMapping> mapping_;
  std::shared_ptr<ring::Bell> bell_;
  std::vector<UniqueFd> descriptors_;
  std::shared_ptr<StreamFeed> feed_;
  bool is_open_ = true;
  MemoryPeer peer_;
  FrameConnection link_{loop_, std::make_unique<MemoryTransport>(peer_), *this, 1U << 20};
  SampleSender sender_;
  std::optional<SamplePump> pump_;
};

// The playback clock, of which any program can write anything.
void load_playback_untrusted(std::span<const std::uint8_t> bytes) {
  const UniqueFd page = clock::create_playback_clock().value();
  bytes = bytes.first(std::min(bytes.size(), sizeof(clock::PlaybackPage)));
  constexpr std::size_t kSettingAt = offsetof(clock::PlaybackPage, setting);
  if (::pwrite(page.get(), bytes.data(), bytes.size(), kSettingAt) < 0) std::abort();
  if (const auto record = clock::PlaybackRecord::open_untrusted(page.get())) {
    static_cast<void>((*record)->load().at(1000));
  }
}

void run(std::span<const std::uint8_t> input) {
  if (input.empty()) return;
  load_playback_untrusted(input);
  Rig rig(choice_of(input[0]));
  input = input.subspan(1);
  for (int steps = 0; steps < 200 && !input.empty(); ++steps) {
    const unsigned what = input[0];
    input = input.subspan(1);
    if (what % 8 < 7) {
      rig.step(what);
    } else if (input.size() >= 3) {
      const std::size_t offset = (input[0] + input[1] * std::size_t{256}) * 8;
      const std::size_t length = std::min<std::size_t>(1 + input[2] % 64, input.size() - 3);
      rig.scribble(offset, input.subspan(3, length));
      input = input.subspan(3 + length);
    }
  }
  rig.step(7);
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::daemon::run(input); }
