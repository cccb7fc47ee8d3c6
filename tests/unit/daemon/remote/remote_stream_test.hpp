// SPDX-License-Identifier: Apache-2.0
//
// What tests of mirrors and of remote writers share: the stream "odometry:0@pc2" of a ScriptedHost,
// which the catalog of "pc1" knows.
#pragma once

#include <gtest/gtest.h>

#include <memory>
#include <optional>

#include "daemon/remote/remote_streams.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {

inline const StreamId kOdometry{"odometry", 0, "pc2"};

// Kind: Mirror or RemoteWriter.
template <class Kind>
class RemoteStreamTest : public testing::Test {
 protected:
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop};
  Registry registry{"pc1", kLimits};
  LogRecorder logger;
  Catalog catalog{"pc1"};
  ChannelParts parts{loop, resolver, registry, logger, greeting_of("pc1")};
  std::unique_ptr<RemoteStreams<Kind>> streams =
      std::make_unique<RemoteStreams<Kind>>(parts, catalog);
  std::unique_ptr<ScriptedHost> owner = std::make_unique<ScriptedHost>(loop);
  StreamInfo theirs;

  RemoteStreamTest() {
    theirs.id = kOdometry;
    theirs.type = odometry_type();
    theirs.depth = 16;
    theirs.cycle = std::chrono::milliseconds(10);
    theirs.incarnation = 7;
    catalog.host_up(owner->host().greeting, owner->address());
  }

  using Answer = std::optional<Result<OpenedRing>>;
  std::shared_ptr<Answer> open_at(const KnownHost& host, const CreatePlan* plan = nullptr) {
    auto answer = std::make_shared<Answer>();
    streams->open(host, kOdometry, plan,
                  [answer](Result<OpenedRing> result) { answer->emplace(std::move(result)); });
    return answer;
  }
  std::shared_ptr<Answer> open(const CreatePlan* plan = nullptr) {
    return open_at(owner->host(), plan);
  }
  OpenedRing wait(const std::shared_ptr<Answer>& answer) {
    run_until(loop, [&] { return answer->has_value(); });
    return (*answer)->value();
  }
  Error wait_error(const std::shared_ptr<Answer>& answer) {
    run_until(loop, [&] { return answer->has_value(); });
    return (*answer)->error();
  }

  // Offers a ring that does not fit; returns why it is refused.
  Error offer(Purpose purpose, const StreamId& id, Role role) {
    const auto stream = Stream::create({.id = id,
                                        .type = odometry_type(),
                                        .depth = 16,
                                        .cycle = std::chrono::milliseconds(1),
                                        .purpose = purpose},
                                       registry.budgets())
                            .value();
    return streams->adopt_untrusted(kOdometry, as_offer(stream->descriptors_for(role).value()))
        .error();
  }

  // How many mirrors or remote writers there are.
  std::size_t count() const {
    std::size_t count = 0;
    streams->for_each([&](const Kind&) { ++count; });
    return count;
  }
  void wait_until_none() {
    run_until(loop, [this] { return count() == 0; });
  }
};

}  // namespace dssm::daemon
