// SPDX-License-Identifier: Apache-2.0
//
// What SSM programs do with each sample, through SSM's C++ interface: compared with reading the
// clock once, and for large samples with memcpy of the same size. bench_copy.cpp has the native
// interface's rows.
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

#include "client/ssm/include/ssm.hpp"
#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm::bench;

namespace {

constexpr int kDepth = 1000;

void raw_clock() {
  timespec ts;
  ::clock_gettime(CLOCK_REALTIME, &ts);
  keep(ts);
}

void check(bool ok) {
  if (!ok) std::abort();
}

struct Small {
  double values[8];
};

void small() {
  SSMApi<Small> writer("small", 0), reader("small", 0);
  check(writer.create(kDepth * 0.001, 0.001) && reader.open());
  // Stamps of about now, in the steps that a double of today has.
  double time = gettimeSSM();
  constexpr double kCycle = 4.76837158203125e-7;  // 2^-21
  const auto write = [&] { check(writer.write(time += kCycle)); };
  for (int i = 0; i < 2 * kDepth; ++i) write();
  const auto row = [](const char* name, const char* target, const auto& ours) {
    print_pair("clock_gettime", std::string("64 B ") + name, measure(2000, 1000, raw_clock, ours),
               target);
  };
  row("write(time)", "<= 2.0", write);
  row("write()", "<= 2.0", [&] { check(writer.write()); });
  for (int i = 0; i < 2 * kDepth; ++i) write();
  row("readLast()", "<= 1.0", [&] { check(reader.readLast()); });
  row("readNew(), nothing new", "<= 1.0", [&] { check(!reader.readNew()); });
  // Of the samples that the ring holds, so that each call finds another one.
  double wanted = 0;
  const double first = time - (kDepth / 2) * kCycle;
  row("readTime()", "<= 1.0", [&] {
    wanted = wanted < kDepth / 2 - 1 ? wanted + 1 : 0;
    check(reader.readTime(first + wanted * kCycle));
  });
  print_pair("write(time)", "write(time), readNew()",
             measure(2000, 1000, write,
                     [&] {
                       write();
                       check(reader.readNew());
                     }),
             "<= 1.5");
}

template <std::size_t kBytes>
struct Large {
  char bytes[kBytes];
};

template <std::size_t kBytes>
void large() {
  const std::string size = std::to_string(kBytes / 1024) + " KiB";
  static SSMApi<Large<kBytes>> writer, reader;
  check(writer.create(("large" + size).c_str(), 0, 0.032, 0.001));
  check(reader.open(("large" + size).c_str()));
  for (int i = 0; i < 100; ++i) check(writer.write(1 + i * 0.001));
  static Large<kBytes> from, to;
  const auto copy = [&] {
    std::memcpy(&to, &from, kBytes);
    keep(to);
  };
  print_pair("memcpy " + size, size + " readLast()",
             measure(4000, 1, copy, [&] { check(reader.readLast()); }), "<= 1.2");
}

}  // namespace

int main() {
  dssm::test::DaemonProcess daemon;
  const std::string socket = daemon.environment();  // DSSM_SOCKET=...
  check(::putenv(const_cast<char*>(socket.c_str())) == 0 && initSSM());
  print_head();
  small();
  large<64 << 10>();
  large<1 << 20>();
  endSSM();
}
