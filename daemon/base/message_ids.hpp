// SPDX-License-Identifier: Apache-2.0
//
// Identities of the log entries that an operator may search for (journalctl MESSAGE_ID=...). Random
// once, never reused for another meaning.
#pragma once

#include <string_view>

namespace dssm::daemon::message_id {

inline constexpr std::string_view kReady = "d2b6f171446b46fcb10bc6e779ecf04d";
inline constexpr std::string_view kStopping = "d05ce614e0a64699b1f2416ba5ca513c";
inline constexpr std::string_view kClientRefused = "c6801aea58fe472498f8d46ad3aa53cb";
inline constexpr std::string_view kRequestRefused = "5e410ee07d5c49fd915f093528d92eb3";
inline constexpr std::string_view kStreamCreated = "8637335716034850a755ed431ed47c14";
inline constexpr std::string_view kStreamRemoved = "bdd6965dfe8a4d14a605fa127c652ae7";
inline constexpr std::string_view kStreamAdopted = "a73f7306e3fa42bb87f7d49f265044f7";
inline constexpr std::string_view kOfferRefused = "7a844fc7f25c4582beea94223502bb69";
inline constexpr std::string_view kInsecure = "9dda14d3d1564b6e82788b23d16d5bcb";
inline constexpr std::string_view kPeerRefused = "c1011888c5ba4f3784eb0dba4f4e92a7";
inline constexpr std::string_view kChannelOpened = "7c44b109ec8f402b81652d7eb21ce9b0";
inline constexpr std::string_view kChannelClosed = "866cfc2639914b68850ce65b98b91f64";
inline constexpr std::string_view kRecovering = "2e58a82ca63744cc956de7dd2a52e977";
inline constexpr std::string_view kHostUp = "fe1593d94e4646a8809f1ca751e33ac1";
inline constexpr std::string_view kHostDown = "7300d3a6bb28413296e1b5a92550935a";
inline constexpr std::string_view kHostRefused = "6e6d9e31825e4606b3c25808b5202f09";
inline constexpr std::string_view kMirror = "23d4f07a4eab2d215e6fbbb2388899a9";
inline constexpr std::string_view kRemoteWriter = "94e358d29cf143f9fb5c0eaa7656d3f6";

inline constexpr std::string_view kRestored = "6652b011a31745f696e5b209f05c7cfc";
inline constexpr std::string_view kStoredDropped = "fd7f54bc686049b2bcf77b75781c951a";
inline constexpr std::string_view kStoreFull = "ea5df5dd2c364bba8caad1373754687b";
inline constexpr std::string_view kSocketUnused = "86f14245a8b3478da87275019235f7e3";
inline constexpr std::string_view kReloaded = "2c576e97c0d846c8befd084654c3f471";
inline constexpr std::string_view kReloadFailed = "c167d78902794b3994971ec3e0b22184";
inline constexpr std::string_view kRestartNeeded = "3b6dcdea709c45e2bbf57a286fb0fec0";
inline constexpr std::string_view kFailed = "27e5b81c407a4d239b44a249741694ea";

inline constexpr std::string_view kClockStepped = "5d6eb3fceee243358e4818b0fde7d466";
inline constexpr std::string_view kChronydAway = "4c74591c07464db9acb5c74a1f430715";
inline constexpr std::string_view kClockOutOfBounds = "55d27db9b00947b3be6b238caa5c8e5e";
inline constexpr std::string_view kClockInBounds = "4a6b6d5b038d4fc99bf6da04034435c4";
inline constexpr std::string_view kHostClockOutOfBounds = "f9499dfd06ca40afa1f6fa6c5b19d9dc";
inline constexpr std::string_view kHostClockInBounds = "54bb5043dc954f85843dd6b355e528d0";

}  // namespace dssm::daemon::message_id
