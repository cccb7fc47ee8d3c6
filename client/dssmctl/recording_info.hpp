// SPDX-License-Identifier: Apache-2.0
//
// Recordings as several verbs open them; dssmctl info FILE: what a recording holds.
#pragma once

#include <dssm/recording.hpp>
#include <string>
#include <vector>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// Whether a person means a recording and not a stream: a name that ends as recordings do, begins as
// paths do, or has a slash and is there.
bool is_recording(const std::string& name);

// A recording of several files, or of one file or folder: when `more` is empty.
Result<Recording> open_recording(const std::string& file, const std::vector<std::string>& more);

// Of a file or folder, for people: unlike Recording::open() it fails when no stream can be read of
// a file that is empty, cut off or damaged.
Result<Recording> open_readable(const std::string& path);

// Of the option --compression.
Compression compression_of(const std::string& name);

void print_recording(const Recording& recording, const InfoOptions& options, Output& out);

}  // namespace dssm::ctl
