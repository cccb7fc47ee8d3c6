// SPDX-License-Identifier: Apache-2.0
//
// A configuration file whose keys are the options of a verb.
#pragma once

#include <dssm/result.hpp>
#include <string>
#include <vector>

namespace dssm::ctl {

// The words of a command line that mean what the TOML file `path` says:
// `max_file_size = "2GiB"` is `--max-file-size=2GiB`, `black_box = true` is `--black-box`, false
// leaves a flag out, each element of an array is an option of its own, and those of `streams` are
// words without an option.
//   fails  not_found, no_permission, system (the file), invalid_argument (what is in it, with the
//          line)
Result<std::vector<std::string>> config_words(const std::string& path);

}  // namespace dssm::ctl
