// SPDX-License-Identifier: Apache-2.0
//
// The rings of this dssmd whose samples are published into other hosts' streams, as those see them
// who need one: FleetService today. RemoteWriters keeps them; tests put a fake in its place.
#pragma once

#include <dssm/result.hpp>
#include <functional>
#include <memory>

#include "daemon/fleet/catalog.hpp"
#include "daemon/streams/create_plan.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class RemoteWriterKeeper {
 public:
  // Called once, from the loop, or at once from within open(); never after the keeper is gone.
  using Then = std::function<void(Result<OpenedRing>)>;

  // A ring here whose samples go to `id`, a stream of `host`: the one that is there, or a new one
  // after the owner agreed. `host` is good during the call only.
  //   plan   create the stream there unless it exists; nullptr: it must exist. Used during the call
  //   fails  not_found, type_mismatch, unavailable (the owner does not answer), limit_exceeded
  virtual void open(const KnownHost& host, const StreamId& id, const CreatePlan* plan,
                    Then then) = 0;

  // Goes on with such a ring that a program held while dssmd was away. `id` names the owner's host,
  // which need not be in the catalog yet. Two offers of one ring are one remote writer; beside a
  // ring that somebody opened since, it is a second one.
  //   fails  protocol, no_permission, limit_exceeded
  virtual Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id,
                                                          OfferedFiles files) = 0;

 protected:
  ~RemoteWriterKeeper() = default;
};

}  // namespace dssm::daemon
