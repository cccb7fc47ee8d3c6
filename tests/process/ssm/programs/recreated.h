/* SPDX-License-Identifier: Apache-2.0
 *
 * Loops of programs over a stream that is removed and recreated: to the program tids keep rising.
 * Api: SSMApi<int> or DSSMApi<int>.
 */
#ifndef TESTS_SSM_RECREATED_H
#define TESTS_SSM_RECREATED_H

#include "check.h"

namespace {

// readNext() until the sample `awaited`: one after the other, nothing left out after `last`.
template <class Api>
void read_next_until(Api& api, int awaited, SSM_tid& last, bool (*read)(Api&)) {
  while (api.data != awaited || api.timeId < 1) {
    if (!read(api)) {
      usleep(1000);
      continue;
    }
    CHECK_EQUAL(api.timeId, last + 1);
    last = api.timeId;
  }
}

template <class Api>
bool read_next(Api& api) {
  return api.readNext();
}

// readNew() until the sample `awaited`: newer each time.
template <class Api>
void read_new_until(Api& api, int awaited, SSM_tid& last) {
  while (api.data != awaited || api.timeId < 0) {
    if (!api.readNew()) {
      usleep(1000);
      continue;
    }
    CHECK(api.timeId > last);
    last = api.timeId;
  }
  CHECK(!api.isUpdate() && !api.readNew());
}

}  // namespace

#endif
