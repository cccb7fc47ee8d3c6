/* SPDX-License-Identifier: Apache-2.0
 *
 * The C interface's samples: tids and the readable window, reading by tid and by time, callbacks,
 * waiting, and what comes back when there is nothing.
 */
#include <libssm.h>

#include "check.h"

typedef struct {
  double x;
  int n;
} Sample;

static Sample sample(int n) {
  Sample s;
  memset(&s, 0, sizeof(s));
  s.n = n;
  s.x = n * 0.5;
  return s;
}

static SSM_tid put(SSM_sid sid, int n, double time) {
  Sample s = sample(n);
  return writeSSM(sid, &s, time);
}

static void zero_sid(void) {
  SSM_sid sid = 0;
  Sample s = sample(1);
  ssmTimeT time = 7;
  CHECK_EQUAL(getTID(sid, 1.0), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(getTID_top(sid), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(getTID_bottom(sid), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(waitTID(sid, 0), -1);
  CHECK(getClockErrorSSM(sid, 0) < 0);
  CHECK_EQUAL(readSSM(sid, &s, &time, -1), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(readSSM_time(sid, &s, 1.0, &time), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(readSSMP(sid, &s, &time, -1, NULL, NULL), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(readSSMP_time(sid, &s, 1.0, &time, NULL, NULL), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(writeSSM(sid, &s, 1.0), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(writeSSM_time(sid, &s, 1.0), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(writeSSMP(sid, &s, 1.0, NULL, NULL), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(writeSSMP_time(sid, &s, 1.0, NULL, NULL), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(s.n, 1);
  CHECK_SAME(time, 7);
}

static void foreign_sid(void) { /* what was never a sid is refused, not followed */
  static char nonsense[64];
  SSM_sid sid = nonsense;
  CHECK_EQUAL(getTID_top(sid), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(readSSM(sid, nonsense, NULL, -1), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(closeSSM(&sid), 1);
  CHECK(sid == 0);
}

static void empty_stream(void) {
  SSM_sid sid = createSSM("void", 0, sizeof(Sample), 1, 0.1);
  Sample s = sample(77);
  ssmTimeT time = 7;
  CHECK_EQUAL(getTID_top(sid), -1);
  CHECK_EQUAL(getTID_bottom(sid), -1);
  CHECK_EQUAL(readSSM(sid, &s, &time, -1), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(readSSM(sid, &s, &time, -100), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(readSSM(sid, &s, &time, 0), SSM_ERROR_FUTURE);
  CHECK(readSSM_time(sid, &s, 1.0, &time) < 0);
  CHECK_EQUAL(readSSM_time(sid, &s, 0.0, &time), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(getTID(sid, 1.0), SSM_ERROR_NO_DATA);
  CHECK_EQUAL(s.n, 77);
  CHECK_SAME(time, 7);
  CHECK_EQUAL(waitTID(sid, -1), 1); /* at once */
  releaseSSM(&sid);
  CHECK_EQUAL(waitTID(sid, -1), -1);
}

static void readable_window(void) {
  SSM_sid sid = createSSM("window", 0, sizeof(Sample), 1, 0.1);
  Sample s;
  ssmTimeT time = 0;
  int i;
  CHECK_EQUAL(put(sid, 0, 1000), 0); /* tids start at 0 */
  CHECK_EQUAL(getTID_bottom(sid), 0);
  for (i = 1; i < 12; ++i) CHECK_EQUAL(put(sid, i, 1000 + i * 0.1), i);
  CHECK_EQUAL(getTID_bottom(sid), 0);
  for (i = 12; i < 20; ++i) CHECK_EQUAL(put(sid, i, 1000 + i * 0.1), i);
  CHECK_EQUAL(getTID_top(sid), 19); /* 20 writes into 13 slots */
  CHECK_EQUAL(getTID_bottom(sid), 8);
  CHECK_EQUAL(shm_get_address(sid)->tid_top, 19);
  for (i = 8; i < 20; ++i) {
    CHECK_EQUAL(readSSM(sid, &s, &time, i), i);
    CHECK_EQUAL(s.n, i);
    CHECK_SAME(time, 1000 + i * 0.1);
  }
  s = sample(77);
  time = 7;
  CHECK_EQUAL(readSSM(sid, &s, &time, 7), SSM_ERROR_PAST);
  CHECK_EQUAL(readSSM(sid, &s, &time, 0), SSM_ERROR_PAST);
  CHECK_EQUAL(readSSM(sid, &s, &time, 20), SSM_ERROR_FUTURE);
  CHECK_EQUAL(readSSM(sid, &s, &time, 2147483647), SSM_ERROR_FUTURE);
  CHECK_EQUAL(s.n, 77); /* nothing stored */
  CHECK_SAME(time, 7);
  CHECK_EQUAL(readSSM(sid, &s, NULL, -5), 19); /* any negative number: the newest */
  CHECK_EQUAL(s.n, 19);
  CHECK_SAME(getClockErrorSSM(sid, 19), 0); /* of this PC's clock */
  CHECK_SAME(getClockErrorSSM(sid, -1), 0);
  CHECK(getClockErrorSSM(sid, 7) < 0);
  releaseSSM(&sid);

  sid = createSSM("window2", 0, sizeof(Sample), 0.1, 0.1); /* two slots: only the newest */
  for (i = 0; i < 3; ++i) put(sid, i, i + 1);
  CHECK_EQUAL(getTID_bottom(sid), 2);
  CHECK_EQUAL(readSSM(sid, &s, NULL, 1), SSM_ERROR_PAST);
  CHECK_EQUAL(readSSM(sid, &s, NULL, 2), 2);
  releaseSSM(&sid);
}

static void by_time(void) {
  SSM_sid sid = createSSM("bytime", 0, sizeof(Sample), 1, 0.1);
  Sample s;
  ssmTimeT time = 0;
  int i;
  for (i = 0; i < 20; ++i) put(sid, i, 1700000000.25 + i * 0.5); /* held: 8 to 19 */
  for (i = 8; i < 20; ++i) {
    const double exact = 1700000000.25 + i * 0.5;
    CHECK_EQUAL(readSSM_time(sid, &s, exact, &time), i);
    CHECK_SAME(time, exact);
    CHECK_EQUAL(s.n, i);
    CHECK_EQUAL(readSSM_time(sid, &s, exact + 0.4, NULL), i);
    CHECK_EQUAL(readSSM_time(sid, &s, exact + 1e-6, NULL), i);
    if (i > 8) CHECK_EQUAL(readSSM_time(sid, &s, exact - 1e-6, NULL), i - 1);
    CHECK_EQUAL(getTID(sid, exact + 1e-6), i); /* strictly less than */
    CHECK_EQUAL(getTID(sid, exact), i == 8 ? SSM_ERROR_PAST : i - 1);
  }
  CHECK_EQUAL(readSSM_time(sid, &s, 0, &time), 19);
  CHECK_EQUAL(readSSM_time(sid, &s, -3, &time), 19);
  CHECK_EQUAL(readSSM_time(sid, &s, 1800000000, &time), 19); /* later than all: no error */
  CHECK_SAME(time, 1700000000.25 + 19 * 0.5);
  s = sample(77);
  time = 7;
  CHECK_EQUAL(readSSM_time(sid, &s, 1700000000.25 + 8 * 0.5 - 0.001, &time), SSM_ERROR_PAST);
  CHECK_EQUAL(readSSM_time(sid, &s, 1.0, &time), SSM_ERROR_PAST);
  CHECK_EQUAL(s.n, 77);
  CHECK_SAME(time, 7);
  CHECK_EQUAL(getTID(sid, 1.0), SSM_ERROR_PAST);
  CHECK_EQUAL(getTID(sid, 1800000000), 19);
  releaseSSM(&sid);
}

static void strange_times(void) {
  SSM_sid sid = createSSM("strange", 0, sizeof(Sample), 1, 0.1);
  Sample s;
  ssmTimeT time = 0;
  put(sid, 0, 10);
  put(sid, 1, 20);
  put(sid, 2, 20);
  put(sid, 3, 20);
  CHECK_EQUAL(readSSM_time(sid, &s, 20, &time), 3); /* the newest of equal ones */
  CHECK_EQUAL(readSSM_time(sid, &s, 19.5, &time), 0);
  put(sid, 4, 15); /* backwards: the newest tid with time <= t */
  CHECK_EQUAL(readSSM_time(sid, &s, 16, &time), 4);
  CHECK_EQUAL(readSSM_time(sid, &s, 14, &time), 0);
  put(sid, 5, 0); /* stored as given */
  CHECK_EQUAL(readSSM(sid, &s, &time, 5), 5);
  CHECK_SAME(time, 0);
  put(sid, 6, -12.5);
  CHECK_EQUAL(readSSM(sid, &s, &time, 6), 6);
  CHECK_SAME(time, -12.5);
  put(sid, 7, 0.1);
  CHECK_EQUAL(readSSM(sid, &s, &time, 7), 7);
  CHECK_SAME(time, 0.1);
  releaseSSM(&sid);
}

static void exact_times(void) { /* what was written comes back, to the last bit */
  SSM_sid sid = createSSM("exact", 0, sizeof(Sample), 1, 0.1);
  Sample s;
  ssmTimeT time, now;
  int i;
  for (i = 0; i < 1000; ++i) {
    now = gettimeSSM_real() + i * 0.0009765625;
    time = 0;
    put(sid, i, now);
    CHECK_EQUAL(readSSM_time(sid, &s, now, &time), i);
    CHECK_SAME(time, now);
  }
  releaseSSM(&sid);
}

static int calls;

static void pack(void *ssmp, const void *data, void *user_data) {
  Sample s;
  ++calls;
  memcpy(&s, data, sizeof(s));
  s.n += *(int *)user_data;
  memcpy(ssmp, &s, sizeof(s));
}

static void unpack(const void *ssmp, void *data, void *user_data) {
  Sample s;
  ++calls;
  memcpy(&s, ssmp, sizeof(s));
  s.n -= *(int *)user_data;
  memcpy(data, &s, sizeof(s));
}

static void overrun(void *ssmp, const void *data, void *user_data) {
  (void)data;
  (void)user_data;
  memset(ssmp, 0xaa, sizeof(Sample) + 8);
}

static void callbacks(void) {
  SSM_sid sid = createSSM("call", 0, sizeof(Sample), 0.3, 0.1);
  int shift = 1000, i;
  Sample s = sample(1);
  ssmTimeT time = 0;
  CHECK_EQUAL(writeSSMP(sid, &s, 5.0, pack, &shift), 0);
  CHECK_EQUAL(writeSSMP_time(sid, &s, 6.0, pack, &shift), 1);
  CHECK_EQUAL(calls, 2);
  CHECK_EQUAL(readSSM(sid, &s, NULL, 0), 0);
  CHECK_EQUAL(s.n, 1001);
  CHECK_EQUAL(readSSMP(sid, &s, &time, 0, unpack, &shift), 0);
  CHECK_EQUAL(s.n, 1);
  CHECK_SAME(time, 5);
  CHECK_EQUAL(readSSMP_time(sid, &s, 6.5, &time, unpack, &shift), 1); /* user_data arrives */
  CHECK_EQUAL(s.n, 1);
  CHECK_SAME(time, 6);
  CHECK_EQUAL(calls, 4);
  CHECK_EQUAL(readSSMP(sid, &s, &time, 9, unpack, &shift), SSM_ERROR_FUTURE);
  CHECK_EQUAL(readSSMP_time(sid, &s, 4.0, &time, unpack, &shift), SSM_ERROR_PAST);
  CHECK_EQUAL(calls, 4); /* no call without a sample */

  /* Callbacks that write 8 bytes too far do no harm to any sample. */
  for (i = 2; i < 12; ++i) {
    if (i % 2) {
      CHECK_EQUAL(writeSSMP(sid, &s, i, overrun, NULL), i);
    } else {
      CHECK_EQUAL(put(sid, i, i), i);
    }
  }
  for (i = getTID_bottom(sid); i <= getTID_top(sid); ++i) {
    CHECK_EQUAL(readSSM(sid, &s, &time, i), i);
    CHECK_SAME(time, i);
    if (i % 2 == 0) CHECK_EQUAL(s.n, i);
  }
  releaseSSM(&sid);
}

static SSM_sid nested_sid;

static void write_inside(void *ssmp, const void *data, void *user_data) {
  (void)user_data;
  memcpy(ssmp, data, sizeof(Sample));
  CHECK(writeSSM(nested_sid, data, 1.0) < 0); /* hung the old one for ever */
}

static void nested_write(void) {
  Sample s = sample(3);
  nested_sid = createSSM("nested", 0, sizeof(Sample), 1, 0.1);
  CHECK_EQUAL(writeSSMP(nested_sid, &s, 1.0, write_inside, NULL), 0);
  CHECK_EQUAL(put(nested_sid, 4, 2.0), 1);
  releaseSSM(&nested_sid);
}

static void waiting(void) {
  SSM_sid sid = createSSM("wait", 0, sizeof(Sample), 1, 0.1);
  double before;
  put(sid, 0, 1);
  CHECK_EQUAL(waitTID(sid, 0), 1);
  CHECK_EQUAL(waitTID(sid, -7), 1);
  before = gettimeSSM_real();
  CHECK_EQUAL(waitTID(sid, 1), 0);
  CHECK(gettimeSSM_real() - before > 0.9); /* one second, by another clock */
  releaseSSM(&sid);
}

static void closed_sid(void) { /* an old sid is recognised, however many came after it */
  SSM_sid old = createSSM("closed", 0, sizeof(Sample), 1, 0.1), copy = old, next;
  Sample s = sample(0);
  int i;
  releaseSSM(&old);
  for (i = 0; i < 300; ++i) {
    next = openSSM("closed", 0, 0);
    CHECK(next != 0 && next != copy);
    CHECK_EQUAL(readSSM(copy, &s, NULL, -1), SSM_ERROR_NO_DATA);
    CHECK_EQUAL(writeSSM(copy, &s, 1.0), SSM_ERROR_NO_DATA);
    old = copy;
    CHECK_EQUAL(closeSSM(&old), 1); /* again: must not close `next` */
    CHECK_EQUAL(writeSSM(next, &s, 1.0), i);
    closeSSM(&next);
  }
}

int main(int argc, char **argv) {
  check_begin(argc, argv);
  CHECK_EQUAL(initSSM(), 1);
  zero_sid();
  foreign_sid();
  empty_stream();
  readable_window();
  by_time();
  strange_times();
  exact_times();
  callbacks();
  nested_write();
  waiting();
  closed_sid();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
