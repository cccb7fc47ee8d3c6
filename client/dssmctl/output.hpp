// SPDX-License-Identifier: Apache-2.0
//
// Standard output, gathered in one string and written with as few system calls as possible: a list
// of a thousand streams is one write. A reader that ends (`| head`) is not an error: writing
// then stops quietly, and the program ends with success, as a person expects of a pipe.
#pragma once

#include <dssm/result.hpp>
#include <string>
#include <string_view>

namespace dssm::ctl {

class Output {
 public:
  explicit Output(int fd);

  // Appends to what the next flush() writes.
  void add(std::string_view text) { pending_ += text; }

  // Writes all that is pending. Returns whether to continue: false when the reader ended or writing
  // failed.
  bool flush();

  // Flushes when a good amount is pending: for verbs that print without end.
  bool flush_some() { return pending_.size() < kBatchBytes ? !stopped_ : flush(); }

  // Whether the other end of a pipe was closed, also while nothing is written.
  bool reader_ended();

  // What went wrong when writing; a closed pipe does not count.
  const Result<void>& result() const { return result_; }

  bool terminal() const { return terminal_; }

  // `text` in bold on a terminal when $NO_COLOR is not set.
  std::string bold(std::string_view text) const;

 private:
  static constexpr std::size_t kBatchBytes = 64U << 10;

  int fd_;
  bool terminal_;
  bool colour_;
  bool stopped_ = false;
  std::string pending_;
  Result<void> result_;
};

// Writes `text` to standard error, at once.
void print_error(std::string_view text);

}  // namespace dssm::ctl
