// SPDX-License-Identifier: Apache-2.0
//
// How old the newest sample is on the reader's PC, when the link carries little more than the
// stream, or less: just after the stream was opened, later, and after the cable was cut. Beside
// it, bare TCP that sends the newest frame each time the last one is with the kernel.
//
// The stream is a camera's, 640 x 480 x 3 bytes 30 times a second (27.6 MB/s), with a history of
// 5 s. Then an encoder's stream, 64 bytes 1,000 times a second, alone, and beside a history of 1 GB
// that fills the same link. Beside these, bare TCP: small messages, and a connection that sends as
// much as 85 % of the link carries with both.
//
// Arguments: "camera" or "encoder" for one of them; "far" for links with 20 ms of round trip, all
// of it on the way back; then the links in MB/s, if not all.
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
constexpr Duration kCut = 20s;     // much longer than the history
constexpr Duration kWatched = 4s;  // after an event
constexpr Duration kPoll = 1ms;
constexpr Duration kFar = 20ms;
// With the headers of Ethernet, IP and TCP.
constexpr double kHeaderBytes = 66, kLargestPacket = 1514;

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

void print_ms(const std::string& name, const Figures& ns, const std::string& rest = "") {
  print_row(name, {ns.min / 1e6, ns.median / 1e6, ns.p99 / 1e6, ns.p999 / 1e6}, rest);
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
                double link_ns, Duration round_trip) {
  const Figures figures = figures_of(ages);
  const double target = 2 * link_ns + static_cast<double>(to_ns(5ms + round_trip)) +
                        static_cast<double>(to_ns(kPeriod));  // a frame may be as old when sent
  char rest[96];
  std::snprintf(rest, sizeof rest, "%7.2f  p99 <= %ld ms", figures.median / raw.median,
                std::lround(target / 1e6));
  print_ms(name, figures, rest);
}

// For the names of rows.
std::string tail_of(int megabytes_per_s, Duration round_trip) {
  return ", " + std::to_string(megabytes_per_s) + " MB/s" +
         (round_trip > Duration() ? ", far" : "") + " [ms]";
}

void measure_link(test::Network& network, const Hosts& hosts, int megabytes_per_s,
                  Duration round_trip) {
  const std::string rate = std::to_string(megabytes_per_s * 8) + "mbit";
  if (auto shaped = network.shape(2, "tbf rate " + rate + " burst 256kb latency 10ms"); !shaped) {
    std::printf("--- SKIPPED %d MB/s: %s\n", megabytes_per_s, shaped.error().message.c_str());
    return;
  }
  const std::string tail = tail_of(megabytes_per_s, round_trip);
  const Figures raw = raw_ages(hosts);
  print_ms("  raw TCP, newest frame" + tail, raw);
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
    const double link_ns = static_cast<double>(kFrameBytes) * 1e3 / megabytes_per_s *
                           kLargestPacket / (kLargestPacket - kHeaderBytes);
    print_ages("just after opening" + tail, raw, watch(kWatched, newest), link_ns, round_trip);
    print_ages("later" + tail, raw, watch(kWatched, newest), link_ns, round_trip);
    const auto print_first = [&](const std::string& after) {
      SampleInfo before, info;
      static_cast<void>(reader.read_newest(frame, before));
      const std::int64_t healed = now_ns();
      do {
        sleep_until(MonoClock::now() + kPoll);
        static_cast<void>(reader.read_newest(frame, info));
      } while (info.tid == before.tid);
      std::printf("%-44s %9.1f\n", ("  the first after a " + after + tail).c_str(),
                  static_cast<double>(now_ns() - healed) / 1e6);
    };
    network.block(2);
    std::this_thread::sleep_for(kCut);
    network.unblock(2);
    print_first("cut far away");
    network.cut(2);
    std::this_thread::sleep_for(kCut);
    network.heal(2);
    print_first("cut");
    print_ages("from then on" + tail, raw, watch(kWatched, newest), link_ns, round_trip);
  }
  end_child(writer);
}

// --- a small stream beside a large history

constexpr std::size_t kEncoderBytes = 64;
constexpr Duration kEncoderPeriod = 1ms;
// Every network needs longer for 1 GB.
constexpr Duration kFillingTime = 8s;
// Some tenths of a second measure what 1 MB/s is.
Duration filling_time(int megabytes_per_s) { return megabytes_per_s == 1 ? 60s : kFillingTime; }
constexpr std::uint64_t kManyFrames = (1U << 30) / kFrameBytes;

[[noreturn]] void send_small(int socket) {
  std::byte message[kEncoderBytes] = {};
  for (MonoTime next = MonoClock::now();;) {
    sleep_until(next += kEncoderPeriod);
    const std::int64_t time = to_ns(WallClock::now());
    std::memcpy(message, &time, sizeof time);
    send_all(socket, message, sizeof message);
  }
}

std::vector<double> raw_one_way_times(int socket, Duration how_long) {
  std::vector<double> times;
  for (const MonoTime end = MonoClock::now() + how_long; MonoClock::now() < end;) {
    std::byte message[kEncoderBytes];
    receive_all(socket, message, sizeof message);
    std::int64_t time = 0;
    std::memcpy(&time, message, sizeof time);
    times.push_back(age_ns(time_from_ns(time)));
  }
  return times;
}

// As far apart in memory as a history's.
constexpr std::size_t kRawFrames = 64;

[[noreturn]] void send_frames(int socket, std::uint64_t bytes_per_s) {
  if (::setsockopt(socket, SOL_SOCKET, SO_MAX_PACING_RATE, &bytes_per_s, sizeof bytes_per_s)) {
    fail("SO_MAX_PACING_RATE");
  }
  const std::vector<std::byte> frames(kRawFrames * kFrameBytes, std::byte{1});
  for (std::size_t at = 0;; at = (at + 1) % kRawFrames) {
    send_all(socket, frames.data() + at * kFrameBytes, kFrameBytes);
  }
}

[[noreturn]] void receive_frames(int socket) {
  std::vector<std::byte> frames(kRawFrames * kFrameBytes);
  for (std::size_t at = 0;; at = (at + 1) % kRawFrames) {
    receive_all(socket, frames.data() + at * kFrameBytes, kFrameBytes);
  }
}

void print_beside(const std::string& who, const std::string& what, const std::string& tail,
                  const std::vector<double>& alone_ns, const std::vector<double>& beside_ns) {
  const auto middle_p99 = [](const std::vector<double>& ns) {
    return figures_of(p99_of_parts(ns.data(), ns.data() + ns.size())).median;
  };
  const Figures alone = figures_of(alone_ns), beside = figures_of(beside_ns);
  print_ms(who + " alone" + tail, alone);
  char rest[128];
  std::snprintf(rest, sizeof rest, "%7.2f  of the p99; of ten parts' middle p99: %.2f",
                beside.p99 / alone.p99, middle_p99(beside_ns) / middle_p99(alone_ns));
  print_ms(who + " beside " + what + tail, beside, rest);
}

void measure_raw_beside(const Hosts& hosts, int megabytes_per_s, const std::string& tail) {
  const auto [small_out, small_in] = hosts.tcp_pair();
  const auto [large_out, large_in] = hosts.tcp_pair();
  const int out[] = {small_out, large_out}, in[] = {small_in, large_in};
  // 85 % of the link are for both, with the headers.
  constexpr double kSmallPerS =
      (kEncoderBytes + kHeaderBytes) * (std::chrono::seconds(1) / kEncoderPeriod);
  const auto rate = static_cast<std::uint64_t>((0.85e6 * megabytes_per_s - kSmallPerS) *
                                               (1 - kHeaderBytes / kLargestPacket));
  const pid_t sends_small = in_child([&] { send_small(out[0]); });
  ::close(out[0]);
  raw_one_way_times(in[0], 1s);
  const std::vector<double> alone = raw_one_way_times(in[0], kFillingTime);
  const pid_t receives = in_child([&] { receive_frames(in[1]); });
  const pid_t sends = in_child([&] { send_frames(out[1], rate); });
  ::close(out[1]);
  raw_one_way_times(in[0], 1s);
  const std::vector<double> beside = raw_one_way_times(in[0], kFillingTime);
  for (const pid_t child : {sends, receives, sends_small}) end_child(child);
  for (const int fd : in) ::close(fd);
  print_beside("  raw TCP", "more", tail, alone, beside);
}

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

void measure_beside(test::Network& network, const Hosts& hosts, int megabytes_per_s,
                    Duration round_trip) {
  const std::string rate = std::to_string(megabytes_per_s * 8) + "mbit";
  if (!network.shape(2, "tbf rate " + rate + " burst 256kb latency 10ms")) return;
  const std::string tail = tail_of(megabytes_per_s, round_trip);
  measure_raw_beside(hosts, megabytes_per_s, tail);
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
    const std::vector<double> alone = one_way_times(encoder, filling_for);
    RawReader camera = session
                           .await_raw_reader(StreamId{"camera", 0, "pc1"}, deadline_in(60s),
                                             nullptr, FetchHistory::at_once)
                           .value();
    const auto filling = [&] { return session.stream_info(camera.id()).value().mirror.value(); };
    const std::uint64_t before = filling().received_bytes;
    const std::vector<double> beside = one_way_times(encoder, filling_for);
    const double carried = static_cast<double>(filling().received_bytes - before) /
                           std::chrono::duration<double>(filling_for).count() / 1e6;
    print_beside("encoder", "a history", tail, alone, beside);
    std::printf("%-44s %9.1f\n", "  the history [MB/s]", carried);
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
  std::string which;
  std::vector<int> links;
  Duration round_trip{};
  for (int i = 1; i < argc; ++i) {
    const int link = std::atoi(argv[i]);
    if (link > 0) {
      links.push_back(link);
    } else if (argv[i] == std::string("far")) {
      round_trip = kFar;
    } else {
      which = argv[i];
    }
  }
  if (links.empty()) links = {1, 10, 60, 110};
  if (round_trip > Duration()) {
    const std::string delay = std::to_string(round_trip / 1ms) + "ms limit 100000";
    if (const auto far = shaped.shape(1, "netem delay " + delay); !far) {
      std::printf("--- SKIPPED: %s\n", far.error().message.c_str());
      return 0;
    }
  }
  for (const int megabytes_per_s : links) {
    if (which != "encoder") measure_link(shaped, hosts, megabytes_per_s, round_trip);
    if (which != "camera") measure_beside(shaped, hosts, megabytes_per_s, round_trip);
  }
}
