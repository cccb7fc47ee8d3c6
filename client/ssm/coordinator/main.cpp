// SPDX-License-Identifier: Apache-2.0
//
// ssm-coordinator: dssmd under its old name, for scripts that start `ssm-coordinator`, find it
// with ps and stop it with SIGINT. It runs dssmd as a child and passes requests to stop on to it;
// neither of the two outlives the other. It does nothing else.
//
// Exit status: 0 stopped, 1 help, version or bad options, 255 cannot start or one is running
// already.
#include <fcntl.h>
#include <getopt.h>
#include <limits.h>
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <optional>
#include <string>
#include <vector>

#include "client/ssm/src/socket_path.hpp"

namespace dssm::ssm {
namespace {

constexpr int kUsage = 1, kCannotStart = 255;
constexpr const char* kRule = "--------------------------------------------------";

struct Options {
  bool verbose = false;
  bool quiet = false;
};

void print_help() {
  std::fprintf(stderr,
               "SSM-COORDINATOR\n"
               "  runs dssmd in the foreground, for scripts that expect this name\n"
               "USAGE\n"
               "  ssm-coordinator [-v] [-q]\n"
               "OPTIONS\n"
               "  -v | --verbose              : dssmd logs what it does\n"
               "  -q | --quiet                : no output but errors\n"
               "       --version              : print the version\n"
               "       --without-check-msgque : accepted; there is no message queue any more\n"
               "  -h | --help                 : print this help\n"
               "ENVIRONMENT\n"
               "  DSSM_SOCKET  where programs find dssmd: FOLDER/dssmd.sock. Without it, /run/dssm "
               "where this\n"
               "               user may write there, else $XDG_RUNTIME_DIR/dssm\n");
}

// Nothing, or the exit status when the program is to end.
std::optional<int> parse(int argc, char** argv, Options& options) {
  enum : int { version = 256, without_check };
  const option known[] = {{"verbose", no_argument, nullptr, 'v'},
                          {"quiet", no_argument, nullptr, 'q'},
                          {"version", no_argument, nullptr, version},
                          {"without-check-msgque", no_argument, nullptr, without_check},
                          {"help", no_argument, nullptr, 'h'},
                          {nullptr, 0, nullptr, 0}};
  for (;;) {
    // NOLINTNEXTLINE(concurrency-mt-unsafe): one thread
    switch (::getopt_long(argc, argv, "vqh", known, nullptr)) {
      case -1:
        if (optind == argc) return std::nullopt;
        std::fprintf(stderr, "ssm-coordinator: '%s' is not an option; see --help\n", argv[optind]);
        return kUsage;
      case 'v':
        options.verbose = true;
        break;
      case 'q':
        options.quiet = true;
        break;
      case without_check:
        break;
      case version:
        std::puts(" Ver. " DSSM_VERSION);
        return kUsage;
      default:
        print_help();
        return kUsage;
    }
  }
}

// The folder for dssmd's socket, which programs started in the same environment find.
std::optional<std::string> choose_folder() {
  if (const std::string set = environment("DSSM_SOCKET"); !set.empty()) {
    const std::size_t slash = set.rfind('/');
    if (slash != std::string::npos && slash > 0 && set.substr(slash + 1) == kSocketName) {
      return set.substr(0, slash);
    }
    std::fprintf(stderr,
                 "ERROR : cannot start dssmd at '%s' ($DSSM_SOCKET) : its socket is always called "
                 "%s; set DSSM_SOCKET to a path that ends in /%s\n",
                 set.c_str(), kSocketName, kSocketName);
    return std::nullopt;
  }
  if (::geteuid() == 0 || ::access(kSystemFolder, W_OK) == 0) return kSystemFolder;
  if (std::string own = user_folder(); !own.empty()) return own;
  std::fprintf(stderr,
               "ERROR : cannot start dssmd : this user may not write to %s and has no "
               "$XDG_RUNTIME_DIR; run as root, or set DSSM_SOCKET to FOLDER/%s, with a folder of "
               "your own, here and for all programs\n",
               kSystemFolder, kSocketName);
  return std::nullopt;
}

bool listens(const std::string& path) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof address.sun_path) return false;
  std::memcpy(address.sun_path, path.c_str(), path.size() + 1);
  const int fd = ::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  const bool there =
      ::connect(fd, reinterpret_cast<sockaddr*>(&address), sizeof address) == 0 || errno == EAGAIN;
  ::close(fd);
  return there;
}

// Where dssmd may be: beside this program, where it is in the build folder and in an installation
// with sbin; then whatever PATH finds.
std::vector<std::string> places_of_dssmd() {
  char self[PATH_MAX] = {};
  if (::readlink("/proc/self/exe", self, sizeof self - 1) < 0) return {"dssmd"};
  std::string folder = self;
  folder.resize(folder.rfind('/'));
  return {folder + "/dssmd", folder + "/../../daemon/dssmd", folder + "/../sbin/dssmd", "dssmd"};
}

// A datagram socket with a name that the kernel chose; `name` as NOTIFY_SOCKET wants it.
int open_notify_socket(std::string& name) {
  const int fd = ::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  socklen_t length = sizeof(sa_family_t);
  if (fd < 0 || ::bind(fd, reinterpret_cast<sockaddr*>(&address), length)) return -1;
  length = sizeof address;
  if (::getsockname(fd, reinterpret_cast<sockaddr*>(&address), &length)) return -1;
  name.assign(address.sun_path, length - offsetof(sockaddr_un, sun_path));
  name.front() = '@';  // for the zero byte of an abstract name
  return fd;
}

[[noreturn]] void become_dssmd(const Options& options, const std::string& folder,
                               const std::string& notify, pid_t parent, const sigset_t& signals) {
  ::prctl(PR_SET_PDEATHSIG, SIGTERM);
  if (::getppid() != parent) ::_exit(0);          // it died before that
  ::setenv("NOTIFY_SOCKET", notify.c_str(), 1);   // NOLINT(concurrency-mt-unsafe): one thread
  ::sigprocmask(SIG_SETMASK, &signals, nullptr);  // NOLINT(concurrency-mt-unsafe): one thread
  const char* level = options.verbose ? "debug" : options.quiet ? "error" : "notice";
  std::string tried;
  for (const std::string& place : places_of_dssmd()) {
    const char* const argv[] = {"dssmd",       "--runtime-dir", folder.c_str(),
                                "--log-level", level,           nullptr};
    ::execvp(place.c_str(), const_cast<char**>(argv));
    tried += (tried.empty() ? "" : ", ") + place + " (" + std::strerror(errno) + ")";  // NOLINT
  }
  std::fprintf(stderr, "ERROR : cannot start dssmd : tried %s; install DSSM's daemon\n",
               tried.c_str());
  ::_exit(kCannotStart);
}

struct End {
  int wait_status;
  bool asked_to_stop;

  // Before it handles requests to stop, a signal ends it.
  bool as_asked() const {
    return (WIFEXITED(wait_status) && WEXITSTATUS(wait_status) == 0) ||
           (asked_to_stop && WIFSIGNALED(wait_status) &&
            (WTERMSIG(wait_status) == SIGTERM || WTERMSIG(wait_status) == SIGINT));
  }
};

// Until dssmd ends: reports when it is ready and passes on requests to stop.
End attend(pid_t dssmd, int signals_fd, int notify_fd, const Options& options) {
  bool asked_to_stop = false;
  for (;;) {
    pollfd ready[] = {{signals_fd, POLLIN, 0}, {notify_fd, POLLIN, 0}};
    if (::poll(ready, 2, -1) < 0) continue;
    if (ready[1].revents) {
      char text[256] = {};
      if (::recv(notify_fd, text, sizeof text - 1, 0) > 0 && std::strstr(text, "READY=1") &&
          !options.quiet) {
        // The old text, which scripts wait for; the number is dssmd's pid.
        std::printf("Message queue ready.\nMsg queue ID = %d\n", static_cast<int>(dssmd));
      }
    }
    if (!ready[0].revents) continue;
    signalfd_siginfo signal{};
    if (::read(signals_fd, &signal, sizeof signal) != sizeof signal) continue;
    if (signal.ssi_signo != SIGCHLD) {
      if (!options.quiet) std::printf("\nprogram stop [%u]\n", signal.ssi_signo);
      ::kill(dssmd, SIGTERM);
      asked_to_stop = true;
      continue;
    }
    int status = 0;
    if (::waitpid(dssmd, &status, WNOHANG) == dssmd) return {status, asked_to_stop};
  }
}

int main(int argc, char** argv) {
  ::setvbuf(stdout, nullptr, _IOLBF, 0);
  Options options;
  if (const auto status = parse(argc, argv, options)) return *status;
  for (const std::string& path : socket_paths()) {
    if (!listens(path)) continue;
    std::fprintf(stderr,
                 "ERROR : an SSM coordinator (dssmd) is running already, at '%s'.\n"
                 "        Use that one, or stop it first: Ctrl-C where it runs, "
                 "killall -s SIGINT ssm-coordinator, or systemctl stop dssmd\n",
                 path.c_str());
    return kCannotStart;
  }
  const std::optional<std::string> folder = choose_folder();
  if (!folder) return kCannotStart;
  if (!options.quiet) {
    std::printf("\n%s\nSSM ( Streaming data Sharing Manager )\n Ver. " DSSM_VERSION "\n%s\n\n",
                kRule, kRule);
  }

  std::string notify_name;
  const int notify_fd = open_notify_socket(notify_name);
  sigset_t attended, before;
  ::sigemptyset(&attended);
  for (const int signal : {SIGINT, SIGTERM, SIGHUP, SIGCHLD}) ::sigaddset(&attended, signal);
  ::sigprocmask(SIG_BLOCK, &attended, &before);  // NOLINT(concurrency-mt-unsafe): one thread
  const int signals_fd = ::signalfd(-1, &attended, SFD_CLOEXEC);
  const pid_t self = ::getpid();
  const pid_t dssmd = ::fork();
  if (notify_fd < 0 || signals_fd < 0 || dssmd < 0) {
    std::fprintf(stderr, "ERROR : cannot start dssmd : %s\n", std::strerror(errno));  // NOLINT
    return kCannotStart;
  }
  if (dssmd == 0) become_dssmd(options, *folder, notify_name, self, before);

  const End end = attend(dssmd, signals_fd, notify_fd, options);
  if (!end.as_asked()) {
    const int status = end.wait_status;
    std::fprintf(stderr, "ERROR : dssmd ended with %s %d; its own messages are above\n",
                 WIFEXITED(status) ? "status" : "signal",
                 WIFEXITED(status) ? WEXITSTATUS(status) : WTERMSIG(status));
    return kCannotStart;
  }
  if (!options.quiet) {
    std::puts("finalize...\n - all allocated shared memory released\nexit");
  }
  return 0;
}

}  // namespace
}  // namespace dssm::ssm

int main(int argc, char** argv) { return dssm::ssm::main(argc, argv); }
