// SPDX-License-Identifier: Apache-2.0
//
// What a program asks for when it opens a stream of another host, and what it gets.
#pragma once

#include <dssm/stream.hpp>
#include <memory>

namespace dssm::daemon {

// What a program wants of a stream that is to be created unless it is there.
struct CreatePlan {
  TypeInfo type;
  History history;
};

class Stream;

// A ring of this host, a mirror's or a remote writer's, that a program may use now.
struct OpenedRing {
  std::shared_ptr<Stream> stream;  // its id names the owner's host
  bool created = false;            // this open created the owner's stream
};

}  // namespace dssm::daemon
