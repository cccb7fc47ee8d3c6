/* SPDX-License-Identifier: Apache-2.0
 *
 * Signals in programs of C++98 style: handlers, timers, and children that are interrupted at random
 * moments.
 */
#ifndef TESTS_SSM_SIGNALS_H
#define TESTS_SSM_SIGNALS_H

#include <signal.h>
#include <sys/time.h>
#include <sys/wait.h>

#include "check.h"

namespace {

volatile sig_atomic_t handled = 0;

void count(int) { handled = handled + 1; }

void on_signal(int number, void (*handler)(int), bool restart) {
  struct sigaction action;
  memset(&action, 0, sizeof(action));
  action.sa_handler = handler;
  action.sa_flags = restart ? SA_RESTART : 0;
  sigaction(number, &action, NULL);
}

// SIGALRM after `first` and then every `next` microseconds (0: once).
void alarm_after(int first, int next) {
  itimerval timer;
  memset(&timer, 0, sizeof(timer));
  timer.it_value.tv_usec = first;
  timer.it_interval.tv_usec = next;
  setitimer(ITIMER_REAL, &timer, NULL);
}

// Waits until the other end of a pipe writes a byte; closes both ends here.
void await_byte(const int (&ends)[2]) {
  close(ends[1]);
  char byte;
  CHECK(read(ends[0], &byte, 1) == 1);
  close(ends[0]);
}

// A child that runs child(kind, fd), writes a byte to fd when it is ready, gets SIGINT up to
// `most_us` microseconds later, and must exit with 0.
void interrupt_child(int (*child)(int, int), int kind, void (*when_ready)(), int most_us) {
  int ready[2];
  if (pipe(ready) != 0) abort();
  fflush(stdout);
  const pid_t pid = fork();
  if (pid == 0) _exit(child(kind, ready[1]));
  await_byte(ready);
  if (when_ready) when_ready();
  usleep(static_cast<useconds_t>(random() % most_us));
  kill(pid, SIGINT);
  int status = 0;
  waitpid(pid, &status, 0);
  if (status != 0) printf("kind %d: wait status %x\n", kind, status);
  CHECK_EQUAL(status, 0);
}

// The library leaves SIGPIPE to the program.
void check_sigpipe() {
  struct sigaction action;
  sigaction(SIGPIPE, NULL, &action);
  CHECK(action.sa_handler == SIG_DFL);
}

}  // namespace

#endif
