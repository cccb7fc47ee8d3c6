// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <dssm/stream.hpp>

namespace dssm::daemon {

// What a program wants of a stream that is to be created unless it is there.
struct CreatePlan {
  TypeInfo type;
  History history;
};

}  // namespace dssm::daemon
