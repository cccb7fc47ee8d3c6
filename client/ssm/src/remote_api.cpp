// SPDX-License-Identifier: Apache-2.0
//
// <dssm-proxy-client.hpp>: the functions between the old remote interface and RemoteStream, and the
// old DSSM's broadcasts, on top of the catalog. What a host shows is the property of a small stream
// of its own, "dssm_broadcast:0"; a program that wants to know asks the dssmd of this PC for the
// hosts, and each host for that property.
#include <fmt/format.h>

#include <cstring>
#include <dssm/session.hpp>
#include <optional>
#include <string>

#include "../include/dssm-proxy-client.hpp"
#include "convert.hpp"
#include "core/base/try.hpp"
#include "process.hpp"
#include "remote_stream.hpp"

namespace dssm::ssm {

// One thread at a time.
struct Broadcast {
  Result<Session*> connect();
  Result<void> show(std::span<const std::byte> block);

  std::optional<Session> session;
  std::optional<RawWriter> stream;  // held, so that it survives a restart of dssmd
};

static const StreamId kBroadcast{"dssm_broadcast", 0, {}};

Result<Session*> Broadcast::connect() {
  if (!session) session = DSSM_TRY(process().any_session());
  return &*session;
}

Result<void> Broadcast::show(std::span<const std::byte> block) {
  Session* const local = DSSM_TRY(connect());
  if (!stream) {
    stream = DSSM_TRY(local->create_raw(kBroadcast, TypeInfo{{}, 1, 1, {}},
                                        History{kMinDepth, std::chrono::seconds(1)},
                                        {.keep_existing = true}));
  }
  return stream->set_property(block);
}

}  // namespace dssm::ssm

using dssm::ssm::Broadcast;
using dssm::ssm::process;
using dssm::ssm::RemoteStream;
using dssm::ssm::report_error;
using dssm::ssm::report_failure;

struct dssm_ssm_remote {
  RemoteStream stream;
  Broadcast broadcast;
};

namespace {

struct HostAddress {
  std::string address, port;
};

// "10.0.0.2:13776", "[fe80::1]:13776" in two.
HostAddress split(const std::string& text) {
  const std::size_t colon = text.rfind(':');
  if (colon == text.npos) return {text, {}};
  std::string address = text.substr(0, colon);
  if (address.size() > 2 && address.front() == '[') address = address.substr(1, address.size() - 2);
  return {address, text.substr(colon + 1)};
}

// Whether `address` means this PC, judged by its text, so that no name has to be looked up.
bool is_this_pc(const std::string& address) {
  for (const char* own : {"127.", "localhost", "::1", "[::1]"}) {
    if (address.compare(0, std::strlen(own), own) == 0) return true;
  }
  return address.empty();
}

RemoteStream::Which which_of(int which) {
  switch (which) {
    case DSSM_SSM_TID:
      return RemoteStream::Which::tid;
    case DSSM_SSM_NEWER:
      return RemoteStream::Which::newer;
    case DSSM_SSM_NEXT:
      return RemoteStream::Which::next;
    case DSSM_SSM_AT:
      return RemoteStream::Which::at;
    default:
      return RemoteStream::Which::newest;
  }
}

}  // namespace

extern "C" {

dssm_ssm_remote* dssm_ssm_remote_new(void) { return new dssm_ssm_remote; }

void dssm_ssm_remote_delete(dssm_ssm_remote* remote) { delete remote; }

int dssm_ssm_remote_connect(dssm_ssm_remote* remote, const char* address) {
  return remote->stream.connect(address) ? 1 : 0;
}

int dssm_ssm_remote_create(dssm_ssm_remote* remote, const char* address, const char* name, int id,
                           size_t size, ssmTimeT life, ssmTimeT cycle) {
  if (const auto wrong = dssm::ssm::wrong_arguments(name, id, life, cycle)) {
    report_error(*wrong);
    return 0;
  }
  return remote->stream.create(address, dssm::ssm::stream_id(name, id), dssm::ssm::type_for(size),
                               dssm::ssm::history_of(life, cycle))
             ? 1
             : 0;
}

int dssm_ssm_remote_open(dssm_ssm_remote* remote, const char* address, const char* name, int id,
                         size_t size) {
  const dssm::StreamId stream = dssm::ssm::stream_id(name, id);
  if (dssm::Result<void> checked = stream.check(); !checked) {
    report_failure("open " + dssm::ssm::quoted(name, id), checked.error());
    return 0;
  }
  return remote->stream.open(address, stream, size) ? 1 : 0;
}

int dssm_ssm_remote_is_open(dssm_ssm_remote* remote) { return remote->stream.is_open() ? 1 : 0; }

void dssm_ssm_remote_close(dssm_ssm_remote* remote) { remote->stream.close(); }

SSM_tid dssm_ssm_remote_read(dssm_ssm_remote* remote, int buffered, int which, SSM_tid tid, int dt,
                             ssmTimeT time, void* data, size_t size, ssmTimeT* ret_time) {
  const RemoteStream::Request request{which_of(which), tid, dt, time};
  return buffered ? remote->stream.read_buffered(request, data, size, ret_time)
                  : remote->stream.read(request, data, size, ret_time);
}

SSM_tid dssm_ssm_remote_top(dssm_ssm_remote* remote, int buffered) {
  return buffered ? remote->stream.top_buffered() : remote->stream.top();
}

SSM_tid dssm_ssm_remote_bottom(dssm_ssm_remote* remote) { return remote->stream.bottom(); }

SSM_tid dssm_ssm_remote_tid_at(dssm_ssm_remote* remote, ssmTimeT time) {
  return remote->stream.tid_at(time);
}

int dssm_ssm_remote_is_newer(dssm_ssm_remote* remote, SSM_tid tid) {
  return remote->stream.is_newer(tid) ? 1 : 0;
}

int dssm_ssm_remote_write(dssm_ssm_remote* remote, const void* data, size_t size, ssmTimeT time) {
  return remote->stream.write(data, size, time) ? 1 : 0;
}

int dssm_ssm_remote_set_property(dssm_ssm_remote* remote, const void* data, size_t size) {
  return remote->stream.set_property(data, size) ? 1 : 0;
}

int dssm_ssm_remote_get_property(dssm_ssm_remote* remote, void* data, size_t size) {
  return remote->stream.get_property(data, size) ? 1 : 0;
}

void dssm_ssm_remote_set_offset(const char* address, ssmTimeT offset) {
  if (!is_this_pc(address)) {
    return report_error(fmt::format(
        "setOffset : the SSM clock of '{}' cannot be set from here; call settimeOffset() in a "
        "program on that PC",
        address));
  }
  auto session = process().any_session();
  auto clock = session ? session->open_playback_clock() : std::move(session).error();
  if (!clock) return report_failure("setOffset", clock.error());
  clock->set_offset(offset);
}

int dssm_ssm_remote_buffer(dssm_ssm_remote* remote, ssmTimeT life, ssmTimeT cycle) {
  return remote->stream.buffer(life, cycle) ? 1 : 0;
}

int dssm_ssm_remote_send_broadcast(dssm_ssm_remote* remote, const void* data, size_t size) {
  const auto shown = remote->broadcast.show({static_cast<const std::byte*>(data), size});
  if (!shown) report_failure("sendBroadcast", shown.error());
  return shown ? 1 : 0;
}

void dssm_ssm_remote_receive_broadcast(dssm_ssm_remote* remote,
                                       void (*take)(const char* address, const char* port,
                                                    const void* data, size_t size, void* user_data),
                                       void* user_data) {
  const auto local = remote->broadcast.connect();
  const auto hosts = local ? (*local)->list_hosts() : local.error();
  if (!hosts) return report_failure("receiveBroadcast", hosts.error());
  for (const dssm::HostInfo& host : *hosts) {
    if (host.state != dssm::HostState::self && host.state != dssm::HostState::up) continue;
    // The last one is where it was reached, if it was configured by another name.
    const HostAddress at = host.addresses.empty() ? HostAddress{} : split(host.addresses.back());
    const auto block =
        (*local)->property({dssm::ssm::kBroadcast.name, dssm::ssm::kBroadcast.id, host.name});
    take(at.address.c_str(), at.port.c_str(), block ? block->data() : nullptr,
         block ? block->size() : 0, user_data);
  }
}

}  // extern "C"
