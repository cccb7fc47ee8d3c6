// SPDX-License-Identifier: Apache-2.0
//
// A HostInfo and a StreamInfo as several verbs show them.
#pragma once

#include <dssm/session.hpp>
#include <dssm/stream.hpp>
#include <string>
#include <vector>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// --- hosts

// "valid until 2028-11-25".
std::string validity_text(const CredentialsInfo& credentials);

// As `dssmctl hosts` shows them.

std::vector<Table::Column> host_columns();
std::vector<std::string> host_row(const HostInfo& host);  // a cell for each column

Json host_json(const HostInfo& host);

bool is_up(HostState state);  // this host, or one that answers

bool is_good(const ClockSnapshot& clock);             // its bound is within the limit
std::string status_text(const ClockSnapshot& clock);  // "out of bounds: stepped"

// --- streams: the same keys in `ls` and `info`

Json stream_json(const StreamInfo& stream);

// Whether samples should come and do not. Those of a black box come when something happens.
bool is_silent(const StreamInfo& stream);
// Whether stream.age has a meaning.
bool is_age_known(const StreamInfo& stream);
// Whether the numbers of its users have one: dssmd may know only that there is such a stream.
bool is_use_known(const StreamInfo& stream);

// As tables show them; "-": not known, or of the rate that no samples come.
std::string rate_text(const StreamInfo& stream);
std::string age_text(const StreamInfo& stream);
std::string state_cell(const StreamInfo& stream);
std::string count_text(const StreamInfo& stream, std::uint32_t users);

// The fields of a type: as a table, and as JSON.
void print_fields(const TypeInfo& type, Output& out);
Json fields_json(const TypeInfo& type);

// How this PC's mirror of a stream is doing.
// `stream` has a mirror here. Its state is "behind" when it is live and not fresh.
Json mirror_json(const StreamInfo& stream);

// What `info` adds: fields, users, and how the mirror is doing.
void add_details(Json& json, const StreamInfo& stream);

// How much older the newest sample in its mirror is than its owner's; 0: the mirror is fresh.
Duration behind_owner(const StreamInfo& stream);
// Whether its owner sends it samples now. Its history may still be on its way.
bool gets_samples(const MirrorInfo& mirror);
// "carries 11 of 30 samples a second (9.67 MiB/s)", of the network to the mirror; empty: it carries
// all.
std::string carried_text(const StreamInfo& stream);

std::string_view role_name(Role role);

// All of a stream, as `dssmctl info` shows it (info.cpp).
//   iso  times as ISO 8601
void print_stream(const StreamInfo& stream, bool iso, Output& out);

}  // namespace dssm::ctl
