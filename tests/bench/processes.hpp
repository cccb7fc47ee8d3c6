// SPDX-License-Identifier: Apache-2.0
//
// Shared by benchmarks with chains of processes: children, bare TCP, futexes, CPU time.
#pragma once

#include <arpa/inet.h>
#include <linux/futex.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <climits>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <dssm/time.hpp>
#include <fstream>
#include <new>
#include <string>
#include <utility>

namespace dssm::bench {

// Ends the benchmark with a message: partial figures are useless.
[[noreturn]] inline void fail(const char* what) {
  std::perror(what);
  std::abort();
}

// Memory that children share with their parent; never unmapped.
template <class T>
T& shared() {
  void* memory =
      ::mmap(nullptr, sizeof(T), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  if (memory == MAP_FAILED) fail("mmap");
  return *new (memory) T;
}

// Runs `work` in a child that ends with this process; does not return in the child.
template <class Work>
pid_t in_child(Work work) {
  const pid_t pid = ::fork();
  if (pid < 0) fail("fork");
  if (pid > 0) return pid;
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  work();
  ::_exit(0);
}

inline void end_child(pid_t pid) {
  ::kill(pid, SIGKILL);
  ::waitpid(pid, nullptr, 0);
}

// How often the process went to sleep, which is the number of its wake-ups.
inline std::int64_t sleeps_of(pid_t pid) {
  std::ifstream status("/proc/" + std::to_string(pid) + "/status");
  for (std::string word; status >> word;) {
    std::int64_t count = 0;
    if (word == "voluntary_ctxt_switches:" && status >> count) return count;
  }
  fail("read /proc");
}

inline void sleep_until(MonoTime time) {
  const timespec until{to_ns(time.time_since_epoch()) / 1'000'000'000,
                       to_ns(time.time_since_epoch()) % 1'000'000'000};
  ::clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
}

inline void futex_wait(std::atomic<std::uint32_t>& word, std::uint32_t value) {
  ::syscall(SYS_futex, &word, FUTEX_WAIT, value, nullptr, nullptr, 0);
}
inline void futex_wake(std::atomic<std::uint32_t>& word) {
  ::syscall(SYS_futex, &word, FUTEX_WAKE, INT_MAX, nullptr, nullptr, 0);
}

// CPU time used by all threads of a process so far.
inline std::int64_t cpu_ns(pid_t pid) {
  clockid_t clock{};
  timespec time{};
  if (::clock_getcpuclockid(pid, &clock) || ::clock_gettime(clock, &time)) fail("CPU time");
  return time.tv_sec * 1'000'000'000 + time.tv_nsec;
}

inline void send_all(int fd, const void* data, std::size_t bytes) {
  const auto* at = static_cast<const char*>(data);
  while (bytes > 0) {
    const ssize_t sent = ::send(fd, at, bytes, MSG_NOSIGNAL);
    if (sent <= 0) fail("send");
    at += sent, bytes -= static_cast<std::size_t>(sent);
  }
}

// flags: of recv(2). With MSG_DONTWAIT it polls without sleeping.
inline void receive_all(int fd, void* data, std::size_t bytes, int flags = 0) {
  auto* at = static_cast<char*>(data);
  while (bytes > 0) {
    const ssize_t got = ::recv(fd, at, bytes, flags);
    if (got < 0 && errno == EAGAIN) continue;
    if (got <= 0) fail("recv");
    at += got, bytes -= static_cast<std::size_t>(got);
  }
}

}  // namespace dssm::bench
