// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace dssm::wire {

// How sending or receiving without waiting went.
enum class IoStatus : unsigned char {
  ok,
  would_block,
  interrupted,  // a signal handler ran meanwhile; only of what waits
  end,          // the other side closed the connection or is gone
};

struct IoResult {
  IoStatus status = IoStatus::ok;
  std::size_t bytes = 0;
};

}  // namespace dssm::wire
