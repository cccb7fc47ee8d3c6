// SPDX-License-Identifier: Apache-2.0
//
// Constants of the old DSSM's remote interface, for programs that name them. Only READ_packet_type
// means something here: it is an argument of PConnector::read(). The messages that went over the
// old network have no counterpart; docs/ssm.md.
#ifndef DSSM_DSSM_DEF_HPP
#define DSSM_DSSM_DEF_HPP

#include <sys/types.h>

#include <cstdint>

#include "ssm-time.h"

#define SERVER_PORT 8080
#define SERVER_IP 0x00000000UL
#define BR_PORT 12345
#define BR_MAX_SIZE 256
#define PRQ_KEY 0x3293
#define DMSG_CMD 1000
#define DMSG_RES 1001
#define DMSG_MAX_SIZE 1024
#define EXPIRE_TIME 10

typedef enum { WRITE_MODE = 1, READ_MODE = 2, PROXY_INIT = 3, BUFFER_MODE = 4 } PROXY_open_mode;

typedef enum {
  TIME_ID = 0,
  REAL_TIME,
  READ_NEXT,
  SSM_ID,
  TID_REQ,
  TOP_TID_REQ,
  BOTTOM_TID_REQ,
  PACKET_FAILED,
  WRITE_PACKET,
  TMC_RES,
  TMC_FAIL
} READ_packet_type;

#endif
