// SPDX-License-Identifier: Apache-2.0
#include "tests/support/daemon_process.hpp"

#include <fcntl.h>
#include <grp.h>
#include <netinet/in.h>
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>

extern char** environ;

namespace dssm::test {
namespace {

[[noreturn]] void fail(const std::string& what) {
  std::fprintf(stderr, "test harness: %s: %s\n", what.c_str(), std::strerror(errno));
  std::abort();
}

// fork + exec; by convention, all descriptors except stdin, stdout and stderr are close-on-exec.
pid_t spawn(const std::vector<std::string>& argv, const std::vector<std::string>& environment,
            int in_fd, int out_fd, int err_fd) {
  std::vector<char*> args;
  for (const std::string& word : argv) args.push_back(const_cast<char*>(word.c_str()));
  args.push_back(nullptr);
  std::vector<char*> vars;
  for (char** var = environ; *var; ++var) vars.push_back(*var);
  for (const std::string& var : environment)
    vars.insert(vars.begin(), const_cast<char*>(var.c_str()));
  vars.push_back(nullptr);
  const pid_t parent = ::getpid();
  const pid_t pid = ::fork();
  if (pid < 0) fail("fork");
  if (pid == 0) {
    // If the test is killed, so are the programs that it started.
    ::prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (::getppid() != parent) ::_exit(127);
    if (in_fd >= 0) ::dup2(in_fd, 0);
    if (out_fd >= 0) ::dup2(out_fd, 1);
    if (err_fd >= 0) ::dup2(err_fd, 2);
    ::execvpe(args[0], args.data(), vars.data());
    std::fprintf(stderr, "test harness: cannot start %s: %s\n", args[0], std::strerror(errno));
    ::_exit(127);
  }
  return pid;
}

std::string below(const char* variable, const std::string& path) {
  const char* root = std::getenv(variable);  // NOLINT(concurrency-mt-unsafe): nothing sets it
  if (!root) {
    std::fprintf(stderr, "test harness: $%s is not set; run me through `meson test`\n", variable);
    std::abort();
  }
  return std::string(root) + "/" + path;
}

}  // namespace

std::string built(const std::string& path) { return below("DSSM_BUILD_ROOT", path); }
std::string source(const std::string& path) { return below("DSSM_SOURCE_ROOT", path); }

std::string make_temp_dir() {
  std::string path = "/tmp/dssm-test-XXXXXX";
  if (!::mkdtemp(path.data())) fail("mkdtemp");
  ::chmod(path.c_str(), 0755);
  return path;
}

void remove_tree(const std::string& path) { std::filesystem::remove_all(path); }

std::uint16_t free_port(int socket_type) {
  const auto [socket, port] = reserve_port(socket_type);
  ::close(socket);
  return port;
}

std::pair<int, std::uint16_t> reserve_port(int socket_type) {
  const int socket = ::socket(AF_INET, socket_type | SOCK_CLOEXEC, 0);
  constexpr int kYes = 1;
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t length = sizeof address;
  auto* const any = reinterpret_cast<sockaddr*>(&address);
  // The option after bind(), which else may give a port that another one has reserved so.
  if (socket < 0 || ::bind(socket, any, length) || ::getsockname(socket, any, &length) ||
      ::setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &kYes, sizeof kYes)) {
    fail("find a free port");
  }
  return {socket, ntohs(address.sin_port)};
}

void become_nobody(const std::vector<gid_t>& groups) {
  if (::setgroups(groups.size(), groups.data()) || ::setresgid(kNobody, kNobody, kNobody) ||
      ::setresuid(kNobody, kNobody, kNobody)) {
    ::_exit(100);
  }
}

MemoryLimit::MemoryLimit(pid_t pid, std::uint64_t more_bytes) : pid_(pid) {
  std::ifstream statm("/proc/" + std::to_string(pid) + "/statm");
  std::uint64_t pages = 0;
  statm >> pages;
  ::prlimit(pid, RLIMIT_AS, nullptr, &before_);
  const rlimit limit{pages * static_cast<std::uint64_t>(::getpagesize()) + more_bytes,
                     before_.rlim_max};
  ::prlimit(pid, RLIMIT_AS, &limit, nullptr);
}
MemoryLimit::~MemoryLimit() { ::prlimit(pid_, RLIMIT_AS, &before_, nullptr); }

int wait_for(pid_t pid) {
  int status = 0;
  while (::waitpid(pid, &status, 0) < 0) {
    if (errno != EINTR) fail("waitpid");
  }
  return WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
}

pid_t start(const std::vector<std::string>& argv, const std::vector<std::string>& environment,
            int out_fd) {
  return spawn(argv, environment, -1, out_fd >= 0 ? out_fd : 2, -1);
}

Finished run(const std::vector<std::string>& argv, const std::vector<std::string>& environment,
             const std::string& input) {
  int in[2], out[2], err[2];
  if (::pipe2(in, O_CLOEXEC) || ::pipe2(out, O_CLOEXEC) || ::pipe2(err, O_CLOEXEC)) fail("pipe2");
  const pid_t pid = spawn(argv, environment, in[0], out[1], err[1]);
  ::close(in[0]), ::close(out[1]), ::close(err[1]);
  if (!input.empty() && ::write(in[1], input.data(), input.size()) < 0) fail("write to stdin");
  ::close(in[1]);
  Finished result;
  pollfd fds[2] = {{out[0], POLLIN, 0}, {err[0], POLLIN, 0}};
  std::string* texts[2] = {&result.out, &result.err};
  for (int open = 2; open > 0;) {
    if (::poll(fds, 2, -1) < 0 && errno != EINTR) fail("poll");
    for (int i = 0; i < 2; ++i) {
      if (!fds[i].revents) continue;
      char buffer[65536];
      const ssize_t n = ::read(fds[i].fd, buffer, sizeof buffer);
      if (n > 0) {
        texts[i]->append(buffer, static_cast<std::size_t>(n));
      } else {
        ::close(fds[i].fd);
        fds[i].fd = -1;
        --open;
      }
    }
  }
  result.exit_status = wait_for(pid);
  return result;
}

namespace {

bool listens(const std::vector<std::string>& words) {
  return std::any_of(words.begin(), words.end(), [](const std::string& word) {
    return word == "--listen" || word.starts_with("--listen=") || word == "--config";
  });
}

// From the status line "..., listening at A, B".
std::vector<std::string> addresses_in(const std::string& text) {
  constexpr std::string_view kMark = "listening at ";
  std::vector<std::string> addresses;
  std::size_t at = text.find(kMark);
  if (at == text.npos) return addresses;
  for (at += kMark.size();; at += 2) {
    const std::size_t end = std::min(text.find_first_of(",\n", at), text.size());
    addresses.push_back(text.substr(at, end - at));
    at = end;
    if (text.compare(at, 2, ", ") != 0) return addresses;
  }
}

// The vehicle of a test program: its authority, and what that issued.
class Vehicle {
 public:
  Vehicle() { pki({"init", "--ca", dir + "/ca", "--name", "test"}); }
  Vehicle(const Vehicle&) = delete;
  Vehicle& operator=(const Vehicle&) = delete;
  ~Vehicle() {
    if (::getpid() == made_by_) remove_tree(dir);
  }

  // kind: "--host", "--program"
  std::string credentials_for(const std::string& kind, const std::string& name) const {
    const std::string folder = dir + "/" + name, request = folder + ".csr",
                      bundle = folder + ".pem";
    if (::access((folder + "/own.crt").c_str(), F_OK) == 0) return folder;
    pki({"request", kind, name, "--credentials", folder, "--out", request});
    pki({"issue", request, "--ca", dir + "/ca", "--out", bundle});
    pki({"install", bundle, "--credentials", folder});
    return folder;
  }

  const std::string dir = make_temp_dir();

 private:
  const pid_t made_by_ = ::getpid();
};

const Vehicle& vehicle() {
  static const Vehicle one;
  return one;
}

}  // namespace

void pki(std::vector<std::string> words) {
  words.insert(words.begin(), {built("client/dssmctl/dssmctl"), "pki"});
  const Finished finished = run(words);
  if (finished.exit_status == 0) return;
  std::fprintf(stderr, "test harness: dssmctl pki failed: %s\n", finished.err.c_str());
  std::abort();
}

std::string credentials_for(const std::string& name) {
  return vehicle().credentials_for("--host", name);
}
std::string credentials_for_program(const std::string& name) {
  return vehicle().credentials_for("--program", name);
}
// NOLINTNEXTLINE(concurrency-mt-unsafe): nothing sets it
bool tests_tls() { return std::getenv("DSSM_TEST_TLS") != nullptr; }
std::string authority_folder() { return vehicle().dir + "/ca"; }

DaemonProcess::DaemonProcess(std::vector<std::string> extra, const std::string& host)
    : dir_(make_temp_dir()) {
  argv_ = {built("daemon/dssmd"), "--runtime-dir", dir_, "--name", host};
  // An unused port: tests must not depend on a chronyd of this machine.
  if (std::find(extra.begin(), extra.end(), "--chronyd") == extra.end()) {
    argv_.insert(argv_.end(), {"--chronyd", "127.0.0.1:1"});
  }
  const bool sets_mdns = std::any_of(extra.begin(), extra.end(), [](const std::string& word) {
    return word.starts_with("--mdns");
  });
  if (!sets_mdns) argv_.emplace_back("--mdns=false");
  const bool has_own_credentials = std::any_of(extra.begin(), extra.end(), [](const auto& word) {
    return word == "--credentials" || word == "--config";
  });
  if (tests_tls() && !has_own_credentials) {
    argv_.insert(argv_.end(), {"--credentials", credentials_for(host)});
  }
  argv_.insert(argv_.end(), extra.begin(), extra.end());
  if (!listens(extra)) {
    const auto [socket, port] = reserve_port(SOCK_STREAM);
    port_fd_ = socket;
    argv_.insert(argv_.end(), {"--listen", "127.0.0.1:" + std::to_string(port)});
  }
  start();
}

void DaemonProcess::call(const std::string& host) {
  *(std::find(argv_.begin(), argv_.end(), "--name") + 1) = host;
  const auto credentials = std::find(argv_.begin(), argv_.end(), "--credentials");
  if (credentials != argv_.end()) *(credentials + 1) = credentials_for(host);
}

void DaemonProcess::start() {
  const std::string notify_path = dir_ + "/notify";
  const int notify = ::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  std::strncpy(address.sun_path, notify_path.c_str(), sizeof address.sun_path - 1);
  ::unlink(notify_path.c_str());
  if (::bind(notify, reinterpret_cast<sockaddr*>(&address), sizeof address))
    fail("bind notify socket");
  pid_ = test::start(argv_, {"NOTIFY_SOCKET=" + notify_path});
  for (;;) {  // a daemon that ends early is detected by its status
    pollfd fd{notify, POLLIN, 0};
    char text[4096] = {};
    if (::poll(&fd, 1, 100) > 0 && ::recv(notify, text, sizeof text - 1, 0) > 0 &&
        std::strstr(text, "READY=1")) {
      addresses_ = addresses_in(text);
      break;
    }
    if (::waitpid(pid_, nullptr, WNOHANG) == pid_) {
      std::fprintf(stderr, "test harness: dssmd ended before it was ready\n");
      std::abort();
    }
  }
  ::close(notify);
  ::unlink(notify_path.c_str());
}

void DaemonProcess::expect_no_crash() const {
  siginfo_t ended{};
  if (::waitid(P_PID, static_cast<id_t>(pid_), &ended, WEXITED | WNOHANG | WNOWAIT)) return;
  const bool is_expected = ended.si_pid == 0 || ended.si_status == 0 ||
                           (ended.si_code == CLD_KILLED && ended.si_status == SIGKILL);
  if (is_expected) return;
  std::fprintf(stderr, "test harness: dssmd of '%s' ended by itself, with %s %d\n", dir_.c_str(),
               ended.si_code == CLD_EXITED ? "status" : "signal", ended.si_status);
  std::abort();
}

void DaemonProcess::kill_hard() {
  expect_no_crash();
  ::kill(pid_, SIGKILL);
  wait_for(pid_);
  pid_ = -1;
}

int DaemonProcess::stop() {
  ::kill(pid_, SIGTERM);
  const int status = wait_for(pid_);
  pid_ = -1;
  return status;
}

DaemonProcess::~DaemonProcess() {
  if (pid_ > 0) kill_hard();
  if (port_fd_ >= 0) ::close(port_fd_);
  remove_tree(dir_);
}

}  // namespace dssm::test
