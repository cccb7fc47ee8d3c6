// SPDX-License-Identifier: Apache-2.0
#include "core/base/ssm_log.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>

namespace dssm {
namespace {

constexpr std::string_view kBlanks = " \t\r\v\f";

// The next word of `text`, which is removed from it; words are separated by any blanks.
std::string_view next_word(std::string_view& text) {
  text.remove_prefix(std::min(text.find_first_not_of(kBlanks), text.size()));
  const std::string_view word = text.substr(0, text.find_first_of(kBlanks));
  text.remove_prefix(word.size());
  return word;
}

template <class Number>
bool parse_word(std::string_view word, Number& number) {
  const auto [end, error] = std::from_chars(word.data(), word.data() + word.size(), number);
  return error == std::errc() && end == word.data() + word.size() && !word.empty();
}

}  // namespace

bool is_ssm_log_name(std::string_view name) noexcept {
  return !name.empty() && name.find_first_of(kBlanks) == name.npos && name.find('\n') == name.npos;
}

Result<SsmLogHead> ssm_log_head_untrusted(std::string_view begin, std::uint64_t file_bytes) {
  const auto wrong = [](std::string text) { return Error{Errc::protocol, std::move(text)}; };
  const std::size_t end = begin.substr(0, kMaxSsmLogLineBytes).find('\n');
  if (end == begin.npos) return wrong("it has no first line of text");
  std::string_view rest = begin.substr(0, end);
  SsmLogHead head;
  head.line_bytes = end + 1;
  head.stream_name = next_word(rest);
  const bool parsed =
      parse_word(next_word(rest), head.stream_id) && parse_word(next_word(rest), head.data_bytes) &&
      parse_word(next_word(rest), head.buffer_num) && parse_word(next_word(rest), head.cycle_s) &&
      parse_word(next_word(rest), head.start_time_s) &&
      parse_word(next_word(rest), head.property_bytes) && next_word(rest).empty();
  if (!parsed || !std::isfinite(head.cycle_s) || !std::isfinite(head.start_time_s)) {
    return wrong("it has a first line that is not NAME ID SIZE NUM CYCLE START PROPERTY_SIZE");
  }
  if (head.data_bytes > kMaxSsmLogSize || head.property_bytes > kMaxSsmLogSize) {
    return wrong(fmt::format("it has sizes beyond {} bytes", kMaxSsmLogSize));
  }
  if (head.records_at() > file_bytes) return wrong("it ends inside its property");
  return head;
}

std::string ssm_log_line(const SsmLogHead& head) {
  return fmt::format("{} {} {} {} {:.6f} {:.6f} {}\n", head.stream_name, head.stream_id,
                     head.data_bytes, head.buffer_num, head.cycle_s, head.start_time_s,
                     head.property_bytes);
}

}  // namespace dssm
