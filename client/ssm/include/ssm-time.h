/* SPDX-License-Identifier: Apache-2.0
 *
 * SSM time: a clock that all programs of this PC share, so that a player of recordings can turn it
 * and everybody's time and sleeps follow. Source-compatible with SSM and DSSM; docs/ssm.md.
 *
 * Without a clock (before initSSM, after endSSM) SSM time is real time and sleeps are unscaled.
 * All functions here may be called from any thread and from signal handlers.
 */
#ifndef DSSM_SSM_TIME_H
#define DSSM_SSM_TIME_H

#include <time.h>
#include <unistd.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Seconds since 1970-01-01 UTC. */
typedef double ssmTimeT;

/* SSM time now: speed * real time + offset, or the frozen time while paused. */
ssmTimeT gettimeSSM(void);

/* CLOCK_REALTIME. */
ssmTimeT gettimeSSM_real(void);

/* Sleep for a span of SSM time: it takes span / |speed| of real time (unscaled while speed is 0).
 * 0, or -1 when a signal interrupted it or the span is negative; sleepSSM's -1 shows as UINT_MAX.
 */
unsigned int sleepSSM(double sec);
int usleepSSM(unsigned int usec); /* useconds_t, which -std=c99 hides */
#if defined(_POSIX_C_SOURCE) && _POSIX_C_SOURCE >= 199309L
int nanosleepSSM(const struct timespec* req,
                 struct timespec* rem); /* rem: SSM time left, or NULL */
#endif

#ifdef __cplusplus
}
#endif

#endif
