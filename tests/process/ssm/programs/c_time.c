/* SPDX-License-Identifier: Apache-2.0
 *
 * SSM time: the clock's control, scaled sleeps, and real time without a clock. A sleep that is not
 * scaled down shows as a program that does not end; no upper time is asserted.
 */
#include <libssm.h>

#include "check.h"

/* Whether SSM time is what the setting says, taken between two looks at the real time. */
static void check_clock(double speed, double offset) {
  const double before = gettimeSSM_real() * speed + offset;
  const double ssm = gettimeSSM();
  const double after = gettimeSSM_real() * speed + offset;
  CHECK(speed < 0 ? (after <= ssm && ssm <= before) : (before <= ssm && ssm <= after));
}

static void without_clock(void) {
  double before;
  check_clock(1, 0);
  CHECK(timecontrol == NULL);
  CHECK_SAME(gettimeSSM_speed(), 1.0);
  CHECK_EQUAL(gettimeSSM_is_pause(), 0);
  CHECK_EQUAL(gettimeSSM_is_reverse(), 0);
  CHECK_SAME(gettimeOffset(), 0.0);
  CHECK_EQUAL(settimeSSM(5.0), 0);
  CHECK_EQUAL(settimeSSM_speed(2.0), 0);
  CHECK_EQUAL(settimeSSM_is_pause(1), 0);
  inittimeSSM();
  settimeOffset(3.0);
  check_clock(1, 0);
  before = gettimeSSM_real();
  CHECK_EQUAL(usleepSSM(20000), 0);
  CHECK_EQUAL((long)sleepSSM(0.02), 0);
  CHECK(gettimeSSM_real() - before > 0.039);
}

static void settings(void) {
  double frozen;
  check_clock(1, 0); /* dssmd starts it with offset 0, speed 1 */
  settimeOffset(100.0);
  CHECK_SAME(gettimeOffset(), 100.0);
  check_clock(1, 100.0);
  CHECK_EQUAL(settimeSSM(500.0), 1);
  CHECK(gettimeSSM() >= 500.0 && gettimeSSM() < 10000.0);
  CHECK_EQUAL(settimeSSM_speed(2.0), 1);
  CHECK_SAME(gettimeSSM_speed(), 2.0);
  CHECK(gettimeSSM() >= 500.0 && gettimeSSM() < 10000.0); /* no jump */
  check_clock(2.0, gettimeOffset());
  CHECK_SAME(timecontrol->speed, 2.0);
  CHECK_SAME(timecontrol->offset, gettimeOffset());

  CHECK_EQUAL(settimeSSM_is_reverse(1), 1);
  CHECK_SAME(gettimeSSM_speed(), -2.0);
  CHECK_EQUAL(gettimeSSM_is_reverse(), 1);
  CHECK_EQUAL(settimeSSM_is_reverse(1), 1);
  CHECK_SAME(gettimeSSM_speed(), -2.0);
  check_clock(-2.0, gettimeOffset());
  CHECK_EQUAL(settimeSSM_is_reverse(0), 1);
  CHECK_SAME(gettimeSSM_speed(), 2.0);
  CHECK_EQUAL(gettimeSSM_is_reverse(), 0);

  CHECK_EQUAL(settimeSSM_is_pause(1), 1);
  CHECK_EQUAL(gettimeSSM_is_pause(), 1);
  frozen = gettimeSSM();
  usleepSSM(2000);
  CHECK_SAME(gettimeSSM(), frozen);
  CHECK_SAME(timecontrol->pausetime, frozen);
  CHECK_EQUAL(timecontrol->is_pause, 1);
  CHECK_EQUAL(settimeSSM_speed(4.0), 1); /* a changed speed leaves the frozen time */
  CHECK(gettimeSSM() > frozen - 1e-6 && gettimeSSM() < frozen + 1e-6);
  CHECK_EQUAL(settimeSSM(1234.5), 1); /* setting moves a paused clock too */
  CHECK_SAME(gettimeSSM(), 1234.5);
  CHECK_EQUAL(settimeSSM_is_pause(0), 1); /* and it goes on from there */
  CHECK(gettimeSSM() > 1234.5 - 1e-5 && gettimeSSM() < 10000.0); /* a difference of doubles of 7e9 */
  CHECK_EQUAL(settimeSSM_speed(0.0), 1); /* 0 freezes */
  frozen = gettimeSSM();
  usleepSSM(2000); /* unscaled */
  CHECK_SAME(gettimeSSM(), frozen);
  inittimeSSM();
  CHECK_SAME(gettimeSSM_speed(), 1.0);
  CHECK_SAME(gettimeOffset(), 0.0);
  check_clock(1, 0);
}

static void sleeps(void) {
  double before;
  CHECK_EQUAL(settimeSSM_speed(0.1), 1);
  before = gettimeSSM_real();
  CHECK_EQUAL(usleepSSM(5000), 0);
  CHECK(gettimeSSM_real() - before > 0.0499);
  CHECK_EQUAL(settimeSSM_speed(10000.0), 1);
  CHECK_EQUAL((long)sleepSSM(1000.5), 0); /* 0.1 s */
  CHECK_EQUAL(usleepSSM(1000000000), 0);
  CHECK_EQUAL(settimeSSM_speed(-10000.0), 1); /* backwards: a second and more failed at once */
  before = gettimeSSM_real();
  CHECK_EQUAL((long)sleepSSM(1000.0), 0);
  CHECK(gettimeSSM_real() - before > 0.0999);
  CHECK_EQUAL(settimeSSM_is_pause(1), 1); /* pausing does not stop sleeps */
  CHECK_EQUAL((long)sleepSSM(100.0), 0);
  CHECK_EQUAL(settimeSSM_is_pause(0), 1);
  CHECK(sleepSSM(-1.0) == 4294967295U);
  inittimeSSM();
#if defined(_POSIX_C_SOURCE) && _POSIX_C_SOURCE >= 199309L
  {
    struct timespec span;
    span.tv_sec = 1000;
    span.tv_nsec = 500000000;
    CHECK_EQUAL(settimeSSM_speed(100000.0), 1);
    CHECK_EQUAL(nanosleepSSM(&span, NULL), 0);
    span.tv_sec = -1;
    CHECK_EQUAL(nanosleepSSM(&span, NULL), -1);
    span.tv_sec = 0;
    span.tv_nsec = 1000000000;
    CHECK_EQUAL(nanosleepSSM(&span, NULL), -1);
    inittimeSSM();
  }
#endif
}

static void attaching(void) {
  CHECK_EQUAL(settimeSSM_speed(3.0), 1);
  closetimeSSM();
  CHECK(timecontrol == NULL);
  check_clock(1, 0);
  CHECK_EQUAL(settimeSSM_speed(5.0), 0);
  CHECK_EQUAL(opentimeSSM(), 1);
  CHECK(timecontrol != NULL);
  CHECK_SAME(gettimeSSM_speed(), 3.0); /* the clock is the PC's, not ours */
  CHECK_EQUAL(createtimeSSM(), 1);
  CHECK_SAME(gettimeSSM_speed(), 3.0);
  CHECK_EQUAL(destroytimeSSM(), 1);
  check_clock(1, 0);
  CHECK_EQUAL(initSSM(), 1); /* attaches again */
  CHECK_SAME(gettimeSSM_speed(), 3.0);
}

int main(int argc, char **argv) {
  check_begin(argc, argv);
  without_clock();
  CHECK_EQUAL(initSSM(), 1);
  settings();
  sleeps();
  attaching();
  CHECK_EQUAL(endSSM(), 1);
  check_clock(1, 0);
  CHECK_SAME(gettimeSSM_speed(), 1.0);
  CHECK_EQUAL(opentimeSSM(), 0);
  CHECK_EQUAL(initSSM(), 1);
  CHECK_SAME(gettimeSSM_speed(), 3.0);
  inittimeSSM();
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
