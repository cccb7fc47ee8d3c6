// SPDX-License-Identifier: Apache-2.0
//
// <ssm.h>, <libssm.h>: creating, opening and closing streams, what is known of them, properties.
#include <algorithm>
#include <atomic>
#include <cstring>
#include <dssm/session.hpp>
#include <optional>

#include "../include/libssm.h"
#include "interruptible.hpp"
#include "messages.hpp"
#include "process.hpp"
#include "stream_arguments.hpp"
#include "tid_convert.hpp"
#include "time_convert.hpp"

using dssm::ssm::name_length;
using dssm::ssm::process;
using dssm::ssm::quoted;
using dssm::ssm::remember_error;
using dssm::ssm::report_error;
using dssm::ssm::slots;

namespace {

dssm::Result<dssm::Session> connect_for_second_end() { return process().any_session(); }

// For the calls that find streams by name: nothing when there can be none of that name.
std::optional<dssm::StreamId> find_id(const char* name, int id) {
  if (!name || name_length(name) >= SSM_SNAME_MAX || id < 0) return std::nullopt;
  if (name[name_length(name)] && !name[name_length(name) + 1]) return std::nullopt;
  return dssm::ssm::stream_id(name, id);
}

bool name_too_long(const char* name) { return !name || name_length(name) > SSM_SNAME_MAX; }

dssm::Result<dssm::StreamInfo> ask(const dssm::StreamId& id) {
  auto session = process().session();
  if (!session) return std::move(session).error();
  return session->stream_info(id);
}

}  // namespace

extern "C" {

int calcSSM_table(ssmTimeT life, ssmTimeT cycle) { return static_cast<int>(slots(life, cycle)); }

ssmTimeT calcSSM_life(int table_num, ssmTimeT cycle) {
  return (table_num - SSM_MARGIN) * cycle / SSM_BUFFER_MARGIN;
}

SSM_sid createSSM(const char* stream_name, int stream_id, size_t stream_size, ssmTimeT life,
                  ssmTimeT cycle) {
  if (const auto wrong = dssm::ssm::wrong_arguments(stream_name, stream_id, life, cycle)) {
    report_error(*wrong);
    return nullptr;
  }
  const std::string what = "create " + quoted(stream_name, stream_id) + " : ";
  dssm::Result<dssm::Session> session = process().session();
  if (!session) return report_error(what + session.error().message), nullptr;
  const dssm::StreamId id = dssm::ssm::stream_id(stream_name, stream_id);
  dssm::Result<dssm::RawWriter> writer =
      session->create_raw(id, dssm::ssm::type_for(stream_size), dssm::ssm::history_of(life, cycle),
                          dssm::ssm::kTagHidden);
  if (!writer) return report_error(what + writer.error().message), nullptr;
  if (dssm::ssm::data_bytes(writer->type()) != stream_size) {
    report_error(what + "the stream exists with " +
                 std::to_string(dssm::ssm::data_bytes(writer->type())) + " bytes per sample, not " +
                 std::to_string(stream_size) + "; use its type or another name");
    return nullptr;
  }
  return process().add(
      std::make_unique<dssm::ssm::Stream>(std::move(*writer), &connect_for_second_end));
}

SSM_sid openSSM(const char* stream_name, int stream_id, char open_mode) {
  const auto id = find_id(stream_name, stream_id);
  if (!id) return remember_error("open : not a stream name or id"), nullptr;
  dssm::Result<dssm::Session> session = process().session();
  if (!session) return remember_error(session.error().message), nullptr;
  dssm::Result<dssm::RawReader> reader = session->open_raw_reader(
      *id, nullptr, dssm::ssm::kTagEdge | static_cast<unsigned char>(open_mode));
  if (!reader) return remember_error(reader.error().message), nullptr;
  return process().add(
      std::make_unique<dssm::ssm::Stream>(std::move(*reader), &connect_for_second_end));
}

// Called from signal handlers; see sid_table.hpp.
int closeSSM(SSM_sid* sid) {
  if (sid) process().sids().close(__atomic_exchange_n(sid, nullptr, __ATOMIC_ACQ_REL));
  return 1;
}

int releaseSSM(SSM_sid* sid) { return closeSSM(sid); }

int getSSM_num(void) {
  auto session = process().session();
  auto streams = session ? session->list_own_streams() : std::move(session).error();
  if (!streams) return remember_error(streams.error().message), -1;
  return static_cast<int>(streams->size());
}

int getSSM_name(int n, char* stream_name, int* stream_id, size_t* size) {
  auto session = process().session();
  auto streams = session ? session->list_own_streams() : std::move(session).error();
  if (!streams) return remember_error(streams.error().message), -1;
  if (n < 0 || static_cast<std::size_t>(n) >= streams->size()) return -1;
  const dssm::StreamInfo& stream = (*streams)[static_cast<std::size_t>(n)];
  const std::uint64_t bytes = dssm::ssm::data_bytes(stream.type);
  if (stream_name) std::memcpy(stream_name, stream.id.name.c_str(), stream.id.name.size() + 1);
  if (stream_id) *stream_id = stream.id.id;
  if (size) *size = bytes;
  return static_cast<int>(bytes);
}

int getSSM_info(const char* stream_name, int stream_id, size_t* size, int* num, double* cycle,
                size_t* property_size) {
  if (name_too_long(stream_name)) return 0;
  const auto id = find_id(stream_name, stream_id);
  if (!id) return -1;
  const auto info = ask(*id);
  if (!info) return remember_error(info.error().message), -1;
  const std::uint64_t bytes = dssm::ssm::data_bytes(info->type);
  if (size) *size = bytes;
  if (num) *num = static_cast<int>(info->depth);
  if (cycle) *cycle = dssm::ssm::seconds_from_ns(dssm::to_ns(info->cycle));
  if (property_size) *property_size = info->property_bytes;
  return static_cast<int>(bytes);
}

ssm_header* shm_get_address(SSM_sid sid) {
  const dssm::ssm::SidUse use(sid);
  if (!use) return nullptr;
  // Atomic stores: another thread may be looking at what it got before.
  ssm_header& header = use.header();
  std::atomic_ref(header.tid_top).store(dssm::ssm::ssm_tid(use->newest()));
  std::atomic_ref(header.num).store(static_cast<int>(use->depth()));
  std::atomic_ref(header.size).store(use->data_bytes());
  std::atomic_ref(header.cycle).store(dssm::ssm::seconds_from_ns(dssm::to_ns(use->cycle())));
  return &header;
}

size_t shm_get_data_size(ssm_header* shm_p) { return shm_p->size; }

int set_propertySSM(const char* stream_name, int stream_id, const void* data, size_t size) {
  const auto id = find_id(stream_name, stream_id);
  if (!id || (!data && size > 0)) return 0;
  auto session = process().session();
  auto done = session ? session->set_property(*id, {static_cast<const std::byte*>(data), size})
                      : std::move(session).error();
  if (!done) return remember_error(done.error().message), 0;
  return 1;
}

int get_propertySSM(const char* stream_name, int stream_id, void* data) {
  const auto id = find_id(stream_name, stream_id);
  if (!id || !data) return 0;
  auto session = process().session();
  auto property = session ? session->property(*id) : std::move(session).error();
  if (!property) return remember_error(property.error().message), 0;
  std::memcpy(data, property->data(), property->size());
  return 1;
}

// --- between ssm.hpp and this library

size_t dssm_ssm_data_size(SSM_sid sid) {
  const dssm::ssm::SidUse use(sid);
  return use ? use->data_bytes() : static_cast<size_t>(-1);
}

int dssm_ssm_get_property(const char* stream_name, int stream_id, void* data, size_t size) {
  const auto id = find_id(stream_name, stream_id);
  if (!id) return 0;
  auto session = process().session();
  auto property = session ? session->property(*id) : std::move(session).error();
  if (!property) return remember_error(property.error().message), 0;
  if (property->size() != size) {
    report_error("get the property of " + quoted(stream_name, stream_id) + " : it has " +
                 std::to_string(property->size()) + " bytes, this program's type " +
                 std::to_string(size) + "; use the type that it was set with");
    return 0;
  }
  std::memcpy(data, property->data(), size);
  return 1;
}

int dssm_ssm_wait_stream(const char* stream_name, int stream_id, double timeout) {
  const auto id = find_id(stream_name, stream_id);
  if (!id) return -2;
  const dssm::MonoTime deadline =
      timeout > 0 ? dssm::deadline_in(dssm::Duration(dssm::ssm::ns_from_seconds(timeout)))
                  : dssm::kNever;
  constexpr dssm::Duration kLook = std::chrono::milliseconds(100);
  dssm::ssm::Interruptible signals;
  for (;;) {
    const auto info = ask(*id);
    if (info) return 1;
    // Daemon away: it may come back. Anything else does not get better by waiting.
    if (info.error().code != dssm::Errc::not_found &&
        info.error().code != dssm::Errc::unavailable) {
      remember_error(info.error().message);
      return -2;
    }
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= deadline) return 0;
    if (!signals.pause(std::min(kLook, deadline - now))) return -1;
  }
}

}  // extern "C"
