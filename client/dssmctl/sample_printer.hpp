// SPDX-License-Identifier: Apache-2.0
//
// How `dssmctl echo` shows a sample: as text for people, as a JSON line, or as a CSV row.
//
// CSV is RFC 4180's, but for its line ends: a bare newline, so that cut, awk and gnuplot see no
// carriage return in the last column.
#pragma once

#include <cstddef>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <span>
#include <string>
#include <utility>
#include <vector>

namespace dssm::ctl {

class Output;

enum class SampleForm : unsigned char { text, json, csv };

// One cell of a CSV row: in quotes where it holds a comma, a quote or a line end.
std::string csv_cell(std::string_view text);

class SamplePrinter {
 public:
  struct Style {
    SampleForm form = SampleForm::text;
    bool full = false;  // text leaves nothing out of long payloads
    bool iso = false;   // times in text and CSV as ISO 8601
  };
  // `fields` passed readable_fields_untrusted(); none: the payload is shown as bytes.
  SamplePrinter(Output& out, Style style, StreamId stream, std::vector<Field> fields);

  // What precedes the first sample: CSV's header line.
  void begin();

  const std::vector<Field>& fields() const { return fields_; }
  // From the next sample on; not in CSV, whose header has been printed.
  void set_fields(std::vector<Field> fields) { fields_ = std::move(fields); }

  // What came between a sample and those before it.
  struct Breaks {
    std::uint64_t lost = 0;      // samples right before it that were overwritten unread
    std::uint64_t restarts = 0;  // of the stream, since the start
  };
  void sample(const SampleInfo& info, std::span<const std::byte> payload, const Breaks& breaks);

 private:
  void text_sample(const SampleInfo& info, std::span<const std::byte> payload,
                   const Breaks& breaks);
  void json_sample(const SampleInfo& info, std::span<const std::byte> payload,
                   const Breaks& breaks);
  void csv_sample(const SampleInfo& info, std::span<const std::byte> payload);
  std::string cell(std::string_view text) const;

  Output& out_;
  Style style_;
  StreamId stream_;
  std::vector<Field> fields_;
};

}  // namespace dssm::ctl
