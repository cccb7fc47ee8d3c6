// SPDX-License-Identifier: Apache-2.0
//
// The whole terminal for a program that draws on it and takes keys, as top(1) does: its alternate
// screen, without a cursor. What a person had on the terminal is there again at the end, and while
// the program is stopped by Ctrl-Z. Only ANSI control sequences, which all terminals know.
#pragma once

#include <cstddef>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <vector>

#include "client/dssmctl/keyboard.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

struct ScreenSize {
  std::size_t rows = 24, columns = 80;
  friend bool operator==(const ScreenSize&, const ScreenSize&) = default;
};

struct ScreenLine {
  enum class Style : unsigned char { plain, title, selected };
  std::string text;  // escaped
  Style style = Style::plain;
};

// One at a time, of the program's main thread; standard output is a terminal. Signals that end the
// program are the caller's: catch_stop_signals().
class Screen {
 public:
  // `out`, which is standard output, outlives it.
  explicit Screen(Output& out);
  Screen(const Screen&) = delete;
  Screen& operator=(const Screen&) = delete;
  ~Screen();

  // At this moment; 24 x 80 where the terminal does not state it.
  static ScreenSize size();

  // Draws as many lines as there are rows, each cut to the width. Writes nothing if that is what
  // the screen shows. False: standard output is not read any more.
  bool draw(const std::vector<ScreenLine>& lines, ScreenSize size);

  // The next draw() writes all, whatever is there.
  void clear() { shown_.clear(); }
  // Whether nothing was drawn yet since it began, or since it was stopped or cleared.
  bool is_blank() const { return shown_.empty(); }

  // Waits for a key, until `due`. May return nothing before that: when the size has changed, or
  // when it must be drawn again after a stop, for example.
  std::optional<Key> wait(MonoTime due);

 private:
  void enter();
  void leave();
  void suspend();  // by Ctrl-Z

  Output& out_;
  std::optional<Keyboard> keyboard_;
  std::string shown_;
};

}  // namespace dssm::ctl
