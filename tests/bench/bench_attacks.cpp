// SPDX-License-Identifier: Apache-2.0
//
// A stream at 1 kHz that another host reads, and `dssmctl ls`, while a program of this PC or a peer
// misuses dssmd: the latency from the writer to the sleeping reader, the samples lost, and the time
// of ls. Two hosts on loopback; the first rows are without an attack.
//
//   bench-attacks [WORD...]   only the attacks whose names contain one of these
#include <sys/un.h>

#include <cstring>
#include <dssm/dssm.hpp>
#include <functional>
#include <string>
#include <vector>

#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"
#include "tests/bench/harness.hpp"
#include "tests/bench/hosts.hpp"
#include "tests/support/frames.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kSamples = 5000;  // of an attack, one a millisecond
constexpr int kStreams = 1000;  // besides the one that is measured
constexpr int kFields = 200;    // of each

struct Shared {
  std::atomic<bool> ready{false};
  std::atomic<std::uint32_t> arrived{0}, listed{0};
  std::atomic<std::uint64_t> lost{0};
  double took_ns[kSamples];
  double ls_ns[10'000];
};

// --- what is measured

[[noreturn]] void read_mirror(const std::string& socket, Shared& out) {
  Session session = Session::connect({.socket_path = socket}).value();
  RawReader reader = session.await_raw_reader(StreamId{"chain", 0, "pc1"}, kNever).value();
  std::vector<std::byte> payload(reader.payload_bytes());
  SampleInfo info;
  reader.seek(reader.newest_tid());
  out.ready = true;
  for (;;) {
    static_cast<void>(reader.wait(kNever));
    while (reader.read_next(payload, info) == ReadStatus::ok) {
      std::int64_t sent_ns = 0;
      std::memcpy(&sent_ns, payload.data(), sizeof sent_ns);
      const std::uint32_t n = out.arrived.load(std::memory_order_relaxed);
      if (n < kSamples) out.took_ns[n] = static_cast<double>(now_ns() - sent_ns);
      out.arrived.store(n + 1, std::memory_order_release);
    }
    out.lost = reader.lost_samples();
  }
}

[[noreturn]] void list_again_and_again(const std::string& socket, Shared& out) {
  for (;;) {
    const std::int64_t begin = now_ns();
    const test::Finished ls =
        test::run({test::built("client/dssmctl/dssmctl"), "ls"}, {"DSSM_SOCKET=" + socket});
    if (ls.exit_status != 0) std::fprintf(stderr, "ls: %s", ls.err.c_str());
    out.ls_ns[out.listed++ % std::size(out.ls_ns)] = static_cast<double>(now_ns() - begin);
    ::usleep(100'000);
  }
}

// --- attackers

// A client that ignores all answers, and connects again when the other side has closed.
class Hostile {
 public:
  static Hostile local(const std::string& socket) {
    local::Request hello;
    hello.set_serial(1);
    hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
    return Hostile([socket] { return wire::connect_unix(socket).value(); },
                   wire::encode_frame(hello));
  }
  static Hostile remote(const std::string& address) {
    return Hostile(
        [address] {
          UniqueFd fd(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
          const auto number = wire::resolve_number(wire::Address::parse(address).value()).front();
          if (::connect(fd.get(), reinterpret_cast<const sockaddr*>(&number.storage),
                        number.length)) {
            fd.reset();
          }
          return fd;
        },
        wire::encode_frame(test::hello_frame(test::greeting_of("hostile", "attack"))));
  }

  void send(std::string_view bytes) {
    if (!fd_) connect();
    while (!bytes.empty() && fd_) {
      const ssize_t sent = ::send(fd_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
      if (sent <= 0) return fd_.reset();
      bytes.remove_prefix(static_cast<std::size_t>(sent));
    }
  }
  // Without waiting for the other side to take them.
  void send_some(std::string_view bytes) {
    if (!fd_) connect();
    if (fd_ && ::send(fd_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL | MSG_DONTWAIT) < 0 &&
        errno != EAGAIN) {
      fd_.reset();
    }
  }
  // As much as the other side takes at once; erases it.
  void send_part(std::string& bytes) {
    if (!fd_) connect();
    if (!fd_) return;
    const ssize_t sent = ::send(fd_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
    if (sent < 0 && errno != EAGAIN) return fd_.reset();
    if (sent > 0) bytes.erase(0, static_cast<std::size_t>(sent));
  }
  bool is_connected() const { return static_cast<bool>(fd_); }
  // Whatever comes; false: nothing more.
  bool receive(std::size_t bytes) {
    static std::vector<char> space(1U << 20);
    while (bytes > 0 && fd_) {
      const ssize_t got = ::recv(fd_.get(), space.data(), std::min(bytes, space.size()), 0);
      if (got <= 0) {
        fd_.reset();
        return false;
      }
      bytes -= static_cast<std::size_t>(got);
    }
    return static_cast<bool>(fd_);
  }
  // What has come.
  void receive_some() {
    static std::vector<char> space(1U << 16);
    while (fd_ && ::recv(fd_.get(), space.data(), space.size(), MSG_DONTWAIT) > 0) {
    }
  }
  void leave() { fd_.reset(); }

 private:
  Hostile(std::function<UniqueFd()> connect, std::string hello)
      : connect_(std::move(connect)), hello_(std::move(hello)) {}
  void connect() {
    fd_ = connect_();
    if (!fd_) return static_cast<void>(::usleep(1000));
    if (::send(fd_.get(), hello_.data(), hello_.size(), MSG_NOSIGNAL) < 0) fd_.reset();
  }

  std::function<UniqueFd()> connect_;
  std::string hello_;
  UniqueFd fd_;
};

std::string local_frame(const std::function<void(local::Request&)>& fill) {
  local::Request request;
  request.set_serial(7);
  fill(request);
  return wire::encode_frame(request);
}
std::string network_frame(const std::function<void(net::Frame&)>& fill) {
  net::Frame frame;
  frame.set_serial(7);
  fill(frame);
  return wire::encode_frame(frame);
}
template <class Request>
void set_property(Request& request) {
  request.mutable_set_property()->mutable_id()->set_name("s0");
  request.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
}
template <class Request>
void get_property(Request& request) {
  request.mutable_get_property()->mutable_id()->set_name("s1");
}

// --- small samples over many connections of one peer

// The other host of this benchmark has some of the connections of the same address.
constexpr int kConnections = 120;

std::string open_small() {
  return wire::encode_frame(test::with_serial(1, test::open_frame("small")));
}

class Publisher {
 public:
  Publisher(const std::string& address, int number)
      : to_(Hostile::remote(address)), number_(static_cast<std::uint64_t>(number)) {}

  void go_on() {
    if (!to_.is_connected()) begin();
    if (rest_.empty()) add_samples();
    to_.send_part(rest_);
    to_.receive_some();
  }

 private:
  void begin() {
    rest_ = open_small() +
            wire::encode_frame(test::with_serial(2, test::start_publishing_frame(number_)));
  }
  void add_samples() {
    for (int i = 0; i < 1000; ++i) {
      const test::Bytes bytes =
          test::sample_bytes({next_, time_from_ns(next_), Duration()}, test::Bytes(8), 0);
      rest_.append(reinterpret_cast<const char*>(bytes.data()), bytes.size());
      ++next_;
    }
  }

  Hostile to_;
  const std::uint64_t number_;
  Tid next_ = 0;
  std::string rest_;
};

void publish_small(const std::string& address) {
  std::vector<Publisher> publishers;
  for (int i = 0; i < kConnections; ++i) publishers.emplace_back(address, i + 1);
  for (;;) {
    for (Publisher& one : publishers) one.go_on();
  }
}

void subscribe_to_small(const std::string& address) {
  net::Frame subscribe;
  subscribe.set_serial(2);
  subscribe.mutable_subscribe()->set_from_now(true);
  const std::string requests = open_small() + wire::encode_frame(subscribe);
  std::vector<Hostile> readers;
  for (int i = 0; i < kConnections - 1; ++i) {
    readers.push_back(Hostile::remote(address));
    readers.back().send(requests);
  }
  Publisher publisher(address, 1);
  for (;;) {
    publisher.go_on();
    for (Hostile& one : readers) one.receive_some();
  }
}

struct Attack {
  const char* name;
  std::function<void(const std::string& socket, const std::string& address)> run;  // without end
};

const std::vector<Attack>& attacks() {
  static const std::string list = local_frame([](local::Request& r) { r.mutable_list(); });
  static const std::string many_lists = [] {
    std::string all;
    for (int i = 0; i < 16; ++i) all += list;
    return all;
  }();
  static const std::string watch = local_frame([](local::Request& r) { r.mutable_watch(); });
  const auto never_read = [](const std::string& frame) {
    return [frame](const std::string& socket, const std::string&) {
      std::vector<Hostile> many;
      for (int i = 0; i < 20; ++i) many.push_back(Hostile::local(socket));
      for (;;) {
        for (Hostile& one : many) one.send_some(frame);
        ::usleep(1000);
      }
    };
  };
  static const std::vector<Attack> all = {
      {"16 lists at once, read slowly",
       [](const std::string& socket, const std::string&) {
         Hostile hostile = Hostile::local(socket);
         for (;;) {
           hostile.send_some(many_lists);
           for (int i = 0; i < 100; ++i) {
             hostile.receive(1U << 20);
             ::usleep(10'000);
           }
         }
       }},
      {"20 programs ask for lists and never read", never_read(list)},
      {"20 programs watch and never read", never_read(watch)},
      {"a program watches again and again",
       [](const std::string& socket, const std::string&) {
         Hostile hostile = Hostile::local(socket);
         for (;;) {
           hostile.send(watch);
           hostile.receive(1U << 20);
         }
       }},
      {"a program sets a property of 1 MiB",
       [](const std::string& socket, const std::string&) {
         const std::string frame = local_frame(set_property<local::Request>);
         Hostile hostile = Hostile::local(socket);
         for (;;) hostile.send(frame);
       }},
      {"500 programs watch, one sets properties",
       [](const std::string& socket, const std::string&) {
         const std::string frame = local_frame([](local::Request& request) {
           request.mutable_set_property()->mutable_id()->set_name("s0");
           request.mutable_set_property()->set_property("p");
         });
         Hostile hostile = Hostile::local(socket);
         std::vector<Hostile> many;
         for (int i = 0; i < 500; ++i) {
           many.push_back(Hostile::local(socket));
           many.back().send(watch);
         }
         for (;;) {
           for (int i = 0; i < 16; ++i) hostile.send(frame);
           for (Hostile& one : many) one.receive_some();
           hostile.receive_some();
         }
       }},
      {"a program gets a property of 1 MiB",
       [](const std::string& socket, const std::string&) {
         const std::string frame = local_frame(get_property<local::Request>);
         Hostile hostile = Hostile::local(socket);
         for (;;) {
           hostile.send(frame);
           hostile.receive(wire::kMaxPropertyBytes);
         }
       }},
      {"a program sends 1 MiB of empty fields",
       [](const std::string& socket, const std::string&) {
         std::string fields;
         while (fields.size() < (1U << 20) - 100) fields += std::string("\x22\x00", 2);
         const std::string frame = local_frame([&](local::Request& request) {
           request.mutable_create()->mutable_id()->set_name("bomb");
           request.mutable_create()->mutable_type()->MergeFromString(fields);
         });
         Hostile hostile = Hostile::local(socket);
         for (;;) hostile.send(frame);
       }},
      {"programs come and go",
       [](const std::string& socket, const std::string&) {
         Hostile hostile = Hostile::local(socket);
         for (;;) {
           hostile.send(list.substr(0, 1));
           hostile.leave();
         }
       }},
      {"a peer sets a property of 1 MiB",
       [](const std::string&, const std::string& address) {
         const std::string frame = network_frame(set_property<net::Frame>);
         Hostile hostile = Hostile::remote(address);
         for (;;) hostile.send(frame);
       }},
      {"a peer gets a property of 1 MiB",
       [](const std::string&, const std::string& address) {
         const std::string frame = network_frame(get_property<net::Frame>);
         Hostile hostile = Hostile::remote(address);
         for (;;) {
           hostile.send(frame);
           hostile.receive(wire::kMaxPropertyBytes);
         }
       }},
      {"a peer asks for lists",
       [](const std::string&, const std::string& address) {
         const std::string frame = network_frame([](net::Frame& f) { f.mutable_list(); });
         Hostile hostile = Hostile::remote(address);
         for (;;) {
           hostile.send(frame);
           hostile.receive(50'000);
         }
       }},
      {"a peer watches again and again",
       [](const std::string&, const std::string& address) {
         const std::string frame = network_frame([](net::Frame& f) { f.mutable_watch(); });
         Hostile hostile = Hostile::remote(address);
         for (;;) {
           hostile.send(frame);
           hostile.receive(1U << 20);
         }
       }},
      {"20 peers send 1 MiB of empty messages",
       [](const std::string&, const std::string& address) {
         std::string fields;
         while (fields.size() < (1U << 20) - 100) fields += std::string("\x0a\x00", 2);
         const std::string frame = network_frame(
             [&](net::Frame& message) { message.mutable_stream_list()->MergeFromString(fields); });
         std::vector<Hostile> many;
         for (int i = 0; i < 20; ++i) many.push_back(Hostile::remote(address));
         for (;;) {
           for (Hostile& one : many) one.send_some(frame);
         }
       }},
      {"120 connections publish samples of 8 B",
       [](const std::string&, const std::string& address) { publish_small(address); }},
      {"119 connections subscribe to samples of 8 B",
       [](const std::string&, const std::string& address) { subscribe_to_small(address); }},
      {"peers send garbage and come again",
       [](const std::string&, const std::string& address) {
         Hostile hostile = Hostile::remote(address);
         const std::string garbage(1000, '\xee');
         for (;;) {
           hostile.send(garbage);
           hostile.leave();
         }
       }},
  };
  return all;
}

// --- rounds

void measure(const std::string& name, const test::DaemonProcess& owner, RawWriter& writer,
             Shared& shared, const std::function<void()>& attack) {
  const pid_t attacker = attack ? in_child(attack) : -1;
  const std::uint64_t lost_before = shared.lost;
  shared.listed = 0;
  const std::string socket = owner.socket_path();
  const pid_t lister = in_child([&] { list_again_and_again(socket, shared); });
  ::usleep(300'000);
  std::vector<std::byte> payload(writer.payload_bytes());
  shared.arrived = 0;
  MonoTime next = MonoClock::now();
  for (int i = 0; i < kSamples; ++i) {
    sleep_until(next += 1ms);
    const std::int64_t now = now_ns();
    std::memcpy(payload.data(), &now, sizeof now);
    writer.write(payload, time_from_ns(now));
  }
  const MonoTime patience = MonoClock::now() + 10s;
  while (shared.arrived < kSamples && MonoClock::now() < patience) ::usleep(1000);
  end_child(lister);
  if (attack) end_child(attacker);
  const std::uint32_t arrived = std::min<std::uint32_t>(shared.arrived, kSamples);
  const std::uint32_t listed = shared.listed;
  const Figures wake = figures_of({shared.took_ns, shared.took_ns + std::max(1U, arrived)});
  const Figures ls = figures_of({shared.ls_ns, shared.ls_ns + std::max(1U, listed)});
  std::printf("%-44s %8.2f %8.2f %8.2f %6llu   %8.1f %8.1f %5u\n", name.c_str(), wake.median / 1e6,
              wake.p99 / 1e6, wake.p999 / 1e6,
              static_cast<unsigned long long>(shared.lost - lost_before + kSamples - arrived),
              ls.median / 1e6, ls.p999 / 1e6, listed);
  std::fflush(stdout);
}

// Streams whose types are long, as far as the attacks and ls list them.
std::vector<RawWriter> long_streams(Session& session) {
  std::vector<RawWriter> writers;
  for (int i = 0; i < kStreams; ++i) {
    TypeInfo type{"Long", kFields * 8, 8, {}};
    for (int field = 0; field < kFields; ++field) {
      type.fields.push_back(Field{"measured_value_" + std::to_string(field), Scalar::float64,
                                  static_cast<std::uint64_t>(field) * 8});
    }
    writers.push_back(
        session.create_raw({"s" + std::to_string(i), 0, ""}, type, History{2, 1s}).value());
  }
  const std::string property(wire::kMaxPropertyBytes, 'p');
  session.set_property({"s1", 0, ""}, std::as_bytes(std::span(property))).value();
  return writers;
}

bool is_wanted(const std::string& name, int count, char** words) {
  for (int i = 1; i < count; ++i) {
    if (name.find(words[i]) != std::string::npos) return true;
  }
  return count == 1;
}

}  // namespace

int main(int argc, char** argv) {
  const Hosts hosts;
  const auto owner = hosts.start_owner("error");
  const auto other = hosts.start_other(*owner);
  const std::string socket = owner->socket_path(), address = owner->address();
  Session session = Session::connect({.socket_path = socket}).value();
  RawWriter writer =
      session.create_raw({"chain", 0, ""}, {"", 64, 1, {}}, History{1000, 1ms}).value();
  auto& result = shared<Shared>();
  const std::string there = other->socket_path();
  const pid_t reader = in_child([&] { read_mirror(there, result); });
  while (!result.ready) ::usleep(1000);
  std::printf("%-44s %8s %8s %8s %6s   %8s %8s %5s\n", "ms from writer to reader; of dssmctl ls",
              "median", "p99", "p99.9", "lost", "median", "max", "times");
  measure("no attack", *owner, writer, result, {});
  const std::vector<RawWriter> streams = long_streams(session);
  measure("no attack, 1001 streams", *owner, writer, result, {});
  const RawWriter small =
      session.create_raw({"small", 0, ""}, {"", 8, 1, {}}, History{10'000, 1ms}).value();
  for (const Attack& attack : attacks()) {
    if (!is_wanted(attack.name, argc, argv)) continue;
    measure(attack.name, *owner, writer, result, [&] { attack.run(socket, address); });
  }
  end_child(reader);
}
