// SPDX-License-Identifier: Apache-2.0
//
// Closes its stream and ends at once, as most programs do.
#include <libssm.h>
#include <ssm.hpp>

int main() {
  SSMApi<int> writer("ended", 0);
  if (!initSSM() || !writer.create(1.0, 0.1)) return 1;
  writer.data = 1;
  if (!writer.write()) return 2;
  writer.release();
  endSSM();
  return 0;
}
