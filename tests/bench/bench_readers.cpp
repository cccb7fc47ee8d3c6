// SPDX-License-Identifier: Apache-2.0
//
// The cost of readers for a writer: alone, with 1 and with 32 reading processes, and with one of
// them stopped by SIGSTOP. Each reader reads the newest sample 1,000 times a second, on the other
// core. The raw limit is the writer alone, measured in the same run right before and after.
#include <sched.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <csignal>
#include <dssm/dssm.hpp>

#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

using Bytes64 = std::array<std::byte, 64>;

void pin(int cpu) {
  cpu_set_t set;
  CPU_ZERO(&set);
  CPU_SET(static_cast<unsigned>(cpu), &set);
  ::sched_setaffinity(0, sizeof set, &set);
}

pid_t start_reader(const std::string& socket) {
  const pid_t pid = ::fork();
  if (pid != 0) return pid;
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  pin(1);
  Session session = Session::connect({.socket_path = socket}).value();
  Reader<Bytes64> reader = session.await_reader<Bytes64>("busy").value();
  Bytes64 payload;
  SampleInfo info;
  for (;;) {
    (void)reader.read_newest(payload, info);
    ::usleep(1000);
  }
}

// Waits until dssmd counts `wanted` readers.
void await_readers(Session& session, std::uint32_t wanted) {
  while (session.stream_info(StreamId{"busy", 0, ""}).value().readers != wanted) ::usleep(1000);
}

std::vector<double> write_batches(Writer<Bytes64>& writer, int batches) {
  std::vector<double> ns;
  const Bytes64 payload{};
  std::int64_t time = 0;
  auto write = [&] { writer.write(payload, time_from_ns(++time)); };
  for (int i = 0; i < batches; ++i) ns.push_back(time_batch(1000, write));
  return ns;
}

}  // namespace

int main() {
  test::DaemonProcess daemon;
  pin(0);
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  Writer<Bytes64> writer = session.create<Bytes64>("busy", History{1000, 1ms}).value();
  write_batches(writer, 1000);
  print_head();
  std::vector<pid_t> readers;
  const auto compare = [&](const std::string& name, std::size_t count, bool stop_one) {
    std::vector<double> alone = write_batches(writer, 10'000);
    while (readers.size() < count) readers.push_back(start_reader(daemon.socket_path()));
    await_readers(session, static_cast<std::uint32_t>(count));
    if (stop_one) ::kill(readers[0], SIGSTOP);
    const Figures with = figures_of(write_batches(writer, 20'000));
    for (const pid_t pid : readers) ::kill(pid, SIGKILL), ::waitpid(pid, nullptr, 0);
    readers.clear();
    await_readers(session, 0);
    const std::vector<double> after = write_batches(writer, 10'000);
    alone.insert(alone.end(), after.begin(), after.end());
    print_pair("write 64 B alone", name, {figures_of(std::move(alone)), with}, "<= 1.05");
  };
  compare("write 64 B with 0 readers (noise)", 0, false);
  compare("write 64 B with 1 reader", 1, false);
  compare("write 64 B with 32 readers", 32, false);
  compare("write 64 B with 32 readers, 1 stopped", 32, true);
}
