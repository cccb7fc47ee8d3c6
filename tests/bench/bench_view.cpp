// SPDX-License-Identifier: Apache-2.0
//
// dssm-view beside the programs of a vehicle: 100 streams of 64 B at 1 kHz, and three clients: a
// page that shows curves and samples, Foxglove with all streams, and another one that stands still.
// How long writes take and how late a waiting reader gets a sample, alone and beside it;
// dssm-view's processor time and memory. The raw limit is a process that sends as many bytes as the
// clients got, each 10 ms, by TCP over the loopback interface.
#include <cinttypes>
#include <cstring>
#include <dssm/dssm.hpp>
#include <fstream>
#include <string>
#include <thread>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kStreams = 100;
constexpr int kRounds = 5;
constexpr Duration kRoundTime = 4s;
constexpr std::uint64_t kRoundWrites = kRoundTime / 1ms;

struct Motion {
  double x;
  float speed[12];
  std::int64_t written_ns;
};
DSSM_DESCRIBE(Motion, x, speed, written_ns)
static_assert(sizeof(Motion) == 64);

std::string name_of(int stream) { return "motion" + std::to_string(stream); }

// What the writer and the reader measure; a round is measured when `round` changes to its number.
struct Measured {
  std::atomic<std::uint32_t> round = 0;
  std::atomic<std::uint32_t> wrote = 0, read = 0;  // rounds that have ended
  double write_ns[kRoundWrites];
  double late_ns[kRoundWrites];
};

void write_all(const std::string& socket, Measured& measured) {
  Session session = Session::connect({.socket_path = socket}).value();
  std::vector<Writer<Motion>> writers;
  for (int i = 0; i < kStreams; ++i) {
    writers.push_back(session.create<Motion>(name_of(i), {2000, 1ms}).value());
  }
  std::uint64_t count = kRoundWrites;
  std::uint32_t round = 0;
  Motion motion{};
  for (MonoTime tick = MonoClock::now();; tick += 1ms) {
    sleep_until(tick);
    if (measured.round != round) round = measured.round, count = 0;
    for (int i = 0; i < kStreams; ++i) {
      motion.x += 0.001;
      motion.written_ns = now_ns();
      writers[static_cast<std::size_t>(i)].write(motion);
      if (i == 0 && count < kRoundWrites) {
        measured.write_ns[count] = static_cast<double>(now_ns() - motion.written_ns);
        if (++count == kRoundWrites) measured.wrote = round;
      }
    }
  }
}

void read_one(const std::string& socket, Measured& measured) {
  Session session = Session::connect({.socket_path = socket}).value();
  auto reader = session.await_reader<Motion>(name_of(kStreams / 2)).value();
  std::uint64_t count = kRoundWrites;
  std::uint32_t round = 0;
  for (;;) {
    (void)reader.wait(1s);
    const auto sample = reader.read_next();
    if (!sample) continue;
    if (measured.round != round) round = measured.round, count = 0;
    if (count == kRoundWrites) continue;
    measured.late_ns[count] = static_cast<double>(now_ns() - sample->value.written_ns);
    if (++count == kRoundWrites) measured.read = round;
  }
}

// The client's end of a WebSocket (RFC 6455), to a server that behaves.
class WebSocket {
 public:
  WebSocket(std::uint16_t port, const std::string& subprotocol)
      : fd_(::socket(AF_INET, SOCK_STREAM, 0)) {
    const sockaddr_in address{AF_INET, htons(port), {htonl(INADDR_LOOPBACK)}, {}};
    if (::connect(fd_, reinterpret_cast<const sockaddr*>(&address), sizeof address) != 0) {
      fail("connect to dssm-view");
    }
    const std::string request =
        "GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
        "Sec-WebSocket-Protocol: " +
        subprotocol + "\r\n\r\n";
    send_all(fd_, request.data(), request.size());
    std::string answer;
    for (char byte = 0; !answer.ends_with("\r\n\r\n"); answer += byte) receive_all(fd_, &byte, 1);
    if (!answer.starts_with("HTTP/1.1 101")) fail("become a WebSocket");
  }
  WebSocket(const WebSocket&) = delete;
  WebSocket& operator=(const WebSocket&) = delete;
  ~WebSocket() { ::close(fd_); }

  // With a mask of zeros: the text as it is.
  void send(const std::string& text) {
    std::string frame = "\x81";
    if (text.size() < 126) {
      frame += static_cast<char>(0x80U | text.size());
    } else {
      frame += static_cast<char>(0x80U | 126U);
      frame += static_cast<char>(text.size() >> 8U);
      frame += static_cast<char>(text.size());
    }
    frame += std::string(4, '\0') + text;
    send_all(fd_, frame.data(), frame.size());
  }

  // The next message, of which only the first bytes are kept.
  std::string receive() {
    bool is_last = false;
    std::string message;
    while (!is_last) {
      unsigned char head[2], more[8];
      take(head, 2);
      is_last = (head[0] & 0x80U) != 0;
      std::uint64_t bytes = head[1] & 0x7fU;
      const std::size_t length_bytes = bytes == 126 ? 2 : bytes == 127 ? 8 : 0;
      take(more, length_bytes);
      for (std::size_t i = 0; i < length_bytes; ++i) bytes = (i ? bytes << 8U : 0) | more[i];
      payload_.resize(bytes);
      take(payload_.data(), bytes);
      message.append(payload_, 0, kKept - std::min(kKept, message.size()));
    }
    return message;
  }
  std::uint64_t received() const { return received_; }

 private:
  static constexpr std::size_t kKept = 1U << 20;
  void take(void* data, std::size_t bytes) {
    auto* at = static_cast<char*>(data);
    received_ += bytes;
    while (bytes > 0) {
      if (begin_ == end_) {
        const ssize_t got = ::recv(fd_, buffer_, sizeof buffer_, 0);
        if (got <= 0) fail("receive from dssm-view");
        begin_ = 0, end_ = static_cast<std::size_t>(got);
      }
      const std::size_t some = std::min(bytes, end_ - begin_);
      std::memcpy(at, buffer_ + begin_, some);
      at += some, bytes -= some, begin_ += some;
    }
  }

  int fd_;
  char buffer_[1U << 16];
  std::size_t begin_ = 0, end_ = 0;
  std::string payload_;
  std::uint64_t received_ = 0;
};

struct Received {
  std::atomic<std::uint64_t> bytes = 0, messages = 0;
};

// As the page does: samples 20 times a second, curves ten times, the overview once.
void show_page(std::uint16_t port, Received& received) {
  WebSocket page(port, "dssm.view.v1");
  std::string streams;
  for (int i = 0; i < 10; ++i) streams += (i ? ",\"" : "\"") + name_of(i) + ":0@pc1\"";
  const auto ask = [&](const std::string& request) {
    const std::uint64_t before = page.received();
    page.send(R"({"id":1,)" + request + "}");
    page.receive();
    received.bytes += page.received() - before;
    ++received.messages;
  };
  int turn = 0;
  for (MonoTime tick = MonoClock::now();; tick += 50ms, ++turn) {
    sleep_until(tick);
    ask(R"("op":"at","streams":[)" + streams + R"(],"t_ns":null)");
    if (turn % 2 == 0) {
      ask(R"("op":"signals","stream":"motion0:0@pc1","span_ns":"1000000000","points":1000,)"
          R"("fields":["x","speed[0]","speed[1]","speed[2]"])");
    }
    if (turn % 20 == 0) ask(R"("op":"overview")");
  }
}

// Subscribes to all streams. With `received` counts what comes, else reads nothing any more.
void follow_all(std::uint16_t port, Received* received) {
  WebSocket foxglove(port, "foxglove.sdk.v1");
  std::string subscriptions;
  for (std::size_t found = 0; found < kStreams;) {
    const std::string message = foxglove.receive();
    constexpr std::string_view kChannel = "{\"id\":";
    for (std::size_t at = 0; (at = message.find(kChannel, at)) != std::string::npos; ++found) {
      at += kChannel.size();  // of messages only a list of channels has ids
      const std::string id = message.substr(at, message.find(',', at) - at);
      subscriptions += (found ? R"(,{"id":)" : R"({"id":)") + id + R"(,"channelId":)" + id + "}";
    }
  }
  foxglove.send(R"({"op":"subscribe","subscriptions":[)" + subscriptions + "]}");
  while (received == nullptr) ::pause();
  for (std::uint64_t before = foxglove.received();;) {
    foxglove.receive();
    const std::uint64_t now = foxglove.received();
    received->bytes += now - std::exchange(before, now);
    ++received->messages;
  }
}

pid_t start_view(const std::string& socket, std::uint16_t& port) {
  int output[2];
  if (::pipe(output) != 0) fail("pipe");
  const pid_t pid = test::start({test::built("client/view/dssm-view"), "--listen", "127.0.0.1:0",
                                 "--socket", socket, "--pages", test::source("client/view/web")},
                                {}, output[1]);
  ::close(output[1]);
  std::string line;
  for (char byte = 0; byte != '\n'; line += byte) {
    if (::read(output[0], &byte, 1) != 1) fail("start dssm-view");
  }
  port = static_cast<std::uint16_t>(std::stoi(line.substr(line.rfind(':') + 1)));
  return pid;
}

double resident_mib(pid_t pid) {
  std::ifstream status("/proc/" + std::to_string(pid) + "/status");
  for (std::string line; std::getline(status, line);) {
    if (line.starts_with("VmRSS:")) return std::stod(line.substr(6)) / 1024;
  }
  return 0;
}

// A process that sends `bytes` each 10 ms to one that reads them.
pid_t start_raw(std::size_t bytes) {
  int ends[2];
  const int listener = ::socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{AF_INET, 0, {htonl(INADDR_LOOPBACK)}, {}};
  socklen_t length = sizeof address;
  ends[0] = ::socket(AF_INET, SOCK_STREAM, 0);
  if (::bind(listener, reinterpret_cast<sockaddr*>(&address), length) != 0 ||
      ::listen(listener, 1) != 0 ||
      ::getsockname(listener, reinterpret_cast<sockaddr*>(&address), &length) != 0 ||
      ::connect(ends[0], reinterpret_cast<sockaddr*>(&address), length) != 0) {
    fail("connect by TCP");
  }
  ends[1] = ::accept(listener, nullptr, nullptr);
  in_child([&] {
    std::vector<char> buffer(1U << 20);
    while (::recv(ends[1], buffer.data(), buffer.size(), 0) > 0) {
    }
  });
  const pid_t sender = in_child([&] {
    const std::vector<char> data(bytes);
    for (MonoTime tick = MonoClock::now();; tick += 10ms) {
      sleep_until(tick);
      send_all(ends[0], data.data(), data.size());
    }
  });
  for (const int fd : {listener, ends[0], ends[1]}) ::close(fd);
  return sender;
}

}  // namespace

int main() {
  test::DaemonProcess daemon;
  const std::string socket = daemon.socket_path();
  auto& measured = shared<Measured>();
  auto& page = shared<Received>();
  auto& foxglove = shared<Received>();
  const pid_t writer = in_child([&] { write_all(socket, measured); });
  const pid_t reader = in_child([&] { read_one(socket, measured); });

  std::vector<double> alone, beside, late_alone, late_beside, view_cpu, raw_cpu;
  const auto run = [&](std::vector<double>& writes, std::vector<double>& late) {
    const std::uint32_t round = ++measured.round;
    while (measured.wrote != round || measured.read != round) sleep_until(MonoClock::now() + 10ms);
    writes.insert(writes.end(), std::begin(measured.write_ns), std::end(measured.write_ns));
    late.insert(late.end(), std::begin(measured.late_ns), std::end(measured.late_ns));
  };
  // Processor time of `pid` per second, in ms, while `run` runs.
  const auto cpu_of = [](pid_t pid, auto measure) {
    const std::int64_t cpu = cpu_ns(pid), began = now_ns();
    measure();
    return 1e3 * static_cast<double>(cpu_ns(pid) - cpu) / static_cast<double>(now_ns() - began);
  };
  double bytes_per_second = 0, messages_per_second = 0, page_answers = 0, begin_mib = 0,
         end_mib = 0;
  for (int round = 0; round < kRounds; ++round) {
    run(alone, late_alone);
    std::uint16_t port = 0;
    const pid_t view = start_view(socket, port);
    const pid_t clients = in_child([&] {
      std::thread first([&] { show_page(port, page); });
      std::thread second([&] { follow_all(port, &foxglove); });
      follow_all(port, nullptr);
    });
    const std::uint64_t first = foxglove.messages;
    while (foxglove.messages < first + 1000) sleep_until(MonoClock::now() + 10ms);
    if (round == 0) begin_mib = resident_mib(view);
    const std::uint64_t bytes = page.bytes + foxglove.bytes;
    const std::uint64_t messages = foxglove.messages, answers = page.messages;
    const std::int64_t began = now_ns();
    view_cpu.push_back(cpu_of(view, [&] { run(beside, late_beside); }));
    const double seconds = static_cast<double>(now_ns() - began) / 1e9;
    bytes_per_second +=
        static_cast<double>(page.bytes + foxglove.bytes - bytes) / seconds / kRounds;
    messages_per_second += static_cast<double>(foxglove.messages - messages) / seconds / kRounds;
    page_answers += static_cast<double>(page.messages - answers) / seconds / kRounds;
    end_mib = std::max(end_mib, resident_mib(view));
    end_child(clients);
    ::kill(view, SIGTERM);
    test::wait_for(view);

    const pid_t raw =
        start_raw(static_cast<std::size_t>(bytes_per_second * kRounds / (round + 1) / 100));
    raw_cpu.push_back(cpu_of(raw, [] { sleep_until(MonoClock::now() + kRoundTime); }));
    end_child(raw);
  }
  end_child(writer);
  end_child(reader);

  std::printf("clients got %.2f MB/s: %.0f samples/s of %d, and %.1f answers/s\n",
              bytes_per_second / 1e6, messages_per_second, kStreams * 1000, page_answers);
  std::printf("dssm-view's memory: %.1f MiB, at most %.1f MiB\n", begin_mib, end_mib);
  print_head();
  print_pair("64 B write, alone", "beside dssm-view and three clients",
             {figures_of(alone), figures_of(beside)}, "1");
  print_pair("write to read at 1 kHz, alone", "beside dssm-view and three clients",
             {figures_of(late_alone), figures_of(late_beside)}, "1");
  print_pair("send these bytes each 10 ms, CPU [ms/s]", "dssm-view, CPU [ms/s]",
             {figures_of(raw_cpu), figures_of(view_cpu)}, "");
  return 0;
}
