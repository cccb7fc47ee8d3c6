/* SPDX-License-Identifier: Apache-2.0
 *
 * What programs used of SSM's internals: control of the shared clock, the lists of processes and
 * open streams, the arithmetic of ring sizes, and a stream's header. The rest of the old
 * file (message queue, locks, raw slots) has no counterpart here; docs/ssm.md.
 */
#ifndef DSSM_LIBSSM_H
#define DSSM_LIBSSM_H

#include <pthread.h>
#include <sys/shm.h>

#include "ssm.h"

/* Kept for programs that name them; nothing here uses System V objects. */
#define SHM_KEY 0x3292
#define SHM_TIME_KEY (SHM_KEY - 1)
#define MSQ_KEY 0x3292
#define MSQ_CMD 1000
#define MSQ_RES 1001
#define MSQ_RES_MAX 2000

#define SSM_MARGIN 1
#define SSM_BUFFER_MARGIN 1.2
#define SSM_TID_SP 0

#ifdef __cplusplus
extern "C" {
#endif

/* Slots of a ring: (int)(1.2 * (life / cycle) + 1); and life from slots: (num - 1) * cycle / 1.2.
 */
int calcSSM_table(ssmTimeT life, ssmTimeT cycle);
ssmTimeT calcSSM_life(int table_num, ssmTimeT cycle);

/* Registered processes, in the order of initSSM, each counted once; then dssmd, while a process has a
 * stream open that other PCs write. -1 without dssmd. */
int getSSM_node_num(void);
int getSSM_node_info(int n, int* node_num);

/* Open streams: node1 created it (or, when that has ended, writes it), node2 opened it with the mode
 * dir; -1 without dssmd. */
int getSSM_edge_num(void);
int getSSM_edge_info(int n, char* name, size_t name_size, int* id, int* node1, int* node2,
                     int* dir);

/* This process's copy of the shared clock's setting, refreshed by each call of a time function;
 * NULL when no clock is attached. Changing it changes nothing. */
struct ssmtime {
  ssmTimeT offset;
  double speed;
  int is_pause;
  ssmTimeT pausetime;
};
extern struct ssmtime* timecontrol;

/* Attach to and detach from the shared clock; initSSM and endSSM do so by themselves. */
int opentimeSSM(void) DSSM_SSM_MUST_USE;
void closetimeSSM(void);
int createtimeSSM(void) DSSM_SSM_MUST_USE; /* as opentimeSSM: dssmd made the clock */
int destroytimeSSM(void);                  /* as closetimeSSM; 1 */

/* The shared clock. Setters return 1, or 0 without a clock. */
void inittimeSSM(void);
int settimeSSM(ssmTimeT now);
int settimeSSM_speed(double speed);
double gettimeSSM_speed(void);
int settimeSSM_is_pause(int is_pause);
int gettimeSSM_is_pause(void);
int settimeSSM_is_reverse(int is_reverse);
int gettimeSSM_is_reverse(void);
ssmTimeT gettimeOffset(void);
void settimeOffset(ssmTimeT offset);

/* A stream's header as of the latest shm_get_address(sid); NULL for a sid that is not open. Valid
 * until the sid is closed. */
typedef struct {
  SSM_tid tid_top;
  int num;
  size_t size;
  double cycle;
} ssm_header;
ssm_header* shm_get_address(SSM_sid sid);
size_t shm_get_data_size(ssm_header* shm_p);

#ifdef __cplusplus
}
#endif

#endif
