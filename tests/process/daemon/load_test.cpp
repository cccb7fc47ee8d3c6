// SPDX-License-Identifier: Apache-2.0
//
// Many streams, many clients, and what an idle dssmd costs.
#include <gtest/gtest.h>
#include <poll.h>
#include <sys/resource.h>

#include <fstream>

#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {
namespace {

// A field of /proc/PID/FILE that reads "NAME: NUMBER ...".
std::uint64_t proc_number(pid_t pid, const std::string& file, const std::string& name) {
  std::ifstream in("/proc/" + std::to_string(pid) + "/" + file);
  for (std::string word; in >> word;) {
    std::uint64_t number = 0;
    if (word == name + ":" && in >> number) return number;
  }
  ADD_FAILURE() << "no '" << name << "' in " << file;
  return 0;
}

TEST(Load, ServesAThousandStreamsAndAThousandClientsAtOnce) {
  rlimit limit{};
  ::getrlimit(RLIMIT_NOFILE, &limit);
  if (limit.rlim_max < 8192) GTEST_SKIP() << "needs 8192 descriptors (ulimit -Hn)";
  limit.rlim_cur = limit.rlim_max;
  ::setrlimit(RLIMIT_NOFILE, &limit);
  DaemonProcess daemon({"--log-level", "error"});
  std::vector<RawClient> clients;
  for (std::size_t i = 0; i < 1000; ++i) {
    clients.emplace_back(daemon.socket_path());
    const Answer created = clients.back().ask(create_request(numbered("stream", i)));
    ASSERT_TRUE(created.response.opened().created()) << created.response.failure().message();
  }
  for (std::size_t i = 0; i < 1000; ++i) {  // each reads its neighbour's
    const Answer opened = clients[i].ask(open_request(numbered("stream", (i + 1) % 1000)));
    ASSERT_TRUE(opened.response.has_opened()) << opened.response.failure().message();
  }
  const local::Response list = clients[0].ask(list_request()).response;
  ASSERT_EQ(list.stream_list().streams_size(), 1000);
  for (const proto::Stream& stream : list.stream_list().streams()) {
    ASSERT_EQ(stream.writers(), 1u);
    ASSERT_EQ(stream.readers(), 1u);
  }
  EXPECT_EQ(clients[0].ask(list_opens_request()).response.open_list().opens_size(), 2000);
  EXPECT_EQ(clients[0].ask(list_clients_request()).response.client_list().clients_size(), 1000);
}

TEST(Load, CostsLittleMemoryAndNoTimeWithAHundredIdleStreams) {
  DaemonProcess daemon;
  RawClient client(daemon.socket_path());
  for (std::size_t i = 0; i < 100; ++i) {
    ASSERT_TRUE(client.ask(create_request(numbered("stream", i))).response.has_opened());
  }
  const auto switches = [&] {
    return proc_number(daemon.pid(), "status", "voluntary_ctxt_switches");
  };
  client.ask(list_request());
  // Once it has told the service manager how many streams there are. It asks chronyd each second,
  // which takes a wake-up for the question and one for what comes of it.
  EXPECT_TRUE(eventually([&] {
    const std::uint64_t before = switches();
    ::poll(nullptr, 0, 1500);  // the span that is looked at, not a wait for something
    return switches() <= before + 4;
  })) << "an idle dssmd wakes up for something else than the clock";
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
  const std::uint64_t private_kib = proc_number(daemon.pid(), "smaps_rollup", "Private_Dirty") +
                                    proc_number(daemon.pid(), "smaps_rollup", "Private_Clean");
  EXPECT_LE(private_kib, 8u * 1024);
  std::printf("private memory with 100 idle streams: %llu KiB\n",
              static_cast<unsigned long long>(private_kib));
#endif
}

}  // namespace
}  // namespace dssm::test
