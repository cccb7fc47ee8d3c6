// SPDX-License-Identifier: Apache-2.0
//
// Opens the streams of the vehicle's readers. Programs may start in any order and be stopped at any
// time, and readers begin at the right sample in streams that still hold an earlier drive.
#pragma once

#include <dssm/reader.hpp>
#include <dssm/session.hpp>
#include <optional>
#include <string>

#include "progress.hpp"
#include "stop.hpp"

namespace vehicle {

// Exit status of localizer and mapper with --complete after they had to skip scans.
inline constexpr int kIncompleteStatus = 3;

// Opens `stream` on any host; waits until the stream is created and its host is available. Fails as
// Session::open_reader() does, except for not_found and unavailable, on which it retries. nullopt
// after a signal to stop.
template <class T>
dssm::Result<std::optional<dssm::Reader<T>>> open_when_there(dssm::Session& session,
                                                             const char* stream,
                                                             Progress& progress) {
  for (bool reported = false; !stop_requested(); reported = true) {
    dssm::Result<dssm::Reader<T>> reader = session.await_reader<T>(stream, kSlice);
    if (reader) return std::optional<dssm::Reader<T>>(std::move(*reader));
    const dssm::Errc code = reader.error().code;
    if (code != dssm::Errc::not_found && code != dssm::Errc::unavailable) {
      return std::move(reader).error();
    }
    if (!reported) progress.print("waiting for the stream '" + std::string(stream) + "'");
  }
  return std::optional<dssm::Reader<T>>();
}

// Moves the cursor before the first sample of the newest drive. Streams exist longer than the
// programs that write them, so a ring may begin with samples of an earlier drive; end marks
// separate drives. If the newest drive is over, the reader waits for the next one, unless `late` is
// set.
template <class T>
void seek_to_drive(dssm::Reader<T>& reader, bool late) {
  T sample;
  dssm::SampleInfo info;
  const dssm::Tid newest = reader.newest_tid();
  for (dssm::Tid tid = newest; tid >= 0; --tid) {
    dssm::ReadStatus status = reader.read_tid(tid, sample, info);
    // From another PC the newest samples come first.
    while (status == dssm::ReadStatus::arriving && !stop_requested()) {
      (void)reader.wait_for_sample(tid, kSlice);
      status = reader.read_tid(tid, sample, info);
    }
    if (status == dssm::ReadStatus::lost) continue;
    if (status != dssm::ReadStatus::ok) break;
    if (sample.is_end() && !(late && tid == newest)) return reader.seek(tid);
  }
  reader.seek(dssm::kNoTid);
}

}  // namespace vehicle
