// SPDX-License-Identifier: Apache-2.0
//
// Signals: programs that close everything and end SSM inside their SIGINT handler, while the main
// loop is anywhere; waits that signals end, and waits that they do not shorten.
#include <libssm.h>

#include <ssm.hpp>

#include "signals.h"

namespace {

struct Sample {
  double a[32];
};

// --- the storm: one child per round, ended by SIGINT at a random moment

SSMApi<Sample> source("storm", 0), sink("storm", 1), opened("storm", 0);
SSMApiBase* const all[] = {&source, &sink, &opened};

void close_all_and_end(int) {
  for (size_t i = 0; i < sizeof(all) / sizeof(all[0]); ++i) all[i]->close();
  endSSM();
  handled = 1;
}

void copy_in(void* ssmp, const void* data, void*) { memcpy(ssmp, data, sizeof(Sample)); }
void copy_out(const void* ssmp, void* data, void*) { memcpy(data, ssmp, sizeof(Sample)); }

void work(int kind) {
  switch (kind) {
    case 0:
      source.readLast();
      break;
    case 1:
      source.readTime(gettimeSSM() - 0.5);
      break;
    case 2:
      sink.write();
      break;
    case 3:
      source.setBlocking(true);
      source.setVerbose(false);
      source.readNext();
      break;
    case 4:
      writeSSMP(sink.getSSMId(), &sink.data, 1.0, copy_in, NULL);
      if (readSSMP(sink.getSSMId(), &sink.data, NULL, -1, copy_out, NULL) < -3) abort();
      break;
    case 5:
      waitTID(sink.getSSMId(), 1 << 30);
      break;
    case 6:  // into the middle of asking dssmd, and of allocating
      opened.setVerbose(false);
      opened.open();
      opened.close();
      break;
    case 7:
      usleepSSM(100);
      getSSM_info("storm", 0, NULL, NULL, NULL, NULL);
      break;
    default:
      initSSM();  // again and again; the handler's endSSM may fall into it
      break;
  }
}

const int kKinds = 9;

// The child of one round. Its exit status is 0 unless something went wrong.
int storm_child(int kind, int ready_fd) {
  alarm(60);  // a deadlock ends here, and is seen by the parent
  if (!initSSM()) return 1;
  if (!source.open() || !sink.create(1.0, 0.1)) return 2;
  on_signal(SIGINT, close_all_and_end, false);
  if (write(ready_fd, "r", 1) != 1) return 3;
  while (!handled) work(kind);
  // As real programs do: a call or two more, then everything once more.
  usleepSSM(10);
  source.readNew();
  source.setBlocking(false);
  sink.write();
  if (kind != 6 && kind != 8) {
    if (source.isOpen() || sink.isOpen() || source.readLast() || sink.write()) return 4;
    const double real = gettimeSSM_real();
    if (gettimeSSM() < real) return 5;
  }
  if (strcmp(source.getStreamName(), "storm") != 0) return 6;
  for (size_t i = 0; i < sizeof(all) / sizeof(all[0]); ++i) all[i]->close();
  endSSM();
  return 0;
}

// A process that writes without a pause, once its stream is there.
pid_t start_writer() {
  int ready[2];
  if (pipe(ready) != 0) abort();
  const pid_t pid = fork();
  if (pid == 0) {
    SSMApi<Sample> writer("storm", 0);
    if (!initSSM() || !writer.create(0.3, 0.1) || !writer.write() || write(ready[1], "r", 1) != 1) {
      _exit(1);
    }
    for (;;) writer.write();
  }
  await_byte(ready);
  return pid;
}

// This process itself does not register before the storm is over: what the children inherit are
// plain objects.
void storm(int rounds, unsigned seed) {
  printf("seed %u\n", seed);
  srandom(seed);
  const pid_t writer = start_writer();
  for (int round = 0; round < rounds; ++round) {
    interrupt_child(storm_child, round % kKinds, NULL, 1500);
  }
  kill(writer, SIGKILL);
  waitpid(writer, NULL, 0);
}

// --- waits and signals

SSMApi<Sample> own("own", 0);
int handler_reads = 0, handler_writes = 0;

void close_own(int) { own.close(); }

void signals_do_not_shorten_wait_tid(bool restart) {
  CHECK(own.create(1.0, 0.1));
  handled = 0;
  on_signal(SIGALRM, count, restart);
  alarm_after(20000, 20000);
  const double before = gettimeSSM_real();
  CHECK_EQUAL(waitTID(own.getSSMId(), getTID_top(own.getSSMId()) + 1), 0);
  CHECK(gettimeSSM_real() - before > 0.9);
  alarm_after(0, 0);
  CHECK(handled > 5);
}

void closing_ends_wait_tid() {
  CHECK(own.create(1.0, 0.1));
  on_signal(SIGALRM, close_own, false);
  alarm_after(20000, 0);
  CHECK_EQUAL(waitTID(own.getSSMId(), 1 << 30), -1);  // not 0: it did not sit out the second
  CHECK(!own.isOpen());
}

void signals_end_sleeps() {
  on_signal(SIGALRM, count, false);
  alarm_after(20000, 20000);
  CHECK_EQUAL(usleepSSM(3600000000U), -1);
  CHECK(!(!sleepSSM(3600.0)));
  alarm_after(0, 0);
}

void signals_end_open_wait() {
  SSMApi<Sample> never("never", 0);
  never.setVerbose(false);
  on_signal(SIGALRM, count, true);
  for (int i = 0; i < 50; ++i) {
    // Again and again: on a busy machine the first one may come before the wait begins.
    alarm_after(500 + i * 37, 20000);
    CHECK(!never.openWait());
  }
}

// Control loops that read and write from a timer's handler, in the midst of the main loop's reads.
void read_and_write(int) {
  if (own.getSSMId() == 0) return;
  Sample sample;
  if (readSSM(own.getSSMId(), &sample, NULL, -1) >= 0) ++handler_reads;
  if (writeSSM(own.getSSMId(), &sample, gettimeSSM()) >= 0) ++handler_writes;
}

void reading_in_handlers() {
  CHECK(own.create(1.0, 0.1) && own.write() && own.readLast());  // both directions are open now
  on_signal(SIGALRM, read_and_write, false);
  alarm_after(200, 200);
  long reads = 0;
  while (handler_reads < 500) {
    CHECK(own.readLast());
    if (++reads % 16 == 0) own.write();  // may be refused while the handler writes, never hangs
  }
  alarm_after(0, 0);
  CHECK(handler_writes > 0);
  CHECK(own.write());
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  storm(360, argc > 2 ? static_cast<unsigned>(atoi(argv[2])) : static_cast<unsigned>(getpid()));
  CHECK_EQUAL(initSSM(), 1);
  while (getSSM_node_num() != 1) usleep(1000);  // none of the children is left behind
  signals_do_not_shorten_wait_tid(false);
  signals_do_not_shorten_wait_tid(true);
  closing_ends_wait_tid();
  signals_end_sleeps();
  signals_end_open_wait();
  reading_in_handlers();
  check_sigpipe();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
