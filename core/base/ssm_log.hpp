// SPDX-License-Identifier: Apache-2.0
//
// The format of SSM's logs, which libssm, recordings and `dssmctl convert` share: a line of text,
// the property, and records of 8 bytes of time (a double of seconds since 1970) and the data,
// without padding. A part of a record at the end does not count.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <string>
#include <string_view>

namespace dssm {

inline constexpr std::size_t kMaxSsmLogLineBytes = 4096;
inline constexpr std::uint64_t kMaxSsmLogSize = INT32_MAX;  // SSM's sizes are ints

// In the metadata of a recorded stream: the first line of the log that it comes from.
inline constexpr const char* kSsmLogKey = "ssm_log";

// Type name of a stream whose samples have no bytes, as libssm creates it; its ring has one byte,
// as rings must.
inline constexpr const char* kEmptySsmType = "ssm.empty";

// What the first line says.
struct SsmLogHead {
  std::string stream_name;
  std::int32_t stream_id = 0;
  std::int32_t buffer_num = 0;  // slots of the stream's ring
  std::uint64_t data_bytes = 0;
  std::uint64_t property_bytes = 0;
  double cycle_s = 0;
  double start_time_s = 0;  // when the log was created
  std::uint64_t line_bytes = 0;

  std::uint64_t record_bytes() const noexcept { return sizeof(double) + data_bytes; }
  std::uint64_t records_at() const noexcept { return line_bytes + property_bytes; }
};

// Whether a log can hold a stream of that name: it is a word.
bool is_ssm_log_name(std::string_view name) noexcept;

// The head of a log.
//   begin       its first bytes: kMaxSsmLogLineBytes, or all
//   file_bytes  of the whole file
//   fails       protocol, with what is wrong with it: "it has no first line of text"
Result<SsmLogHead> ssm_log_head_untrusted(std::string_view begin, std::uint64_t file_bytes);

// Its first line, with the line end. The decimal point is not that of the program's locale.
std::string ssm_log_line(const SsmLogHead& head);

}  // namespace dssm
