// SPDX-License-Identifier: Apache-2.0
//
// <dssm-proxy-client.hpp>: the functions between the old remote interface and RemoteStream.
#include <array>
#include <cstring>
#include <new>

#include "../include/dssm-proxy-client.hpp"
#include "messages.hpp"
#include "process.hpp"
#include "remote_broadcast.hpp"
#include "remote_stream.hpp"
#include "stream_arguments.hpp"

using dssm::ssm::RemoteStream;
using dssm::ssm::report_error;

struct dssm_ssm_remote {
  RemoteStream stream;
  dssm::ssm::Broadcast broadcast;
};

namespace {

// Whether `address` means this PC: by its words, so that no name has to be looked up.
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
    report_error("open " + dssm::ssm::quoted(name, id) + " : " + checked.error().message);
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
    report_error("setOffset : the SSM clock of '" + std::string(address) +
                 "' cannot be set from here; call settimeOffset() in a program on that PC");
    return;
  }
  auto session = dssm::ssm::process().any_session();
  auto clock = session ? session->open_playback_clock() : std::move(session).error();
  if (!clock) return report_error("setOffset : " + clock.error().message);
  clock->set_offset(offset);
}

int dssm_ssm_remote_buffer(dssm_ssm_remote* remote, ssmTimeT life, ssmTimeT cycle) {
  return remote->stream.buffer(life, cycle) ? 1 : 0;
}

int dssm_ssm_remote_send_broadcast(dssm_ssm_remote* remote, const void* data, size_t size) {
  const auto shown = remote->broadcast.show({static_cast<const std::byte*>(data), size});
  if (!shown) report_error("sendBroadcast : " + shown.error().message);
  return shown ? 1 : 0;
}

void dssm_ssm_remote_receive_broadcast(dssm_ssm_remote* remote,
                                       void (*take)(const char* address, const char* port,
                                                    const void* data, size_t size, void* user_data),
                                       void* user_data) {
  const auto hosts = remote->broadcast.hosts();
  if (!hosts) return report_error("receiveBroadcast : " + hosts.error().message);
  for (const dssm::ssm::Broadcast::Host& host : *hosts) {
    take(host.address.c_str(), host.port.c_str(), host.block ? host.block->data() : nullptr,
         host.block ? host.block->size() : 0, user_data);
  }
}

}  // extern "C"
