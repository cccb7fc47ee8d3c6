// SPDX-License-Identifier: Apache-2.0
//
// The streams by which a black box (dssmctl record --black-box) is asked and answers, on its host.
// Texts end at their first zero byte.
#pragma once

#include <string.h>

#include <cstdint>
#include <dssm/describe.hpp>
#include <dssm/stream.hpp>
#include <string>
#include <string_view>

namespace dssm::ctl {

// The name of the program that a black box is for dssmd: others read these streams, too.
inline constexpr const char* kBlackBoxProgram = "dssmctl record --black-box";

// Who writes a sample there asks for an incident.
inline constexpr const char* kTriggerStream = "dssm_trigger";
struct TriggerRequest {
  char name[64];
  char host[32];  // where it was requested
  char reason[416];
};
DSSM_DESCRIBE(TriggerRequest, name, host, reason)

// The black box writes one when it has recorded an incident.
inline constexpr const char* kIncidentStream = "dssm_incident";
struct RecordedIncident {
  char trigger[64];  // the first one
  char host[32];     // where it happened or was requested
  char reason[416];
  char file[512];  // its path on the recorder's host
  std::uint64_t samples, lost_samples;
};
DSSM_DESCRIBE(RecordedIncident, trigger, host, reason, file, samples, lost_samples)

inline bool is_of_black_box(const StreamId& stream) {
  return stream.name == kTriggerStream || stream.name == kIncidentStream;
}

// In a sample of zeros; what is too long is cut.
template <std::size_t N>
void set_text(char (&out)[N], std::string_view text) {
  text.copy(out, N - 1);
}

// As another program wrote it: not to be shown as it is.
template <std::size_t N>
std::string text_in(const char (&text)[N]) {
  return {text, ::strnlen(text, N)};
}

}  // namespace dssm::ctl
