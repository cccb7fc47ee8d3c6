// SPDX-License-Identifier: Apache-2.0
//
// dssmctl info FILE: what a recording holds.
#pragma once

#include <string>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// Whether a person means a recording and not a stream: a path with a slash, or a name that ends as
// recordings do.
bool is_recording(const std::string& name);

// `path` is a file, or a folder with the files of one recording.
Result<void> print_recording(const std::string& path, const InfoOptions& options, Output& out);

}  // namespace dssm::ctl
