// SPDX-License-Identifier: Apache-2.0
//
// Signals and the remote interface: Ctrl-C ends its waits, and terminate() in a handler, at any
// moment, ends all that follows without harm. Arguments: FOLDER ADDRESS.
#include "dssm.hpp"
#include "signals.h"

namespace {

struct Sample {
  double a[32];
};

const char* address;

void signals_end_the_waits() {
  on_signal(SIGALRM, count, true);
  DSSMApi<Sample> nowhere("storm", 0, "127.0.0.1:1"), never("never", 0, address);
  catch_stderr();
  alarm_after(50000, 50000);
  CHECK(!nowhere.initRemote());
  CHECK(!never.open());
  alarm_after(0, 0);
  CHECK_TEXT(caught_stderr(), "interrupted");
  CHECK(handled > 0);
}

DSSMApi<Sample>*source, *sink, *buffered;

void terminate_all(int) {
  source->terminate();
  sink->release();
  buffered->terminate();
  handled = 1;
}

int storm_child(int kind, int ready_fd) {
  alarm(60);  // a deadlock ends here, and is seen by the parent
  source = new DSSMApi<Sample>("storm", 0, address);
  sink = new DSSMApi<Sample>("storm", 1, address);
  buffered = new DSSMApi<Sample>("storm", 0, address);
  if (!source->open() || !source->createDataCon()) return 1;
  if (!sink->create(1.0, 0.1) || !sink->createDataCon()) return 2;
  if (!buffered->open(SSM_READ_BUFFER) || !buffered->createDataCon()) return 3;
  buffered->readyRingBuf();
  on_signal(SIGINT, terminate_all, true);
  handled = 0;
  if (write(ready_fd, "r", 1) != 1) return 4;
  while (!handled) {
    switch (kind) {
      case 0:
        source->readLast();
        break;
      case 1:
        source->readTime(gettimeSSM() - 0.5);
        break;
      case 2:
        sink->write();
        break;
      case 3:
        buffered->readNextBuf();
        break;
      default:
        buffered->readTimeBuf(gettimeSSM() - 0.5);
        source->getTID_top();
        break;
    }
  }
  if (source->readNew() || sink->write() || buffered->readLastBuf() || source->isOpen()) return 5;
  source->terminate();
  delete source;
  delete sink;
  delete buffered;
  return 0;
}

DSSMApi<Sample>* storm_writer;

void write_some() {
  for (int i = 0; i < 20; ++i) storm_writer->write();
}

void storm(int rounds) {
  DSSMApi<Sample> writer("storm", 0, address);
  storm_writer = &writer;
  CHECK(writer.create(0.3, 0.1) && writer.createDataCon() && writer.write());
  srandom(static_cast<unsigned>(getpid()));
  printf("seed %d\n", getpid());
  for (int round = 0; round < rounds; ++round) {
    interrupt_child(storm_child, round % 5, write_some, 2000);
  }
}

// Control loops that read and write from a timer's handler, in the midst of the main loop's.
DSSMApi<Sample>*main_loops, *handlers;
int handler_calls = 0, handler_reads = 0;
time_t last_call = 0;

bool are_enough_calls() { return handler_calls >= 500 || time(nullptr) >= last_call; }

void read_and_write(int) {
  ++handler_calls;
  // On a busy machine a call takes longer than the timer, and leaves the main loop no time.
  if (are_enough_calls()) alarm_after(0, 0);
  if (handlers->readLast() && handlers->write()) ++handler_reads;
  if (buffered->readLastBuf()) handled = handled + 1;
}

void calls_in_handlers_fail_or_work() {
  DSSMApi<Sample> one("storm", 0, address), other("storm", 0, address), third("storm", 0, address);
  main_loops = &one;
  handlers = &other;
  buffered = &third;
  CHECK(one.open() && one.createDataCon() && other.open() && other.createDataCon());
  CHECK(third.open() && third.createDataCon());
  third.readyRingBuf();
  while (!third.readNewBuf()) usleep(1000);
  handled = 0;
  on_signal(SIGALRM, read_and_write, true);
  last_call = time(nullptr) + 20;
  alarm_after(200, 200);
  while (!are_enough_calls()) CHECK(one.readLast());
  alarm_after(0, 0);
  CHECK(handled > 0);
  CHECK(other.readLast() && one.write());
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  address = argv[2];
  storm(50);
  signals_end_the_waits();
  calls_in_handlers_fail_or_work();
  check_sigpipe();
  return check_result();
}
