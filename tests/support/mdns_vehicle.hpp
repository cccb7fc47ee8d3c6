// SPDX-License-Identifier: Apache-2.0
//
// A vehicle without configuration for one test: PCs with D-Bus, Avahi, and a dssmd that listens on
// the network and finds the others only by mDNS.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <dssm/dssm.hpp>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/avahi_host.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/network.hpp"

namespace dssm::test {

class MdnsVehicle {
 public:
  // PCs 1 to `pcs`, without a dssmd.
  //   fails  when this machine cannot do it, with the reason: skip the test with it
  Result<void> open(int pcs) {
    const Result<void> made = open_without_avahi(pcs);
    for (int pc = 1; made && pc <= pcs; ++pc) start_avahi(pc);
    return made;
  }
  // The same, but without starting anything, so that the test can change the network first.
  Result<void> open_without_avahi(int pcs) {
    Result<std::unique_ptr<Network>> network = Network::open(pcs);
    if (!network) return std::move(network).error();
    network_ = *std::move(network);
    for (int pc = 1; pc <= pcs; ++pc) {
      if (Result<void> made = name_pc(pc, Network::name(pc)); !made) return made;
    }
    return {};
  }
  // Changes the name of a PC in mDNS; its Avahi must not run.
  Result<void> name_pc(int pc, const std::string& name) {
    Result<std::unique_ptr<AvahiHost>> host = AvahiHost::open(*network_, pc, name);
    if (!host) return std::move(host).error();
    avahi_.resize(std::max(avahi_.size(), static_cast<std::size_t>(pc)));
    avahi_[static_cast<std::size_t>(pc) - 1] = *std::move(host);
    return {};
  }
  void start_avahi(int pc) {
    avahi(pc).start_dbus();
    avahi(pc).start_avahi();
  }
  // Starts a dssmd on the next PC; its name is "pc1" ... or `name`.
  void add_dssmd(const std::vector<std::string>& flags = {}, const std::string& name = {}) {
    const int pc = static_cast<int>(dssmds_.size()) + 1;
    dssmds_.push_back(make_dssmd(pc, name.empty() ? Network::name(pc) : name, flags));
    sessions_.push_back(session_of(dssmd(pc)));
  }

  Network& network() { return *network_; }
  int dssmds() const { return static_cast<int>(dssmds_.size()); }

  AvahiHost& avahi(int pc) { return *avahi_.at(static_cast<std::size_t>(pc) - 1); }
  DaemonProcess& dssmd(int pc) { return *dssmds_.at(static_cast<std::size_t>(pc) - 1); }
  Session& session(int pc) { return sessions_.at(static_cast<std::size_t>(pc) - 1); }

  // Starts one more dssmd, with this name, on a PC.
  std::unique_ptr<DaemonProcess> make_dssmd(int pc, const std::string& name,
                                            std::vector<std::string> flags = {}) {
    const OnPc on_pc(avahi(pc));
    if (flags.empty()) flags = {"--listen", Network::address(pc) + ":0", "--insecure"};
    flags.insert(flags.end(), {"--mdns=true", "--log-level", "notice"});
    return std::make_unique<DaemonProcess>(flags, name);
  }
  static Session session_of(const DaemonProcess& daemon) {
    return Session::connect(
               {.socket_path = daemon.socket_path(), .request_timeout = std::chrono::minutes(1)})
        .value();
  }
  void start_dssmd(int pc) {
    const OnPc on_pc(avahi(pc));
    dssmd(pc).start();
  }

  static std::vector<HostInfo> hosts(Session& on, const std::string& name) {
    std::vector<HostInfo> found;
    for (HostInfo& host : on.list_hosts().value()) {
      if (host.name == name) found.push_back(std::move(host));
    }
    return found;
  }
  static bool is_up(Session& on, const std::string& name) {
    const std::vector<HostInfo> found = hosts(on, name);
    return found.size() == 1 && found[0].state == HostState::up;
  }
  static bool lists(Session& on, const StreamId& id) {
    for (const StreamInfo& stream : on.list_streams().value()) {
      if (stream.id == id) return true;
    }
    return false;
  }

 private:
  // While it exists, started programs belong to that PC and use its bus.
  class OnPc {
   public:
    explicit OnPc(AvahiHost& host) : inside_(host.inside()) {
      const std::string setting = host.environment();
      const std::size_t end = setting.find('=');
      name_ = setting.substr(0, end);
      ::setenv(name_.c_str(), setting.substr(end + 1).c_str(), 1);
    }
    OnPc(const OnPc&) = delete;
    OnPc& operator=(const OnPc&) = delete;
    ~OnPc() { ::unsetenv(name_.c_str()); }

   private:
    Inside inside_;
    std::string name_;
  };

  std::unique_ptr<Network> network_;
  std::vector<std::unique_ptr<AvahiHost>> avahi_;
  std::vector<std::unique_ptr<DaemonProcess>> dssmds_;
  std::vector<Session> sessions_;
};

}  // namespace dssm::test
