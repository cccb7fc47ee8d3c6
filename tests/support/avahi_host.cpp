// SPDX-License-Identifier: Apache-2.0
#include "tests/support/avahi_host.hpp"

#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <utility>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

bool is_installed(const std::string& program) {
  for (const char* folder : {"/usr/sbin/", "/usr/bin/", "/sbin/", "/bin/"}) {
    if (::access((folder + program).c_str(), X_OK) == 0) return true;
  }
  return false;
}

void end(pid_t& pid) {
  if (pid <= 0) return;
  ::kill(pid, SIGKILL);
  wait_for(std::exchange(pid, -1));
}

}  // namespace

Result<std::unique_ptr<AvahiHost>> AvahiHost::open(const Network& network, int host,
                                                   const std::string& name) {
  for (const char* program : {"dbus-daemon", "avahi-daemon", "unshare"}) {
    if (!is_installed(program)) {
      return Error{Errc::not_found, std::string("no ") + program +
                                        " on this machine; install the packages dbus-daemon and "
                                        "avahi-daemon"};
    }
  }
  std::unique_ptr<AvahiHost> made(new AvahiHost(network, host, make_temp_dir()));
  // A bus like the system's, without restrictions.
  std::ofstream(made->dir_ + "/dbus.conf")
      << "<!DOCTYPE busconfig PUBLIC \"-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN\"\n"
         " \"http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd\">\n"
         "<busconfig>\n"
         "  <type>system</type>\n"
         "  <listen>unix:path="
      << made->dir_
      << "/bus</listen>\n"
         "  <auth>EXTERNAL</auth>\n"
         "  <policy context=\"default\">\n"
         "    <allow user=\"*\"/><allow own=\"*\"/><allow eavesdrop=\"true\"/>\n"
         "    <allow send_destination=\"*\"/><allow send_type=\"method_call\"/>\n"
         "    <allow receive_type=\"method_call\"/>\n"
         "  </policy>\n"
         "</busconfig>\n";
  std::ofstream(made->dir_ + "/avahi.conf") << "[server]\n"
                                               "host-name="
                                            << name
                                            << "\n"
                                               "use-ipv4=yes\n"
                                               "use-ipv6=yes\n"
                                               "disallow-other-stacks=no\n"
                                               "enable-dbus=yes\n"
                                               "ratelimit-interval-usec=1000000\n"
                                               "ratelimit-burst=1000\n";
  return made;
}

AvahiHost::~AvahiHost() {
  kill_avahi();
  kill_dbus();
  remove_tree(dir_);
}

std::string AvahiHost::environment() const {
  return "DBUS_SYSTEM_BUS_ADDRESS=unix:path=" + dir_ + "/bus";
}

std::string AvahiHost::account() const {
  std::string text = "avahi-daemon ";
  siginfo_t end{};
  if (avahi_ <= 0) {
    text += "does not run";
  } else if (::waitid(P_PID, static_cast<id_t>(avahi_), &end, WEXITED | WNOHANG | WNOWAIT) == 0 &&
             end.si_pid == avahi_) {
    text += (end.si_code == CLD_EXITED ? "has ended with status " : "was ended by signal ") +
            std::to_string(end.si_status);
  } else {
    text += "runs";
  }
  std::ifstream log(dir_ + "/avahi.log");
  std::stringstream words;
  words << log.rdbuf();
  constexpr std::size_t kEnough = 4096;
  const std::string said = words.str();
  return text + "; its log:\n" + said.substr(said.size() - std::min(said.size(), kEnough));
}

void AvahiHost::start_dbus() {
  const Inside in_host = inside();
  ::unlink((dir_ + "/bus").c_str());
  int address[2];
  if (::pipe2(address, O_CLOEXEC) != 0) std::abort();
  dbus_ = start({"dbus-daemon", "--config-file=" + dir_ + "/dbus.conf", "--nofork", "--nopidfile",
                 "--print-address=1"},
                {}, address[1]);
  ::close(address[1]);
  // It prints its address after it has started to listen.
  char byte;
  if (::read(address[0], &byte, 1) != 1) {
    std::fprintf(stderr, "test harness: dbus-daemon does not start\n");
    std::abort();
  }
  ::close(address[0]);
}

void AvahiHost::start_avahi() {
  const Inside in_host = inside();
  avahi_ = start({"unshare", "--mount", "sh", "-c",
                  "mount -t tmpfs tmpfs /run && mkdir /run/avahi-daemon && exec avahi-daemon "
                  "--no-drop-root --no-rlimits --no-chroot --file=\"$1\" 2>>\"$2\"",
                  "sh", dir_ + "/avahi.conf", dir_ + "/avahi.log"},
                 {environment()});
}

void AvahiHost::kill_dbus() { end(dbus_); }
void AvahiHost::kill_avahi() { end(avahi_); }
void AvahiHost::pause_avahi() { ::kill(avahi_, SIGSTOP); }

}  // namespace dssm::test
