// SPDX-License-Identifier: Apache-2.0
//
// dssmctl record --black-box, and what it shares with a continuous recording.
#pragma once

#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <filesystem>
#include <string>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recorder.hpp"
#include "client/dssmctl/recording_folder.hpp"

namespace dssm::ctl {

// Waits for triggers until a stop signal, and writes a file for each incident.
//   how    of each file
//   fails  as Recorder::start(); an incident that cannot be written is reported, and the next one
//          awaited
Result<void> run_black_box(const RecordOptions& options, Session session, const RecorderPlan& plan,
                           const RecordingOptions& how, Output& out);

// Before a recorder writes into the folder: completes what a recorder that was killed left, and
// makes room.
//   fails  as RecordingFolder::make_room()
Result<void> prepare(RecordingFolder& folder);

// How much is recorded: for people, and for programs.
std::string progress_text(const Recorder& recorder);
Json recording_json(const std::filesystem::path& file, const Recorder& recorder);

}  // namespace dssm::ctl
