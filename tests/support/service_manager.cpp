// SPDX-License-Identifier: Apache-2.0
#include "tests/support/service_manager.hpp"

#include <fcntl.h>
#include <linux/kcmp.h>
#include <poll.h>
#include <signal.h>
#include <sys/eventfd.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <utility>

#include "tests/support/daemon_process.hpp"

extern char** environ;

namespace dssm::test {
namespace {

constexpr int kFirstHandedOver = 3;  // SD_LISTEN_FDS_START

[[noreturn]] void fail(const char* what) {
  std::fprintf(stderr, "test harness: service manager: %s: %s\n", what, std::strerror(errno));
  std::abort();
}

UniqueFd bind_unix(const std::string& path, int type) {
  UniqueFd fd(::socket(AF_UNIX, type | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  std::strncpy(address.sun_path, path.c_str(), sizeof address.sun_path - 1);
  if (::bind(fd.get(), reinterpret_cast<sockaddr*>(&address), sizeof address)) fail("bind");
  return fd;
}

bool is_same_open_file(int one, int other) {
  const pid_t self = ::getpid();
  return ::syscall(SYS_kcmp, self, self, KCMP_FILE, one, other) == 0;
}

ino_t inode_of(int fd) {
  struct stat file {};
  if (::fstat(fd, &file)) fail("fstat");
  return file.st_ino;
}

// The value of `key` in a message "KEY=value\nOTHER=..."; empty if missing.
std::string value_of(const std::string& message, const std::string& key) {
  const std::string lines = "\n" + message + "\n";
  const std::size_t at = lines.find("\n" + key + "=");
  if (at == lines.npos) return {};
  const std::size_t begin = at + key.size() + 2;
  return lines.substr(begin, lines.find('\n', begin) - begin);
}

}  // namespace

ServiceManager::ServiceManager(Options options)
    : options_(std::move(options)), dir_(make_temp_dir()) {
  notify_ = bind_unix(dir_ + "/notify", SOCK_DGRAM);
  if (options_.socket) {
    local_ = bind_unix(socket_path(), SOCK_STREAM);
    ::chmod(socket_path().c_str(), 0660);
    if (::listen(local_.get(), SOMAXCONN)) fail("listen");
  }
  stop_listening_.reset(::eventfd(0, EFD_CLOEXEC));
  thread_ = std::thread([this] { listen(); });
  const auto says_where = [](const std::string& word) {
    return word.starts_with("--listen") || word == "--config";
  };
  if (std::any_of(options_.arguments.begin(), options_.arguments.end(), says_where)) {
    start();
  } else {
    options_.arguments.insert(options_.arguments.end(), {"--listen", "127.0.0.1:0"});
    start();
    options_.arguments.back() = address();
  }
}

ServiceManager::~ServiceManager() {
  if (pid_ > 0) end(SIGKILL);
  const std::uint64_t one = 1;
  if (::write(stop_listening_.get(), &one, sizeof one) < 0) fail("stop listening");
  thread_.join();
  remove_tree(dir_);
}

void ServiceManager::start() {
  std::vector<std::string> arguments = {built("daemon/dssmd"), "--runtime-dir", dir_, "--name",
                                        options_.host,         "--mdns=false"};
  if (tests_tls()) {
    arguments.insert(arguments.end(), {"--credentials", credentials_for(options_.host)});
  }
  arguments.insert(arguments.end(), options_.arguments.begin(), options_.arguments.end());
  std::vector<int> fds;
  std::string names;
  const auto hand_over = [&](int fd, const std::string& name) {
    fds.push_back(fd);
    names.append(names.empty() ? "" : ":").append(name);
  };
  if (local_) hand_over(local_.get(), "local");
  for (const int fd : options_.more_sockets) hand_over(fd, "other");
  {
    const std::lock_guard guard(mutex_);
    drain();
    messages_.clear();
    status_.clear();
    for (const Stored& one : store_) hand_over(one.fd.get(), one.name);
  }
  std::vector<std::string> environment = {"NOTIFY_SOCKET=" + dir_ + "/notify",
                                          "LISTEN_FDS=" + std::to_string(fds.size()),
                                          "LISTEN_FDNAMES=" + names};
  if (options_.watchdog_us > 0) {
    environment.push_back("WATCHDOG_USEC=" + std::to_string(options_.watchdog_us));
  }
  char listen_pid[32] = "LISTEN_PID=";
  std::vector<char*> variables = {listen_pid};
  for (std::string& variable : environment) variables.push_back(variable.data());
  for (char** variable = environ; *variable; ++variable) variables.push_back(*variable);
  variables.push_back(nullptr);
  std::vector<char*> words;
  for (std::string& word : arguments) words.push_back(word.data());
  words.push_back(nullptr);
  const int end_of_handed_over = kFirstHandedOver + static_cast<int>(fds.size());
  const pid_t parent = ::getpid();
  pid_ = ::fork();
  if (pid_ < 0) fail("fork");
  if (pid_ == 0) {  // no other threads here, so no memory may be allocated from now on
    ::prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (::getppid() != parent) ::_exit(127);
    for (int& fd : fds) fd = ::fcntl(fd, F_DUPFD_CLOEXEC, end_of_handed_over);  // out of the way
    for (std::size_t i = 0; i < fds.size(); ++i) {
      ::dup2(fds[i], kFirstHandedOver + static_cast<int>(i));
    }
    std::snprintf(listen_pid, sizeof listen_pid, "LISTEN_PID=%d", ::getpid());
    ::execve(words[0], words.data(), variables.data());
    ::_exit(127);
  }
  await([](const Messages& messages) {
    return std::any_of(messages.begin(), messages.end(),
                       [](const std::string& message) { return message.starts_with("READY=1"); });
  });
}

int ServiceManager::end(int number) {
  ::kill(pid_, number);
  const int status = wait_for(std::exchange(pid_, -1));
  const std::lock_guard guard(mutex_);
  drain();  // like systemd, which handles messages before it handles dead processes
  return status;
}

void ServiceManager::kill_hard() { end(SIGKILL); }

int ServiceManager::stop() {
  const int status = end(SIGTERM);
  const std::lock_guard guard(mutex_);
  store_.clear();
  return status;
}

void ServiceManager::restart() {
  if (end(SIGTERM) != 0) fail("dssmd did not end properly");
  start();
}

void ServiceManager::signal(int number) const { ::kill(pid_, number); }

std::string ServiceManager::address() {
  constexpr std::string_view kMark = "listening at ";
  await_status(std::string(kMark));
  const std::lock_guard guard(mutex_);
  const std::size_t begin = status_.find(kMark) + kMark.size();
  return status_.substr(begin, status_.find(',', begin) - begin);
}

void ServiceManager::await(const std::function<bool(const Messages&)>& is_so) {
  std::unique_lock lock(mutex_);
  changed_.wait(lock, [&] { return is_so(messages_); });
}

ServiceManager::Messages ServiceManager::messages() {
  const std::lock_guard guard(mutex_);
  drain();
  return messages_;
}

void ServiceManager::await_status(const std::string& text) {
  await([&](const Messages&) { return status_.find(text) != status_.npos; });
}

bool ServiceManager::says_within(const std::string& text, std::chrono::milliseconds time) {
  std::unique_lock lock(mutex_);
  drain();
  const std::size_t before = messages_.size();
  return changed_.wait_for(lock, time, [&] {
    return std::any_of(messages_.begin() + static_cast<std::ptrdiff_t>(before), messages_.end(),
                       [&](const std::string& one) { return one.find(text) != one.npos; });
  });
}

std::map<std::string, std::size_t> ServiceManager::stored() {
  const std::lock_guard guard(mutex_);
  drain();
  std::map<std::string, std::size_t> stored;
  for (const Stored& one : store_) ++stored[one.name];
  return stored;
}

std::size_t ServiceManager::stored_descriptors() {
  const std::lock_guard guard(mutex_);
  drain();
  return store_.size();
}

void ServiceManager::put_into_store(const std::string& name, UniqueFd fd) {
  const std::lock_guard guard(mutex_);
  const ino_t inode = inode_of(fd.get());
  store_.push_back({name, std::move(fd), inode});
}

void ServiceManager::await_stored(std::size_t descriptors) {
  await([&](const Messages&) { return store_.size() == descriptors; });
}

int ServiceManager::doubled() {
  const std::lock_guard guard(mutex_);
  drain();
  return doubled_;
}

void ServiceManager::listen() {
  for (;;) {
    pollfd fds[2] = {{notify_.get(), POLLIN, 0}, {stop_listening_.get(), POLLIN, 0}};
    if (::poll(fds, 2, -1) < 0 && errno != EINTR) fail("poll");
    if (fds[1].revents) return;
    const std::lock_guard guard(mutex_);
    drain();
  }
}

void ServiceManager::drain() {
  for (;;) {
    char text[8192];
    alignas(cmsghdr) char control[CMSG_SPACE(253 * sizeof(int))];
    iovec part{text, sizeof text};
    msghdr header{};
    header.msg_iov = &part;
    header.msg_iovlen = 1;
    header.msg_control = control;
    header.msg_controllen = sizeof control;
    const ssize_t bytes = ::recvmsg(notify_.get(), &header, MSG_DONTWAIT | MSG_CMSG_CLOEXEC);
    if (bytes < 0) return;
    std::vector<UniqueFd> fds;
    for (cmsghdr* one = CMSG_FIRSTHDR(&header); one; one = CMSG_NXTHDR(&header, one)) {
      if (one->cmsg_level != SOL_SOCKET || one->cmsg_type != SCM_RIGHTS) continue;
      std::vector<int> numbers((one->cmsg_len - CMSG_LEN(0)) / sizeof(int));
      std::memcpy(numbers.data(), CMSG_DATA(one), numbers.size() * sizeof(int));
      for (const int number : numbers) fds.emplace_back(number);
    }
    take(std::string(text, static_cast<std::size_t>(bytes)), std::move(fds));
  }
}

void ServiceManager::take(const std::string& text, std::vector<UniqueFd> fds) {
  const std::string name = value_of(text, "FDNAME");
  if (value_of(text, "FDSTOREREMOVE") == "1") {
    std::erase_if(store_, [&](const Stored& one) { return one.name == name; });
  } else if (value_of(text, "FDSTORE") == "1") {
    for (UniqueFd& fd : fds) {
      const ino_t inode = inode_of(fd.get());
      const bool is_there = std::any_of(store_.begin(), store_.end(), [&](const Stored& one) {
        return one.inode == inode && is_same_open_file(one.fd.get(), fd.get());
      });
      if (is_there) ++doubled_;
      if (is_there || store_.size() >= options_.store_max) continue;
      store_.push_back({name, std::move(fd), inode});
    }
  }
  if (const std::string status = value_of(text, "STATUS"); !status.empty()) status_ = status;
  messages_.push_back(text);
  changed_.notify_all();
}

}  // namespace dssm::test
