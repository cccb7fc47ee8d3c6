// SPDX-License-Identifier: Apache-2.0
//
// The type of a stream whose programs do not describe it, from the debug information of those
// programs: for `dssmctl describe`, for what `echo` and dssm-view show, and for the files of
// `record`.
#pragma once

#include <dssm/session.hpp>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "client/dssmctl/debug_types.hpp"

namespace dssm::ctl {

struct ProgramType {
  DebugType found;
  std::string source;  // "'odometry' (pid 12)"
};

// The type that `stream`, as Session::stream_info() returned it, has in the first of the programs
// on this PC that have it open and whose files can be read: writers first.
//   type_name  empty: as choose_type()
//   fails      not_found, with the reason for each program
Result<ProgramType> type_of_programs(Session& session, const StreamInfo& stream,
                                     const std::string& type_name);

// The same for a user who did not ask for it: nothing unless there is no doubt, by the name of the
// type or because it is the T of an SSMApi<T, P>, and only of programs whose files are root's or
// the user's own.
std::optional<ProgramType> obvious_type_of_programs(Session& session, const StreamId& id);

// The same for all `streams` that are not described, by StreamId::str() and incarnation, for about
// so long at most: large programs take a second each.
std::map<std::pair<std::string, std::uint64_t>, TypeInfo> obvious_types_of_programs(
    Session& session, const std::vector<StreamInfo>& streams, Duration at_most);

// The same for a verb that shows samples of the reader's stream, if it is not described. A line on
// standard error names the type and its program.
TypeInfo obvious_type(Session& session, const RawReader& reader, std::string_view verb);

// What to show of a stream as it is now: its own type, or `obvious`, that of its programs, if it is
// not described and that fits.
const TypeInfo& type_to_show(const TypeInfo& own, const TypeInfo& obvious);

}  // namespace dssm::ctl
