/* SPDX-License-Identifier: Apache-2.0
 *
 * The C interface of SSM (Streaming data Sharing Manager), as programs written for SSM and DSSM
 * include it; it works on DSSM's rings. What each call returns is in docs/ssm.md, with the
 * bugs of the old library that this one does not have.
 *
 * closeSSM, releaseSSM and endSSM may be called from a signal handler at any moment. All other
 * calls may be made from any thread.
 */
#ifndef DSSM_SSM_H
#define DSSM_SSM_H

#include <stddef.h>
#include <stdint.h>

#include "ssm-time.h"

#define SSM_SNAME_MAX 32 /* bytes of a name, with its terminator */

#define createSSM_time(n, u, s, l, c) createSSM(n, u, s, l, c)

#if defined(__GNUC__)
#define DSSM_SSM_MUST_USE __attribute__((warn_unused_result))
#else
#define DSSM_SSM_MUST_USE
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef enum {
  SSM_READ = 0x20,
  SSM_WRITE = 0x40,
  SSM_EXCLUSIVE = 0x80,
  SSM_READ_BUFFER = 0xa0,
  SSM_MODE_MASK = 0xf0
} SSM_open_mode;

enum { SSM_ERROR_FUTURE = -1, SSM_ERROR_PAST = -2, SSM_ERROR_NO_DATA = -3 };

typedef char* SSM_sid; /* a handle, not an address: never follow it */
typedef int SSM_tid;

void errSSM(void);
int initSSM(void);
int endSSM(void);

SSM_sid createSSM(const char* stream_name, int stream_id, size_t stream_size, ssmTimeT life,
                  ssmTimeT cycle) DSSM_SSM_MUST_USE;
int releaseSSM(SSM_sid* sid);
SSM_sid openSSM(const char* stream_name, int stream_id, char open_mode) DSSM_SSM_MUST_USE;
int closeSSM(SSM_sid* sid);

SSM_tid getTID(SSM_sid sid, ssmTimeT ytime);
SSM_tid getTID_top(SSM_sid sid);
SSM_tid getTID_bottom(SSM_sid sid);
int waitTID(SSM_sid sid, SSM_tid tid);

/* Not in SSM: how far the time of sample tid may be from this PC's clock [s]; 0 for a stream of this
 * PC, negative when it is not known or the sample is not held. */
double getClockErrorSSM(SSM_sid sid, SSM_tid tid);

SSM_tid readSSM(SSM_sid sid, void* data, ssmTimeT* ytime, SSM_tid tid) DSSM_SSM_MUST_USE;
SSM_tid readSSM_time(SSM_sid sid, void* data, ssmTimeT ytime, ssmTimeT* ret_time) DSSM_SSM_MUST_USE;
SSM_tid readSSMP(SSM_sid sid, void* adata, ssmTimeT* ytime, SSM_tid tid,
                 void (*callback)(const void* ssmp, void* data, void* user_data),
                 void* user_data) DSSM_SSM_MUST_USE;
SSM_tid readSSMP_time(SSM_sid sid, void* adata, ssmTimeT ytime, ssmTimeT* ret_time,
                      void (*callback)(const void* ssmp, void* data, void* user_data),
                      void* user_data) DSSM_SSM_MUST_USE;

SSM_tid writeSSM(SSM_sid sid, const void* data, ssmTimeT ytime);
SSM_tid writeSSM_time(SSM_sid sid, const void* data, ssmTimeT ytime);
SSM_tid writeSSMP(SSM_sid sid, const void* adata, ssmTimeT ytime,
                  void (*callback)(void* ssmp, const void* data, void* user_data), void* user_data);
SSM_tid writeSSMP_time(SSM_sid sid, const void* adata, ssmTimeT ytime,
                       void (*callback)(void* ssmp, const void* data, void* user_data),
                       void* user_data);

int set_propertySSM(const char* stream_name, int stream_id, const void* data, size_t size);
int get_propertySSM(const char* stream_name, int stream_id, void* data);

int getSSM_num(void);
int getSSM_name(int n, char* stream_name, int* stream_id, size_t* size);
int getSSM_info(const char* stream_name, int stream_id, size_t* size, int* num, double* cycle,
                size_t* property_size);
int damp(SSM_sid sid, int mode, int num);

/* Leftovers of DSSM's neighbour list that no program calls: do nothing, return 0. */
int add_info(const char* data, uint32_t data_len, uint16_t port);
int get_info_size(void);
int get_info(char* buffer, uint32_t buf_len);

#ifdef __cplusplus
}
#endif

#endif
