// SPDX-License-Identifier: Apache-2.0
//
// dssmctl info FILE: what a recording holds.
#pragma once

#include <string>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// Whether a person means a recording and not a stream: a name that ends as recordings do, begins as
// paths do, or has a slash and is there.
bool is_recording(const std::string& name);

// `path` is a file, or a folder with the files of one recording.
Result<void> print_recording(const std::string& path, const InfoOptions& options, Output& out);

}  // namespace dssm::ctl
