// SPDX-License-Identifier: Apache-2.0
//
// Standard output as text, tables and JSON; and Ctrl-C, which ends it.
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <nlohmann/json.hpp>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace dssm::ctl {

// Gathered in one string and written with as few system calls as possible: a list of a thousand
// streams is one write. A reader that ends (`| head`) is not an error: writing then stops quietly,
// and the program ends with success, as a person expects of a pipe.
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

  // What is pending, for a text that is shown otherwise than by flush(), which does not write it
  // then.
  std::string take() { return std::exchange(pending_, {}); }

  // Whether a verb that runs until Ctrl-C must end: a stop signal came, or the other end of a pipe
  // was closed, also while nothing is written.
  bool must_stop();

  // For a text that is printed again and again. Writes all that is pending, with `end` after it,
  // unless it is what was written so before; or, on a terminal, draws it over that.
  bool flush_changed(std::string_view end);
  bool flush_screen();

  // For a verb that goes on for long: on a terminal a line that the next call replaces, at most
  // once a second unless it is to be now, with what text() returns. clear_line() removes it before
  // anything else is printed.
  void redraw_line(const std::function<std::string()>& text, bool now = false);
  void clear_line();

  // Sleeps until `due`. False: it must stop.
  bool sleep_until(MonoTime due);

  // What went wrong when writing; a closed pipe does not count.
  const Result<void>& result() const { return result_; }

  bool terminal() const { return terminal_; }

  // How many columns there are for tables; no limit without a terminal and after set_wide().
  std::size_t columns() const;
  void set_wide() { wide_ = true; }

  // `text` in bold on a terminal when $NO_COLOR is not set.
  std::string bold(std::string_view text) const;

 private:
  static constexpr std::size_t kBatchBytes = 64U << 10;
  static constexpr Duration kLinePeriod = std::chrono::seconds(1);

  int fd_;
  bool terminal_;
  bool colour_;
  bool wide_ = false;
  bool stopped_ = false;
  std::string pending_;
  bool has_line_ = false;
  MonoTime next_line_ = deadline_in(kLinePeriod);
  std::string screen_;  // what flush_changed() or flush_screen() showed last
  Result<void> result_;
};

// Writes `text` to standard error, at once.
void print_error(std::string_view text);

// Rows of cells as aligned columns, two spaces apart, as wide as their contents. Cells are escaped
// (see text.hpp). What is wider than a terminal is made to fit, as far as its columns allow it.
class Table {
 public:
  enum class Align : unsigned char { left, right };
  struct Column {
    std::string title;
    Align align = Align::left;
    // What to do when the table is too wide, in this order: a column that may be below (the last
    // one only) has its cells in lines of their own, after their rows, but for those that are
    // empty or "-"; columns are left out, from
    // drop = 1 on; those that may be short are cut, the widest ones first.
    unsigned drop = 0;  // 0: never
    enum class Fit : unsigned char { whole, below, cut } fit = Fit::whole;
  };

  explicit Table(std::vector<Column> columns) : columns_(std::move(columns)) {}

  // One cell per column.
  void add_row(std::vector<std::string> cells) { rows_.push_back(std::move(cells)); }

  // Whether it fits as it is.
  bool fits(std::size_t columns) const;

  // Header (bold on a terminal) and rows, without blanks at the ends of lines.
  void print(Output& out) const;

  // The header, then `count` rows at most from row number `first` on, a line each, for a window
  // that shows a part of them: columns are as wide as all rows need. What belongs below a row is
  // left out; a line may be too wide where the columns do not allow more.
  std::vector<std::string> lines(std::size_t columns, std::size_t first, std::size_t count) const;

  std::size_t rows() const { return rows_.size(); }

 private:
  std::vector<std::size_t> widths() const;
  std::vector<Column> columns_;
  std::vector<std::vector<std::string>> rows_;
};

// --- JSON: keys in the order in which they are written, whole numbers exact, NaN and infinity as
// null, everything outside ASCII as \u escapes. Bytes that are not UTF-8 become U+FFFD.

using Json = nlohmann::ordered_json;

inline std::string json_text(const Json& json) {
  return json.dump(-1, ' ', true, Json::error_handler_t::replace);
}

inline std::string json_line(const Json& json) { return json_text(json) + "\n"; }

// A bound on a clock's or stamp's error [ns]; null: unknown.
inline Json bound_json(Duration bound) {
  return bound >= kForeignClockError ? Json() : Json(to_ns(bound));
}

// null for an empty text.
inline Json or_null(std::string_view text) { return text.empty() ? Json() : Json(text); }

// A document of its own: indented, because people read it too.
inline std::string json_document(const Json& json) {
  return json.dump(2, ' ', true, Json::error_handler_t::replace) + "\n";
}

// A line where several documents follow each other, so that programs can tell them apart.
inline std::string json_output(const Json& json, bool one_of_several) {
  return one_of_several ? json_line(json) : json_document(json);
}

// --- Ctrl-C, for verbs that run until then: SIGINT, SIGTERM and SIGHUP end them with success,
// after their final output. All other verbs end by these signals at once, as programs do.

// Adds to `out` by `print` what a verb shows; with `watch` each `period` until Ctrl-C, when
// it has changed, and on a terminal over the last one.
Result<void> print_once_or_watch(bool watch, bool json, Output& out,
                                 const std::function<Result<void>()>& print,
                                 Duration period = std::chrono::seconds(1));

// From now on SIGINT, SIGTERM and SIGHUP (unless that is ignored) only set a mark, and interrupt
// system calls.
void catch_stop_signals();

bool stop_requested();

// How long to wait at most before checking stop_requested() again: a signal that comes between the
// check and the wait does not interrupt the wait.
inline constexpr Duration kStopCheckPeriod = std::chrono::milliseconds(100);

}  // namespace dssm::ctl
