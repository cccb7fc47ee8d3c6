// SPDX-License-Identifier: Apache-2.0
//
// Writing and reading make no system call while nobody sleeps: a child does both under a filter by
// which the kernel kills it for any call but the one that ends it.
#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>

#include "core/ring/copy.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

void allow_nothing_but_the_end() {
  sock_filter program[] = {
      BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(seccomp_data, nr)),
      BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_exit_group, 0, 1),
      BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
      BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
  };
  const sock_fprog filter{std::size(program), program};
  ::prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
  ::prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &filter);
}

// The status of a child that does `work` with a ring under the filter.
template <class Work>
int status_of(Work work) {
  const TestRing ring(64, 100);
  const pid_t child = ::fork();
  if (child == 0) {
    RingWriter writer = ring.writer();
    const RingReader reader = ring.reader();
    // A thread's first write asks the kernel for its list of locks.
    if (writer.begin() == nullptr) ::_exit(5);
    writer.cancel();
    allow_nothing_but_the_end();
    work(ring, writer, reader);
    ::_exit(0);
  }
  int status = 0;
  ::waitpid(child, &status, 0);
  return status;
}

TEST(Ring, MakesNoSystemCallToWriteOrRead) {
  const int status = status_of([](const TestRing&, RingWriter& writer, const RingReader& reader) {
    std::byte payload[64] = {};
    SampleInfo info;
    for (Tid tid = 0; tid < 10'000; ++tid) {
      if (writer.write(payload, time_from_ns(tid * 1000), Duration(0)) != tid) ::_exit(1);
      if (writer.begin() == nullptr) ::_exit(2);
      writer.cancel();
      if (reader.read_newest(payload, info) != ReadStatus::ok) ::_exit(3);
      Tid found = kNoTid;
      if (reader.find(time_from_ns(tid * 1000 - 5000), found) == ReadStatus::ok) {
        if (reader.read(found, payload, info) != ReadStatus::ok) ::_exit(4);
      }
    }
  });
  EXPECT_TRUE(WIFEXITED(status)) << "ended by signal " << WTERMSIG(status);
  EXPECT_EQ(WEXITSTATUS(status), 0);
}

// The other half: the filter does kill, when a sleeper makes the writer call the kernel.
TEST(Ring, CallsTheKernelOnlyToWakeASleeper) {
  const int status = status_of([](const TestRing& ring, RingWriter& writer, const RingReader&) {
    std::byte payload[64] = {};
    ring.bell->announce();
    writer.write(payload, time_from_ns(1), Duration(0));
  });
  ASSERT_TRUE(WIFSIGNALED(status));
  EXPECT_EQ(WTERMSIG(status), SIGSYS);
}

}  // namespace
}  // namespace dssm::ring
