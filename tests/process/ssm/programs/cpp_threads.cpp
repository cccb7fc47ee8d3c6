// SPDX-License-Identifier: Apache-2.0
//
// Threads: several use the same sids, the clock and the coordinator while one closes streams, ends
// SSM and begins anew. Data races are the thread sanitizer's to find; here it must only work.
#include <libssm.h>
#include <pthread.h>

#include "check.h"

namespace {

const int kRounds = 40;

struct Sample {
  long numbers[64];
};

struct Work {
  SSM_sid sid;
  long good, bad;
  int begun;  // something went well
  volatile int* stop;
};

int stopped(volatile int* stop) { return __atomic_load_n(stop, __ATOMIC_ACQUIRE); }

void note_begun(Work& work) {
  if (work.good > 0) __atomic_store_n(&work.begun, 1, __ATOMIC_RELEASE);
}

bool whole(const Sample& sample) {
  for (int i = 1; i < 64; ++i) {
    if (sample.numbers[i] != sample.numbers[0]) return false;
  }
  return true;
}

void fill(Sample& sample, long number) {
  for (int i = 0; i < 64; ++i) sample.numbers[i] = number;
}

void* write_samples(void* argument) {
  Work& work = *static_cast<Work*>(argument);
  Sample sample;
  for (long n = 0; !stopped(work.stop); ++n) {
    fill(sample, n);
    const SSM_tid tid = writeSSM(work.sid, &sample, gettimeSSM());
    if (tid >= 0) ++work.good;
    if (tid < 0 && tid != SSM_ERROR_NO_DATA) ++work.bad;
    note_begun(work);
  }
  return NULL;
}

void* read_samples(void* argument) {
  Work& work = *static_cast<Work*>(argument);
  Sample sample;
  ssmTimeT time = 0;
  while (!stopped(work.stop)) {
    SSM_tid tid = readSSM(work.sid, &sample, &time, -1);
    if (tid >= 0 && !whole(sample)) ++work.bad;
    if (tid >= 0) ++work.good;
    tid = readSSM_time(work.sid, &sample, time, NULL);
    if (tid >= 0 && !whole(sample)) ++work.bad;
    if (getTID_bottom(work.sid) > getTID_top(work.sid) && getTID_top(work.sid) >= 0) ++work.bad;
    if (shm_get_address(work.sid) != NULL) ++work.good;
    note_begun(work);
  }
  return NULL;
}

void* wait_for_samples(void* argument) {
  Work& work = *static_cast<Work*>(argument);
  while (!stopped(work.stop)) {
    if (waitTID(work.sid, getTID_top(work.sid) + 1) == 1) ++work.good;
    note_begun(work);
  }
  return NULL;
}

void* open_and_close(void* argument) {
  Work& work = *static_cast<Work*>(argument);
  Sample sample;
  for (long n = 0; !stopped(work.stop); ++n) {
    SSM_sid sid = openSSM("threads", 0, SSM_READ);
    if (sid != 0 && readSSM(sid, &sample, NULL, -1) >= 0) ++work.good;
    closeSSM(&sid);
    getSSM_num();
    settimeSSM_speed(1.0 + 0.001 * static_cast<double>(n % 3));
    if (gettimeSSM_speed() < 1.0) ++work.bad;
    note_begun(work);
  }
  return NULL;
}

void round_of_threads() {
  void* (*const bodies[])(void*) = {write_samples, write_samples,    read_samples,
                                    read_samples,  wait_for_samples, open_and_close};
  const unsigned count = sizeof(bodies) / sizeof(bodies[0]);
  pthread_t threads[count];
  Work works[count];
  volatile int stop = 0;
  CHECK_EQUAL(initSSM(), 1);
  SSM_sid sid = createSSM("threads", 0, sizeof(Sample), 1.0, 0.1);
  CHECK(sid != 0);
  for (unsigned i = 0; i < count; ++i) {
    Work work = {sid, 0, 0, 0, &stop};
    works[i] = work;
    pthread_create(&threads[i], NULL, bodies[i], &works[i]);
  }
  for (unsigned i = 0; i < count; ++i) {
    while (!__atomic_load_n(&works[i].begun, __ATOMIC_ACQUIRE)) usleep(100);
  }
  SSM_sid closing = sid;  // in the midst of all
  closeSSM(&closing);
  CHECK_EQUAL(endSSM(), 1);
  __atomic_store_n(&stop, 1, __ATOMIC_RELEASE);
  for (unsigned i = 0; i < count; ++i) {
    pthread_join(threads[i], NULL);
    CHECK_EQUAL(works[i].bad, 0);
  }
  CHECK_EQUAL(getTID_top(sid), SSM_ERROR_NO_DATA);
}

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  for (int i = 0; i < kRounds; ++i) round_of_threads();
  return check_result();
}
