// SPDX-License-Identifier: Apache-2.0
//
// The mirrors of this dssmd, as those see them who need one: FleetService today. Mirrors keeps
// them; tests put a fake in its place.
#pragma once

#include <dssm/result.hpp>
#include <functional>
#include <memory>

#include "common.pb.h"
#include "daemon/fleet/catalog.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class MirrorKeeper {
 public:
  // Called once, from the loop, or at once from within open(); never after the keeper is gone.
  using Then = std::function<void(Result<std::shared_ptr<Stream>>)>;

  class Observer {
   public:
    // Readers of `stream` shall open it anew: its mirror has a new ring by now.
    virtual void on_ring_replaced(const Stream& stream) = 0;

   protected:
    ~Observer() = default;
  };
  virtual void observe(Observer* observer) = 0;  // at most one; nullptr: none

  // The mirror of `id`, a stream of `host`: the one that is there, or a new one, filled with the
  // owner's history. `host` is good during the call only. The stream's id names the owner's host.
  // It is kept while the OpenTable has it, and mirror_linger longer.
  //   fails  not_found (the owner has no such stream any more), unavailable (the owner does not
  //          answer), limit_exceeded
  virtual void open(const KnownHost& host, const StreamId& id, Then then) = 0;

  // Goes on with a mirror's ring that a program held while dssmd was away. `id` names the owner's
  // host, which need not be in the catalog yet. Two offers of one ring are one mirror.
  //   fails  conflict (the mirror of that name has another ring by now), protocol, no_permission,
  //          limit_exceeded
  virtual Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id,
                                                          OfferedFiles files) = 0;

  // The mirror that there is for `id`, whatever its owner is doing; for an `id` without a host the
  // only one of that name. nullptr: none, or several.
  virtual std::shared_ptr<Stream> find(const StreamId& id) const = 0;

  // How the mirror of `id`, which names the owner's host, is doing. False: there is none.
  virtual bool describe(const StreamId& id, proto::Mirror& out) const = 0;

 protected:
  ~MirrorKeeper() = default;
};

}  // namespace dssm::daemon
