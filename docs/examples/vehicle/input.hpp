// SPDX-License-Identifier: Apache-2.0
//
// How the vehicle's readers come to their streams: in any order of starting, stoppable at any
// moment, and at the right place in streams that may still hold an earlier drive.
#pragma once

#include <dssm/reader.hpp>
#include <dssm/session.hpp>
#include <optional>
#include <string>

#include "progress.hpp"
#include "stop.hpp"

namespace vehicle {

// What localizer and mapper end with under --complete when they had to leave scans out.
inline constexpr int kIncompleteStatus = 3;

// Opens `stream`, on whichever host it is, waiting until it is created and its host answers. Fails
// as Session::open_reader() does, but for not_found and unavailable, which it waits out; nullopt
// when a signal asked to stop.
template <class T>
dssm::Result<std::optional<dssm::Reader<T>>> open_when_there(dssm::Session& session,
                                                             const char* stream,
                                                             Progress& progress) {
  for (bool told = false; !stop_requested(); told = true) {
    dssm::Result<dssm::Reader<T>> reader =
        session.await_reader<T>(stream, dssm::deadline_in(kSlice));
    if (reader) return std::optional<dssm::Reader<T>>(std::move(*reader));
    const dssm::Errc code = reader.error().code;
    if (code != dssm::Errc::not_found && code != dssm::Errc::unavailable) {
      return std::move(reader).error();
    }
    if (!told) progress.say("waiting for the stream '" + std::string(stream) + "'");
  }
  return std::optional<dssm::Reader<T>>();
}

// Puts the cursor in front of the first sample of the newest drive. Streams outlive the programs
// that write them, so a ring may begin with the rest of an earlier drive; the end marks tell. A
// drive that is over already counts as an earlier one, too, and the reader then waits for the
// next; `late` says that this is the drive to read.
template <class T>
void seek_to_drive(dssm::Reader<T>& reader, bool late) {
  T sample;
  dssm::SampleInfo info;
  const dssm::Tid newest = reader.newest();
  for (dssm::Tid tid = newest; tid >= 0; --tid) {
    if (reader.tid(tid, sample, info) != dssm::ReadStatus::ok) break;
    if (sample.is_end() && !(late && tid == newest)) return reader.seek(tid);
  }
  reader.seek(dssm::kNoTid);
}

}  // namespace vehicle
