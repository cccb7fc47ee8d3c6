// SPDX-License-Identifier: Apache-2.0
//
// Namespaces are created with unshare(2), held by descriptors, and configured with ip(8), which
// accepts /proc/PID/fd/N as the name of a namespace.
#include "tests/support/network.hpp"

#include <fcntl.h>
#include <sched.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

UniqueFd namespace_of_this_thread() {
  return UniqueFd(::open("/proc/thread-self/ns/net", O_RDONLY | O_CLOEXEC));
}

void enter(int network_namespace) {
  if (::setns(network_namespace, CLONE_NEWNET) == 0) return;
  std::fprintf(stderr, "test harness: setns: %s\n", std::strerror(errno));
  std::abort();  // continuing in the wrong network would test nothing
}

// A new namespace; it has only a loopback interface, which is down.
Result<UniqueFd> make_namespace() {
  const UniqueFd before = namespace_of_this_thread();
  if (!before) return os_error("open /proc/thread-self/ns/net");
  if (::unshare(CLONE_NEWNET) != 0) return os_error("make a network namespace");
  UniqueFd made = namespace_of_this_thread();
  enter(before.get());
  if (!made) return os_error("open /proc/thread-self/ns/net");
  return made;
}

// Runs lines of `ip` commands, without the word ip.
Result<void> try_ip(const std::string& lines) {
  const Finished finished = run({"ip", "-batch", "-"}, {}, lines);
  if (finished.exit_status == 0) return {};
  return Error{Errc::system, "ip -batch: " + finished.err};
}

void ip(const std::string& lines) {
  const Result<void> done = try_ip(lines);
  if (done) return;
  std::fprintf(stderr, "test harness: %s%s", lines.c_str(), done.error().message.c_str());
  std::abort();
}

std::string path_of(const UniqueFd& fd) {
  return "/proc/" + std::to_string(::getpid()) + "/fd/" + std::to_string(fd.get());
}

void run_or_abort(const std::vector<std::string>& command) {
  const Finished finished = run(command);
  if (finished.exit_status == 0) return;
  std::fprintf(stderr, "test harness: %s: %s", command[0].c_str(), finished.err.c_str());
  std::abort();
}

}  // namespace

Inside::Inside(int network_namespace) : before_(namespace_of_this_thread()) {
  enter(network_namespace);
}

Inside::~Inside() { enter(before_.get()); }

std::string Network::name(int host) { return "pc" + std::to_string(host); }
std::string Network::address(int host) { return "10.77.0." + std::to_string(host); }
std::string Network::address6(int host) { return "fd77::" + std::to_string(host); }

Result<std::unique_ptr<Network>> Network::open(int hosts) {
  if (::geteuid() != 0) {
    return Error{Errc::no_permission, "only root may make network namespaces"};
  }
  if (::access("/usr/sbin/ip", X_OK) != 0 && ::access("/sbin/ip", X_OK) != 0) {
    return Error{Errc::not_found, "no ip(8) on this machine; install the package iproute2"};
  }
  std::unique_ptr<Network> network(new Network);
  Result<UniqueFd> made = make_namespace();
  if (!made) return std::move(made).error();
  network->switch_ = *std::move(made);
  const Inside inside(network->switch_.get());
  // A kernel may lack these two kinds of interface. Snooping would drop the first neighbour
  // solicitations of IPv6.
  const Result<void> usable = try_ip(
      "link add switch type bridge mcast_snooping 0\n"
      "link set switch up\n"
      "link add probe type veth peer name probe-peer\n"
      "link del probe\n");
  if (!usable) return Error(usable.error()).context("this kernel has no bridge or no veth");
  for (int host = 1; host <= hosts; ++host) {
    made = make_namespace();
    if (!made) return std::move(made).error();
    network->hosts_.push_back(*std::move(made));
    network->configure(host, "link set lo up\n");
    network->connect(host, name(host), "eth0");
    network->configure(host, "address add " + address(host) + "/24 dev eth0\n" +  //
                                 // nodad: usable at once, also after a reconnection.
                                 "address add " + address6(host) + "/64 dev eth0 nodad\n");
  }
  return network;
}

// `port` is the end of the cable at the switch.
void Network::connect(int host, const std::string& port, const std::string& interface) {
  {
    const Inside inside(switch_.get());
    ip("link add " + port + " type veth peer name " + interface + " netns " +
       path_of(hosts_.at(static_cast<std::size_t>(host) - 1)) + "\n" +  //
       "link set " + port + " master switch\n" +                        //
       "link set " + port + " up\n");
  }
  configure(host, "link set " + interface + " up\n");
}

void Network::add_cable(int host, const std::string& interface) {
  connect(host, name(host) + "-" + interface, interface);
}

void Network::configure(int host, const std::string& lines) const {
  const Inside in_host = inside(host);
  ip(lines);
}

Result<void> Network::swallow(int host) {
  if (::access("/usr/sbin/nft", X_OK) != 0) {
    return Error{Errc::not_found, "no nft(8) on this machine; install the package nftables"};
  }
  const Inside in_host = inside(host);
  const Finished finished =
      run({"/usr/sbin/nft", "-f", "-"}, {},
          "table inet swallow { chain input { type filter hook input priority 0; "
          "iif != lo meta l4proto tcp drop; }; }\n");
  if (finished.exit_status == 0) return {};
  return Error{Errc::system, "nft -f: " + finished.err};
}

void Network::stop_swallowing(int host) {
  const Inside in_host = inside(host);
  run_or_abort({"/usr/sbin/nft", "delete", "table", "inet", "swallow"});
}

void Network::cut(int host) {
  const Inside inside(switch_.get());
  ip("link set " + name(host) + " down\n");
}

void Network::heal(int host) {
  const Inside inside(switch_.get());
  ip("link set " + name(host) + " up\n");
}

void Network::set_port_state(int host, const char* state) {
  const Inside inside(switch_.get());
  run_or_abort({"bridge", "link", "set", "dev", name(host), "state", state});
}

void Network::block(int host) { set_port_state(host, "disabled"); }

void Network::unblock(int host) { set_port_state(host, "forwarding"); }

Result<void> Network::shape(int host, const std::string& how) {
  const Inside inside(switch_.get());
  // tc reads commands like ip.
  const Finished finished =
      run({"tc", "-batch", "-"}, {}, "qdisc replace dev " + name(host) + " root " + how + "\n");
  if (finished.exit_status == 0) return {};
  return Error{Errc::system, "tc qdisc ... " + how + ": " + finished.err};
}

}  // namespace dssm::test
