// SPDX-License-Identifier: Apache-2.0
//
// A client that is killed at any moment leaves no handle, no descriptor and no waiting request in
// dssmd, and its streams stay.
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/prctl.h>
#include <unistd.h>

#include <random>

#include "tests/process/daemon/raw_client.hpp"
#include "tests/support/sanitized.hpp"

namespace dssm::test {
namespace {

// Creates, opens, asks and closes as fast as it can, until it is killed.
[[noreturn]] void run_until_killed(const std::string& socket_path, std::size_t index) {
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  for (;;) {
    RawClient client(socket_path);
    for (std::size_t i = 0; i < 10; ++i) {
      const std::string name = numbered("stream", (index + i) % 4);
      const Answer created = client.ask(create_request(name));
      const Answer opened = client.ask(open_request(name));
      client.ask(list_opens_request());
      local::Request close;
      close.mutable_close()->set_handle(opened.response.opened().handle());
      client.ask(close);
    }
  }
}

TEST(KilledClient, LeavesNothingInDssmdWheneverItIsKilled) {
  DaemonProcess daemon({"--log-level", "error"});
  RawClient watcher(daemon.socket_path());
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string name = numbered("stream", i);
    RawClient creator(daemon.socket_path());
    ASSERT_TRUE(creator.ask(create_request(name)).response.has_opened());
  }
  const auto only_the_watcher_is_left = [&] {
    return watcher.ask(list_clients_request()).response.client_list().clients_size() == 1;
  };
  ASSERT_TRUE(eventually(only_the_watcher_is_left));
  const int descriptors = idle_descriptors(daemon.pid());

  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (int round = 0; round < (kIsSanitized ? 15 : 60); ++round) {
    std::vector<pid_t> children;
    for (std::size_t i = 0; i < 4; ++i) {
      const pid_t child = ::fork();
      ASSERT_GE(child, 0);
      if (child == 0) run_until_killed(daemon.socket_path(), i);
      children.push_back(child);
    }
    // Asking a random number of times is the random time that passes.
    for (auto asks = random() % 200; asks > 0; --asks) watcher.ask(list_request());
    for (const pid_t child : children) {
      ::kill(child, SIGKILL);
      wait_for(child);
    }
    ASSERT_TRUE(eventually(only_the_watcher_is_left));
    ASSERT_EQ(watcher.ask(list_opens_request()).response.open_list().opens_size(), 0);
    const local::Response list = watcher.ask(list_request()).response;
    ASSERT_EQ(list.stream_list().streams_size(), 4) << "streams survive their users";
    for (const proto::Stream& stream : list.stream_list().streams()) {
      ASSERT_EQ(stream.writers() + stream.readers(), 0u);
    }
    // A connection of a killed one may only just be accepted.
    ASSERT_TRUE(eventually([&] { return open_descriptors(daemon.pid()) == descriptors; }))
        << open_descriptors(daemon.pid()) << " descriptors instead of " << descriptors;
  }
}

TEST(KilledClient, DoesNotDisturbWatchers) {
  DaemonProcess daemon({"--log-level", "error"});
  RawClient watcher(daemon.socket_path()), creator(daemon.socket_path());
  local::Request watch;
  watch.mutable_watch();
  ASSERT_TRUE(watcher.ask(watch).response.has_done());
  {
    RawClient gone(daemon.socket_path());  // watches, and leaves without reading
    ASSERT_TRUE(gone.ask(watch).response.has_done());
  }
  for (std::size_t i = 0; i < 20; ++i) {
    creator.ask(create_request(numbered("s", i)));
    const Answer event = watcher.receive();
    EXPECT_EQ(event.response.stream_event().stream().id().name(), numbered("s", i));
  }
}

// How many writers of the stream ended without closing it, when there is none any more.
std::uint32_t crashed_writers(RawClient& client, const std::string& name) {
  local::Request info;
  info.mutable_info()->mutable_id()->set_name(name);
  proto::Stream stream;
  EXPECT_TRUE(eventually([&] {
    stream = client.ask(info).response.stream_list().streams(0);
    return stream.writers() == 0;
  }));
  return stream.crashed_writers();
}

// dssmd may notice that a program takes no more answers before it has read all that it sent.
TEST(KilledClient, CountsAsCrashedOnlyForStreamsThatItDidNotClose) {
  constexpr std::size_t kStreams = 40;
  DaemonProcess daemon({"--log-level", "error"});
  RawClient observer(daemon.socket_path());
  RawClient program(daemon.socket_path());
  std::string closes;
  for (std::size_t i = 0; i <= kStreams; ++i) {
    const Answer opened = program.ask(create_request(numbered("stream", i)));
    if (i == kStreams) break;
    local::Request close;
    close.set_serial(1000 + i);
    close.mutable_close()->set_handle(opened.response.opened().handle());
    closes += wire::encode_frame(close);
  }
  ::kill(daemon.pid(), SIGSTOP);
  program.send_bytes(closes);
  program.close();
  ::kill(daemon.pid(), SIGCONT);
  for (std::size_t i = 0; i < kStreams; ++i) {
    EXPECT_EQ(crashed_writers(observer, numbered("stream", i)), 0u) << i;
  }
  EXPECT_EQ(crashed_writers(observer, numbered("stream", kStreams)), 1u);
}

TEST(OpensAndCloses, TenThousandOfThemLeakNothing) {
  DaemonProcess daemon({"--log-level", "error"});
  RawClient client(daemon.socket_path());
  ASSERT_TRUE(client.ask(create_request("odometry")).response.has_opened());
  client.ask(list_request());  // its answer comes after those of Create were sent and closed
  const int descriptors = idle_descriptors(daemon.pid());
  local::Request close;
  for (int i = 0; i < 10'000; ++i) {
    const Answer opened = client.ask(open_request("odometry", i % 2 == 0));
    ASSERT_TRUE(opened.response.has_opened()) << opened.response.failure().message();
    close.mutable_close()->set_handle(opened.response.opened().handle());
    ASSERT_TRUE(client.ask(close).response.has_done());
  }
  EXPECT_EQ(client.ask(list_opens_request()).response.open_list().opens_size(), 1);
  // dssmd has one open for a moment now and then, such as to ask chronyd.
  EXPECT_TRUE(eventually([&] { return open_descriptors(daemon.pid()) <= descriptors; }))
      << open_descriptors(daemon.pid()) << " descriptors instead of " << descriptors;
}

}  // namespace
}  // namespace dssm::test
