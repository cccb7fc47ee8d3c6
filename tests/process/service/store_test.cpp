// SPDX-License-Identifier: Apache-2.0
//
// The contents of the service manager's descriptor store, and how dssmd handles an invalid store.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/resource.h>

#include <algorithm>
#include <csignal>
#include <dssm/dssm.hpp>

#include "tests/support/sanitized.hpp"
#include "tests/support/service_manager.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

constexpr std::size_t kPerStream = 3;  // ring, bell, meta

ServiceManager::Options without_network() { return {.arguments = {"--listen", ""}}; }

std::vector<std::string> stream_names(Session& session) {
  std::vector<std::string> names;
  for (const StreamInfo& stream : session.list_streams().value()) names.push_back(stream.id.name);
  return names;
}

UniqueFd fake_ring() {
  return UniqueFd(::memfd_create("dssm-ring:a:0@pc1", MFD_CLOEXEC | MFD_ALLOW_SEALING));
}

TEST(DescriptorStore, HoldsTheDescriptorsOfAStreamUntilItIsRemoved) {
  ServiceManager manager(without_network());
  Session session = connect_to(manager.socket_path());
  for (const char* name : {"a", "b", "c"}) session.create<int>(name, kShort).value();
  EXPECT_EQ(manager.stored_descriptors(), 3 * kPerStream);
  EXPECT_EQ(manager.stored().size(), 3u) << "not one name per stream";
  ASSERT_TRUE(session.remove({"b", 0, ""}));
  EXPECT_EQ(manager.stored_descriptors(), 2 * kPerStream);
  manager.restart();
  EXPECT_EQ(stream_names(session), (std::vector<std::string>{"a", "c"}));
  // After a restart dssmd uses new names.
  session.create<int>("d", kShort).value();
  EXPECT_EQ(manager.stored_descriptors(), 3 * kPerStream);
  EXPECT_EQ(manager.stored().size(), 3u);
  for (const char* name : {"a", "c", "d"}) ASSERT_TRUE(session.remove({name, 0, ""}));
  EXPECT_EQ(manager.stored_descriptors(), 0u);
  manager.restart();
  EXPECT_EQ(stream_names(session), std::vector<std::string>());
}

TEST(DescriptorStore, HoldsTheListeningSocketOnceOverManyRestarts) {
  ServiceManager manager;
  const std::string address = manager.address();
  EXPECT_EQ(manager.stored(), (std::map<std::string, std::size_t>{{"=0", 1}}));
  for (int round = 0; round < 3; ++round) {
    manager.restart();
    EXPECT_EQ(manager.address(), address);
    EXPECT_EQ(manager.stored_descriptors(), 1u);
    EXPECT_EQ(manager.doubled(), 0);
  }
}

TEST(DescriptorStore, HoldsThePlaybackClock) {
  ServiceManager manager(without_network());
  ASSERT_TRUE(connect_to(manager.socket_path()).open_playback_clock());
  EXPECT_EQ(manager.stored_descriptors(), 1u);
  manager.restart();
  ASSERT_TRUE(connect_to(manager.socket_path()).open_playback_clock());
  EXPECT_EQ(manager.stored_descriptors(), 1u);
}

TEST(DescriptorStore, DropsInvalidDescriptorsAndKeepsTheRest) {
  ServiceManager manager(without_network());
  Session session = connect_to(manager.socket_path());
  auto writer = session.create<int>("good", kShort).value();
  manager.kill_hard();
  manager.put_into_store("null", UniqueFd(::open("/dev/null", O_RDWR | O_CLOEXEC)));
  manager.put_into_store("lone", fake_ring());
  manager.put_into_store("bell", UniqueFd(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)));
  for (const char* kind : {"dssm-ring:x:0@pc1#1", "dssm-bell:x:0@pc1#1", "dssm-meta:x:0@pc1#1"}) {
    manager.put_into_store("empty",
                           UniqueFd(::memfd_create(kind, MFD_CLOEXEC | MFD_ALLOW_SEALING)));
  }
  manager.put_into_store("clock", UniqueFd(::memfd_create("dssm-playback-clock", MFD_CLOEXEC)));
  manager.start();
  EXPECT_EQ(stream_names(session), std::vector<std::string>{"good"});
  EXPECT_EQ(session.stream_info({"good", 0, ""}).value().incarnation, writer.incarnation());
  EXPECT_EQ(manager.stored_descriptors(), kPerStream)
      << "dropped descriptors are still in the store";
}

// A program gives back its stream whose entry in the store is incomplete.
TEST(DescriptorStore, LetsProgramsGiveBackStreamsThatTheStoreLost) {
  ServiceManager manager({.arguments = {"--listen", ""}, .store_max = kPerStream + 2});
  Session session = connect_to(manager.socket_path());
  auto first = session.create<int>("first", kShort).value();
  auto second = session.create<int>("second", kShort).value();
  EXPECT_EQ(manager.stored_descriptors(), kPerStream + 2) << "the second stream is not half stored";
  manager.kill_hard();
  manager.start();
  // Waits for the program that has the stream open, although another one asks earlier.
  Session eager = connect_to(manager.socket_path());
  EXPECT_EQ(eager.create<int>("second", kShort).value().incarnation(), second.incarnation());
  EXPECT_EQ(eager.create<int>("first", kShort).value().incarnation(), first.incarnation());
}

TEST(DescriptorStore, DoesNotRecoverARemovedStream) {
  ServiceManager manager(without_network());
  Session session = connect_to(manager.socket_path());
  session.create<int>("removed", kShort).value();
  ASSERT_TRUE(session.remove({"removed", 0, ""}));
  manager.kill_hard();
  manager.start();
  EXPECT_EQ(stream_names(session), std::vector<std::string>());
}

TEST(DescriptorStore, RefusesStreamsOfAnotherHostName) {
  ServiceManager manager(without_network());
  { connect_to(manager.socket_path()).create<int>("s", kShort).value(); }
  manager.kill_hard();
  manager.rename_host("pc9");
  manager.start();
  Session session = connect_to(manager.socket_path());
  EXPECT_EQ(stream_names(session), std::vector<std::string>());
  EXPECT_EQ(manager.stored_descriptors(), 0u);
}

// As many as this machine's limit of descriptors and the default of max_streams allow.
TEST(DescriptorStore, RecoversThousandsOfStreams) {
  rlimit limit{};
  ASSERT_EQ(::getrlimit(RLIMIT_NOFILE, &limit), 0);
  limit.rlim_cur = limit.rlim_max;
  ASSERT_EQ(::setrlimit(RLIMIT_NOFILE, &limit), 0);
  // The fake service manager has them twice while it passes them.
  const std::size_t streams =
      std::min<std::size_t>(kIsSanitized ? 512 : 4096, limit.rlim_max / (2 * kPerStream + 2));
  ServiceManager manager(without_network());
  {
    Session session = connect_to(manager.socket_path());
    for (std::size_t i = 0; i < streams; ++i) {
      ASSERT_TRUE(session.create<int>("many:" + std::to_string(i), kShort));
    }
  }
  manager.await_stored(streams * kPerStream);
  manager.kill_hard();
  manager.start();
  EXPECT_EQ(connect_to(manager.socket_path()).list_streams().value().size(), streams);
}

}  // namespace
}  // namespace dssm::test
