// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

namespace dssm::wire {

// The outcome of sending or receiving without waiting.
enum class IoStatus : unsigned char {
  ok,
  would_block,
  interrupted,  // a signal handler ran; only from functions that wait
  end,          // the other side closed the connection, or its process died
};

struct IoResult {
  IoStatus status = IoStatus::ok;
  std::size_t bytes = 0;
};

}  // namespace dssm::wire
