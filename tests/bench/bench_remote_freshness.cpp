// SPDX-License-Identifier: Apache-2.0
//
// How old the newest sample is on the reader's PC, when the link carries little more than the
// stream, or less: just after the stream was opened, later, and after the cable was cut. Beside
// it, bare TCP that sends the newest frame each time the last one is with the kernel.
//
// The stream is a camera's, 640 x 480 x 3 bytes 30 times a second (27.6 MB/s), with a history of
// 5 s. Then an encoder's stream, 64 bytes 1,000 times a second, alone, and beside a history of 1 GB
// that fills the same link.
//
// The network namespaces of both hosts have one clock, so ages are exact. TCP's congestion control
// is Debian's default, cubic.
#include <atomic>
#include <cmath>
#include <cstring>
#include <dssm/dssm.hpp>
#include <fstream>
#include <optional>
#include <string>
#include <thread>

#include "tests/bench/harness.hpp"
#include "tests/bench/hosts.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr std::size_t kFrameBytes = 640 * 480 * 3;
constexpr Duration kPeriod = 33'333us;
constexpr Duration kHistory = 5s;
constexpr Duration kCut = 5s;      // longer than dssmd needs to take a host for down
constexpr Duration kWatched = 4s;  // after an event
constexpr Duration kPoll = 1ms;

double age_ns(Time time) { return static_cast<double>((WallClock::now() - time).count()); }

[[noreturn]] void write_frames(const std::string& socket, std::atomic<bool>& is_filled) {
  Session session = Session::connect({.socket_path = socket}).value();
  const auto depth = static_cast<std::uint64_t>(kHistory / kPeriod);
  RawWriter writer =
      session.create_raw({"camera", 0, ""}, {"", kFrameBytes, 1, {}}, History{depth, kPeriod})
          .value();
  const std::vector<std::byte> frame(kFrameBytes, std::byte{1});
  MonoTime next = MonoClock::now();
  for (std::uint64_t written = 0;; ++written) {
    sleep_until(next += kPeriod);
    writer.write(frame, WallClock::now());
    if (written == depth) is_filled.store(true);
  }
}

// The ages that a program sees which reads the newest sample again and again.
template <class NewestTime>
std::vector<double> watch(Duration how_long, NewestTime newest_time) {
  std::vector<double> ages;
  for (const MonoTime end = MonoClock::now() + how_long; MonoClock::now() < end;) {
    if (const std::optional<Time> time = newest_time()) ages.push_back(age_ns(*time));
    sleep_until(MonoClock::now() + kPoll);
  }
  if (ages.empty()) fail("no sample came");
  return ages;
}

// --- bare TCP

[[noreturn]] void send_newest(int socket) {
  const int little = 128 << 10;
  ::setsockopt(socket, IPPROTO_TCP, TCP_NOTSENT_LOWAT, &little, sizeof little);
  std::vector<std::byte> frame(kFrameBytes, std::byte{1});
  const MonoTime start = MonoClock::now();
  for (std::int64_t sent = 0;;) {
    const std::int64_t newest = (MonoClock::now() - start) / kPeriod;
    if (newest == sent) {
      sleep_until(start + (sent + 1) * kPeriod);
      continue;
    }
    sent = newest;
    const Duration ago = MonoClock::now() - (start + sent * kPeriod);
    const std::int64_t time = to_ns(WallClock::now() - ago);
    std::memcpy(frame.data(), &time, sizeof time);
    send_all(socket, frame.data(), frame.size());
  }
}

[[noreturn]] void receive_newest(int socket, std::atomic<std::int64_t>& time_ns) {
  std::vector<std::byte> frame(kFrameBytes);
  for (;;) {
    receive_all(socket, frame.data(), frame.size());
    std::int64_t time = 0;
    std::memcpy(&time, frame.data(), sizeof time);
    time_ns.store(time);
  }
}

Figures raw_ages(const Hosts& hosts) {
  const auto [out, in] = hosts.tcp_pair();
  auto& time_ns = shared<std::atomic<std::int64_t>>();
  const int sender = out, receiver = in;
  const pid_t sends = in_child([&] { send_newest(sender); });
  const pid_t receives = in_child([&] { receive_newest(receiver, time_ns); });
  const auto newest = [&]() -> std::optional<Time> {
    const std::int64_t ns = time_ns.load();
    return ns ? std::optional(time_from_ns(ns)) : std::nullopt;
  };
  watch(1s, newest);
  const Figures figures = figures_of(watch(kWatched, newest));
  end_child(sends), end_child(receives);
  ::close(out), ::close(in);
  return figures;
}

// --- ours

void print_ages(const std::string& name, const Figures& raw, const std::vector<double>& ages,
                double link_ns) {
  const Figures figures = figures_of(ages);
  const double target = 2 * link_ns + static_cast<double>(to_ns(5ms)) +
                        static_cast<double>(to_ns(kPeriod));  // a frame may be as old when sent
  char rest[96];
  std::snprintf(rest, sizeof rest, "%7.2f  p99 <= %ld ms", figures.median / raw.median,
                std::lround(target / 1e6));
  print_row(name, {figures.min / 1e6, figures.median / 1e6, figures.p99 / 1e6, figures.p999 / 1e6},
            rest);
}

void measure_link(test::Network& network, const Hosts& hosts, int megabytes_per_s) {
  const std::string rate = std::to_string(megabytes_per_s * 8) + "mbit";
  if (auto shaped = network.shape(2, "tbf rate " + rate + " burst 256kb latency 10ms"); !shaped) {
    std::printf("--- SKIPPED %d MB/s: %s\n", megabytes_per_s, shaped.error().message.c_str());
    return;
  }
  const std::string tail = ", " + std::to_string(megabytes_per_s) + " MB/s [ms]";
  const Figures raw = raw_ages(hosts);
  print_row("  raw TCP, newest frame" + tail,
            {raw.min / 1e6, raw.median / 1e6, raw.p99 / 1e6, raw.p999 / 1e6});
  const auto owner = hosts.start_owner("error");
  const std::string socket = owner->socket_path();
  auto& is_filled = shared<std::atomic<bool>>();
  const pid_t writer = in_child([&] { write_frames(socket, is_filled); });
  while (!is_filled.load()) ::usleep(10'000);
  {
    const auto other = hosts.start_other(*owner);
    Session session = Session::connect({.socket_path = other->socket_path()}).value();
    RawReader reader = session
                           .await_raw_reader(StreamId{"camera", 0, "pc1"}, deadline_in(60s),
                                             nullptr, FetchHistory::at_once)
                           .value();
    std::vector<std::byte> frame(kFrameBytes);
    const auto newest = [&]() -> std::optional<Time> {
      SampleInfo info;
      return reader.read_newest(frame, info) == ReadStatus::ok ? std::optional(info.time)
                                                               : std::nullopt;
    };
    const double link_ns = static_cast<double>(kFrameBytes) * 1e3 / megabytes_per_s;
    print_ages("just after opening" + tail, raw, watch(kWatched, newest), link_ns);
    print_ages("later" + tail, raw, watch(kWatched, newest), link_ns);
    network.cut(2);
    std::this_thread::sleep_for(kCut);
    network.heal(2);
    SampleInfo before, info;
    static_cast<void>(reader.read_newest(frame, before));
    const std::int64_t healed = now_ns();
    do {
      sleep_until(MonoClock::now() + kPoll);
      static_cast<void>(reader.read_newest(frame, info));
    } while (info.tid == before.tid);
    std::printf("%-44s %9.1f\n", ("  the first after a cut" + tail).c_str(),
                static_cast<double>(now_ns() - healed) / 1e6);
    print_ages("from then on" + tail, raw, watch(kWatched, newest), link_ns);
  }
  end_child(writer);
}

// --- a small stream beside a large history

constexpr std::size_t kEncoderBytes = 64;
constexpr Duration kEncoderPeriod = 1ms;
// Every network needs longer for 1 GB.
Duration filling_time(int megabytes_per_s) { return megabytes_per_s == 1 ? 60s : 8s; }
constexpr std::uint64_t kManyFrames = (1U << 30) / kFrameBytes;

[[noreturn]] void write_encoder_and_frames(const std::string& socket,
                                           std::atomic<bool>& is_filled) {
  Session session = Session::connect({.socket_path = socket}).value();
  RawWriter frames = session
                         .create_raw({"camera", 0, ""}, {"", kFrameBytes, 1, {}},
                                     History{kManyFrames + 2, kPeriod})
                         .value();
  const std::vector<std::byte> frame(kFrameBytes, std::byte{1});
  for (std::uint64_t i = 0; i < kManyFrames; ++i) frames.write(frame, WallClock::now());
  RawWriter encoder = session
                          .create_raw({"encoder", 0, ""}, {"", kEncoderBytes, 1, {}},
                                      History{10'000, kEncoderPeriod})
                          .value();
  const std::vector<std::byte> sample(kEncoderBytes);
  is_filled.store(true);
  for (MonoTime next = MonoClock::now();;) {
    sleep_until(next += kEncoderPeriod);
    encoder.write(sample, WallClock::now());
  }
}

// How long each sample of the encoder took until a program on the other PC had it.
std::vector<double> one_way_times(RawReader& encoder, Duration how_long) {
  std::vector<std::byte> payload(kEncoderBytes);
  std::vector<double> times;
  encoder.seek(encoder.newest_tid());
  const std::uint64_t lost = encoder.lost_samples();
  for (const MonoTime end = MonoClock::now() + how_long; MonoClock::now() < end;) {
    static_cast<void>(encoder.wait(end));
    for (SampleInfo info; encoder.read_next(payload, info) == ReadStatus::ok;) {
      times.push_back(age_ns(info.time));
    }
  }
  if (encoder.lost_samples() != lost) fail("samples of the encoder were lost");
  return times;
}

void measure_beside(test::Network& network, const Hosts& hosts, int megabytes_per_s) {
  const std::string rate = std::to_string(megabytes_per_s * 8) + "mbit";
  if (!network.shape(2, "tbf rate " + rate + " burst 256kb latency 10ms")) return;
  const auto owner = hosts.start_owner("error");
  const std::string socket = owner->socket_path();
  auto& is_filled = shared<std::atomic<bool>>();
  const pid_t writer = in_child([&] { write_encoder_and_frames(socket, is_filled); });
  while (!is_filled.load()) ::usleep(10'000);
  {
    const auto other = hosts.start_other(*owner);
    Session session = Session::connect({.socket_path = other->socket_path()}).value();
    RawReader encoder =
        session.await_raw_reader(StreamId{"encoder", 0, "pc1"}, deadline_in(60s)).value();
    one_way_times(encoder, 1s);
    const Duration filling_for = filling_time(megabytes_per_s);
    const Figures alone = figures_of(one_way_times(encoder, filling_for));
    RawReader camera = session
                           .await_raw_reader(StreamId{"camera", 0, "pc1"}, deadline_in(60s),
                                             nullptr, FetchHistory::at_once)
                           .value();
    const auto filling = [&] { return session.stream_info(camera.id()).value().mirror.value(); };
    const std::uint64_t before = filling().received_bytes;
    const Figures beside = figures_of(one_way_times(encoder, filling_for));
    const double carried = static_cast<double>(filling().received_bytes - before) /
                           std::chrono::duration<double>(filling_for).count() / 1e6;
    const std::string tail = ", " + std::to_string(megabytes_per_s) + " MB/s [ms]";
    print_row("  encoder alone" + tail,
              {alone.min / 1e6, alone.median / 1e6, alone.p99 / 1e6, alone.p999 / 1e6});
    char rest[96];
    std::snprintf(rest, sizeof rest, "%7.2f  %.0f MB/s of history", beside.p99 / alone.p99,
                  carried);
    print_row("encoder beside a history" + tail,
              {beside.min / 1e6, beside.median / 1e6, beside.p99 / 1e6, beside.p999 / 1e6}, rest);
  }
  end_child(writer);
}

void use_cubic(const Hosts& hosts) {
  for (const int host : {1, 2}) {
    const auto inside = hosts.inside(host);
    std::ofstream("/proc/sys/net/ipv4/tcp_congestion_control") << "cubic\n";
  }
}

}  // namespace

int main(int argc, char** argv) {
  auto network = test::Network::open(2);
  if (!network) {
    std::printf("--- SKIPPED: %s\n", network.error().message.c_str());
    return 0;
  }
  test::Network& shaped = **network;
  const Hosts hosts(*std::move(network));
  use_cubic(hosts);
  print_head();
  const bool only_beside = argc > 1 && std::string(argv[1]) == "beside";
  for (const int megabytes_per_s : {1, 10, 60, 110}) {
    if (!only_beside) measure_link(shaped, hosts, megabytes_per_s);
    measure_beside(shaped, hosts, megabytes_per_s);
  }
}
