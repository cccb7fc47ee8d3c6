/* SPDX-License-Identifier: Apache-2.0
 *
 * A program for SSM: writes a sample and reads it back; exits with 0 when it is the same. */
#include <ssm.h>

int main(void) {
  SSM_sid sid;
  int written = 42, read = 0;
  if (!initSSM()) return 1;
  sid = createSSM_time("count", 0, sizeof written, 1.0, 0.1);
  if (!sid) return 2;
  if (writeSSM(sid, &written, gettimeSSM()) < 0) return 3;
  if (readSSM(sid, &read, NULL, -1) < 0) return 4;
  endSSM();
  return read == written ? 0 : 5;
}
