// SPDX-License-Identifier: Apache-2.0
//
// A program that reads all of steady_stream() from the oldest sample on, until its stdin ends;
// tests stop and continue it. It writes one byte to stdout after the first sample, and at the end a
// line "TAKEN LOST" about tids 0 to the newest one, or the errors (exit status 1).
//
//   steady_reader          through the local dssmd
//   steady_reader ADDRESS  with a PConnector to the owner's dssmd
#include <poll.h>
#include <unistd.h>

#include <cstdio>
#include <dssm/dssm.hpp>
#include <dssm/pconnector.hpp>

#include "tests/process/network/follower.hpp"
#include "tests/process/network/load.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct Outcome {
  std::uint64_t taken = 0, lost = 0;
  std::string faults;
};

bool stdin_ended() {
  pollfd in{STDIN_FILENO, POLLIN, 0};
  return ::poll(&in, 1, 0) > 0;
}

void report_begin() {
  if (::write(STDOUT_FILENO, "x", 1) != 1) std::exit(1);
}

Outcome read_mirror() {
  const KnownStream known = steady_stream();
  Session session = Session::connect({.request_timeout = std::chrono::minutes(2)}).value();
  Follower follower(known, session.await_raw_reader(known.id, kNever).value(), {});
  while (follower.taken() == 0) {
    (void)follower.reader().wait(kNever);
    follower.take(1);
  }
  report_begin();
  while (!stdin_ended()) {
    (void)follower.reader().wait(deadline_in(50ms));
    follower.take(1000);
  }
  const Tid newest = session.stream_info(known.id).value().newest;
  while (follower.last() < newest) {
    (void)follower.reader().wait_for_tid(newest, kNever);
    follower.take(1000);
  }
  return {follower.taken(), follower.lost(), follower.faults()};
}

Outcome read_by_connector(const std::string& address) {
  const KnownStream known = steady_stream();
  PConnector connector =
      PConnector::open(known.id, {.address = address, .request_timeout = std::chrono::minutes(2)})
          .value();
  connector.subscribe({.start = Subscription::Start::oldest}).value();
  std::vector<std::byte> payload(known.payload_bytes);
  SampleInfo info;
  Outcome outcome;
  Tid last = kNoTid;
  const auto take = [&](MonoTime deadline) {
    (void)connector.wait(deadline);
    for (;;) {
      const Result<ReadStatus> status = connector.read_next(payload, info);
      if (!status || *status != ReadStatus::ok) return;  // unavailable: the next call tries again
      if (info.tid <= last) outcome.faults += "tid " + std::to_string(info.tid) + " again\n";
      last = info.tid;
      outcome.faults += known.fault(payload, info, 1);
      ++outcome.taken;
    }
  };
  while (outcome.taken == 0) take(kNever);
  report_begin();
  while (!stdin_ended()) take(deadline_in(50ms));
  const Tid newest = connector.newest_tid().value();
  while (last < newest) take(kNever);
  outcome.lost = connector.lost_samples();
  if (outcome.taken + outcome.lost != static_cast<std::uint64_t>(last) + 1) {
    outcome.faults += std::to_string(outcome.taken) + " taken and " + std::to_string(outcome.lost) +
                      " lost up to tid " + std::to_string(last) + "\n";
  }
  return outcome;
}

}  // namespace
}  // namespace dssm::test

int main(int argc, char** argv) {
  using namespace dssm::test;
  const Outcome outcome = argc > 1 ? read_by_connector(argv[1]) : read_mirror();
  std::printf("%llu %llu\n%s", static_cast<unsigned long long>(outcome.taken),
              static_cast<unsigned long long>(outcome.lost), outcome.faults.c_str());
  return outcome.faults.empty() ? 0 : 1;
}
