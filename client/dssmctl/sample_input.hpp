// SPDX-License-Identifier: Apache-2.0
//
// From text to a sample, for `dssmctl pub`: FIELD=VALUE from the command line, or lines as `echo
// --json` and `echo --csv` print them. The opposite of SamplePrinter.
#pragma once

#include <cstddef>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <istream>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// A sample that is to be written. Starts with all bytes 0.
class SampleInput {
 public:
  // Of a stream with that type; without fields that can be read, only "payload_hex" can be set.
  explicit SampleInput(const TypeInfo& type);

  // Sets a field, "pose.x", or one element of it, "ranges[2]".
  //   text  as typed: a number, true, false, bare or quoted text, or a JSON array
  //   fails invalid_argument, naming the field, the value and what is possible
  Result<void> set_text(const std::string& name, const std::string& text);
  Result<void> set_json(const std::string& name, const Json& value);
  // The same from a cell of CSV, where text is as it is.
  Result<void> set_cell(const std::string& name, const std::string& cell);

  std::span<const std::byte> payload() const { return payload_; }

  // Of the sample, as the input states it.
  std::optional<Time> time;
  std::optional<Duration> clock_error;  // none: the input has no such column or key

  // Whether the type has a field or element of that name.
  bool has(const std::string& name) const;

 private:
  struct Place {
    const Field* field;
    std::optional<std::uint64_t> element;  // none: all of it
  };
  std::optional<Place> find(const std::string& name) const;
  Result<Place> place_of(const std::string& name) const;
  Result<void> set_hex(const std::string& text);

  std::uint64_t payload_bytes_;
  std::vector<Field> fields_;
  std::vector<std::byte> payload_;
};

// Reads samples from lines: JSON objects, or CSV with a header line, told apart by the first
// character.
class SampleLines {
 public:
  // `in` outlives it.
  SampleLines(TypeInfo type, std::istream& in) : type_(std::move(type)), in_(in) {}

  // The next sample; none at the end of the input.
  //   fails  invalid_argument, with the number of the line
  Result<std::optional<SampleInput>> next();

 private:
  Result<void> read_json(const std::string& line, SampleInput& sample) const;
  Result<void> read_header(const std::string& line);
  Result<void> read_row(const std::string& line, SampleInput& sample) const;
  Result<bool> get_record(std::string& record);  // false: at the end

  TypeInfo type_;
  std::istream& in_;
  std::uint64_t line_ = 0;                          // the last one that was read, from 1
  std::optional<std::vector<std::string>> header_;  // none: JSON, or not read yet
  std::size_t info_columns_ = 0;                    // before those of fields
};

}  // namespace dssm::ctl
