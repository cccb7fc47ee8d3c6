// SPDX-License-Identifier: Apache-2.0
//
// <ssm.h>, <libssm.h>: creating, opening and closing streams, what is known of them, properties.
#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <dssm/session.hpp>
#include <limits>
#include <optional>

#include "../include/libssm.h"
#include "convert.hpp"
#include "process.hpp"
#include "signal_safe.hpp"

using dssm::ssm::name_length;
using dssm::ssm::process;
using dssm::ssm::quoted;
using dssm::ssm::remember_error;
using dssm::ssm::report_error;
using dssm::ssm::slots;

namespace {

dssm::Result<dssm::Session> connect_for_second_end() { return process().any_session(); }

// For the calls that find streams by name: nothing when no stream can have that name.
std::optional<dssm::StreamId> find_id(const char* name, int id) {
  if (!name || name_length(name) >= SSM_SNAME_MAX || id < 0) return std::nullopt;
  if (name[name_length(name)] && !name[name_length(name) + 1]) return std::nullopt;
  return dssm::ssm::stream_id(name, id);
}

bool name_too_long(const char* name) { return !name || name_length(name) > SSM_SNAME_MAX; }

dssm::Result<dssm::StreamInfo> request_info(const dssm::StreamId& id) {
  return process().request([&](dssm::Session& dssmd) { return dssmd.stream_info(id); });
}

dssm::Result<std::vector<dssm::StreamInfo>> request_streams() {
  return process().request([](dssm::Session& dssmd) { return dssmd.list_own_streams(); });
}

dssm::Result<std::vector<std::byte>> request_property(const dssm::StreamId& id) {
  return process().request([&](dssm::Session& dssmd) { return dssmd.property(id); });
}

}  // namespace

extern "C" {

int calcSSM_table(ssmTimeT life, ssmTimeT cycle) { return static_cast<int>(slots(life, cycle)); }

// Up to a rounding (num - 1) * cycle / 1.2: as much more as it takes that calcSSM_table() gives the
// same number back, or replayed streams would have a slot less than the recorded ones.
ssmTimeT calcSSM_life(int table_num, ssmTimeT cycle) {
  double life = (table_num - SSM_MARGIN) * cycle / SSM_BUFFER_MARGIN;
  for (int step = 0; step < 4 && life > 0 && calcSSM_table(life, cycle) < table_num; ++step) {
    life = std::nextafter(life, std::numeric_limits<double>::max());
  }
  return life;
}

SSM_sid createSSM(const char* stream_name, int stream_id, size_t stream_size, ssmTimeT life,
                  ssmTimeT cycle) {
  if (const auto wrong = dssm::ssm::wrong_arguments(stream_name, stream_id, life, cycle)) {
    report_error(*wrong);
    return nullptr;
  }
  const std::string what = "create " + quoted(stream_name, stream_id);
  auto writer = process().request([&](dssm::Session& dssmd) {
    return dssmd.create_raw(dssm::ssm::stream_id(stream_name, stream_id),
                            dssm::ssm::type_for(stream_size), dssm::ssm::history_of(life, cycle),
                            {.keep_existing = true, .tag = dssm::ssm::kTagHidden});
  });
  if (!writer) return dssm::ssm::report_failure(what, writer.error()), nullptr;
  const std::uint64_t bytes = dssm::ssm::data_bytes(writer->type());
  if (bytes != stream_size) {
    report_error(fmt::format(
        "{} : the stream exists with {} bytes per sample, not {}; use its type or another name",
        what, bytes, stream_size));
    return nullptr;
  }
  return process().add(
      std::make_unique<dssm::ssm::Stream>(std::move(*writer), &connect_for_second_end));
}

SSM_sid openSSM(const char* stream_name, int stream_id, char open_mode) {
  const auto id = find_id(stream_name, stream_id);
  if (!id) return remember_error("open : not a stream name or id"), nullptr;
  auto reader = process().request([&](dssm::Session& dssmd) {
    return dssmd.open_raw_reader(*id, nullptr,
                                 dssm::ssm::kTagEdge | static_cast<unsigned char>(open_mode),
                                 dssm::FetchHistory::at_once);
  });
  if (!reader) return nullptr;
  return process().add(
      std::make_unique<dssm::ssm::Stream>(std::move(*reader), &connect_for_second_end));
}

// Called from signal handlers; see handle_table.hpp.
int closeSSM(SSM_sid* sid) {
  if (!sid) return 1;
  const SSM_sid open = __atomic_exchange_n(sid, nullptr, __ATOMIC_ACQ_REL);
  process().sids().close(reinterpret_cast<std::uintptr_t>(open));
  return 1;
}

int releaseSSM(SSM_sid* sid) { return closeSSM(sid); }

int getSSM_num(void) {
  const auto streams = request_streams();
  return streams ? static_cast<int>(streams->size()) : -1;
}

int getSSM_name(int n, char* stream_name, int* stream_id, size_t* size) {
  const auto streams = request_streams();
  if (!streams || n < 0 || static_cast<std::size_t>(n) >= streams->size()) return -1;
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
  const auto info = request_info(*id);
  if (!info) return -1;
  const std::uint64_t bytes = dssm::ssm::data_bytes(info->type);
  if (size) *size = bytes;
  // Of another host's stream, what can be read here.
  const bool has_own = info->mirror && info->mirror->depth > 0;
  if (num) *num = static_cast<int>(has_own ? info->mirror->depth : info->depth);
  if (cycle) *cycle = dssm::seconds_from_ns(dssm::to_ns(info->cycle));
  if (property_size) *property_size = info->property_bytes;
  return static_cast<int>(bytes);
}

ssm_header* shm_get_address(SSM_sid sid) {
  const dssm::ssm::SidTurn turn(sid);
  if (!turn) return nullptr;
  // Atomic stores: another thread may be reading what it got before.
  ssm_header& header = turn.kept();
  std::atomic_ref(header.tid_top).store(dssm::ssm::ssm_tid(turn->newest(turn.alone())));
  std::atomic_ref(header.num).store(static_cast<int>(turn->depth()));
  std::atomic_ref(header.size).store(turn->data_bytes());
  std::atomic_ref(header.cycle).store(dssm::seconds_from_ns(dssm::to_ns(turn->cycle())));
  return &header;
}

size_t shm_get_data_size(ssm_header* shm_p) { return shm_p->size; }

int set_propertySSM(const char* stream_name, int stream_id, const void* data, size_t size) {
  const auto id = find_id(stream_name, stream_id);
  if (!id || (!data && size > 0)) return 0;
  const auto done = process().request([&](dssm::Session& dssmd) {
    return dssmd.set_property(*id, {static_cast<const std::byte*>(data), size});
  });
  return done ? 1 : 0;
}

int get_propertySSM(const char* stream_name, int stream_id, void* data) {
  const auto id = find_id(stream_name, stream_id);
  if (!id || !data) return 0;
  const auto property = request_property(*id);
  if (!property) return 0;
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
  const auto property = request_property(*id);
  if (!property) return 0;
  if (property->size() != size) {
    report_error(
        dssm::ssm::property_size_error(quoted(stream_name, stream_id), property->size(), size));
    return 0;
  }
  std::memcpy(data, property->data(), size);
  return 1;
}

int dssm_ssm_wait_stream(const char* stream_name, int stream_id, double timeout) {
  const auto id = find_id(stream_name, stream_id);
  if (!id) return -2;
  const dssm::MonoTime deadline =
      timeout > 0 ? dssm::deadline_in(dssm::Duration(dssm::ns_from_seconds(timeout)))
                  : dssm::kNever;
  constexpr dssm::Duration kCheckPause = std::chrono::milliseconds(100);
  dssm::ssm::Interruptible signals;
  for (;;) {
    dssm::Result<dssm::Session> session = process().session();
    const auto info = session ? session->stream_info(*id) : std::move(session).error();
    if (info) return 1;
    // While dssmd is unavailable, waiting may help too. It helps against no other error.
    if (info.error().code != dssm::Errc::not_found &&
        info.error().code != dssm::Errc::unavailable) {
      remember_error(info.error().message);
      return -2;
    }
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= deadline) return 0;
    if (!signals.pause(std::min(kCheckPause, deadline - now))) return -1;
  }
}

}  // extern "C"
