// SPDX-License-Identifier: Apache-2.0
#include "remote_broadcast.hpp"

#include "process.hpp"

namespace dssm::ssm {
namespace {

const StreamId kStream{"dssm_broadcast", 0, {}};

// "10.0.0.2:13776", "[fe80::1]:13776" in two.
void split(const std::string& text, std::string& address, std::string& port) {
  const std::size_t colon = text.rfind(':');
  if (colon == text.npos) {
    address = text;
    return;
  }
  address = text.substr(0, colon);
  port = text.substr(colon + 1);
  if (address.size() > 2 && address.front() == '[') address = address.substr(1, address.size() - 2);
}

}  // namespace

Result<Session*> Broadcast::session() {
  if (session_) return &*session_;
  Result<Session> any = process().any_session();
  if (!any) return std::move(any).error();
  session_ = std::move(*any);
  return &*session_;
}

Result<void> Broadcast::show(std::span<const std::byte> block) {
  auto local = session();
  if (!local) return std::move(local).error();
  if (!stream_) {
    auto created = (*local)->create_raw(kStream, TypeInfo{{}, 1, 1, {}},
                                        History{kMinDepth, std::chrono::seconds(1)});
    if (!created) return std::move(created).error();
    stream_ = std::move(*created);
  }
  return stream_->set_property(block);
}

Result<std::vector<Broadcast::Host>> Broadcast::hosts() {
  auto local = session();
  if (!local) return std::move(local).error();
  auto known = (*local)->list_hosts();
  if (!known) return std::move(known).error();
  std::vector<Host> found;
  for (const HostInfo& info : *known) {
    if (info.state != HostState::self && info.state != HostState::up) continue;
    Host host;
    // The last one is where it was reached, if it was configured by another name.
    if (!info.addresses.empty()) split(info.addresses.back(), host.address, host.port);
    auto block = (*local)->property({kStream.name, kStream.id, info.name});
    if (block) host.block = std::move(*block);
    found.push_back(std::move(host));
  }
  return found;
}

}  // namespace dssm::ssm
