// SPDX-License-Identifier: Apache-2.0
//
// Single keys from a terminal, without Enter and without an echo.
#pragma once

#include <termios.h>

#include <dssm/time.hpp>
#include <optional>
#include <string>

namespace dssm::ctl {

// A byte that is typed is the key of that number, as Key('x'); a character outside ASCII is as many
// keys as it has bytes. Keys that are not characters are above all bytes.
enum class Key : unsigned short {
  tab = '\t',
  enter = '\n',
  escape = 0x1b,
  space = ' ',
  q = 'q',
  r = 'r',
  backspace = 0x7f,
  left = 0x100,
  right,
  up,
  down,
  page_up,
  page_down,
  home,
  end,
};

// While it exists, standard input gives keys, if that is a terminal and this program is in its
// foreground. Ctrl-C and Ctrl-Z work as ever.
class Keyboard {
 public:
  Keyboard();
  Keyboard(const Keyboard&) = delete;
  Keyboard& operator=(const Keyboard&) = delete;
  ~Keyboard();

  bool is_there() const noexcept { return before_.has_value(); }

  // Waits for a key, until `due`; without a keyboard it only waits. May return nothing before that.
  std::optional<Key> wait(MonoTime due);

 private:
  std::optional<Key> take_key(bool is_all);  // out of typed_

  std::optional<termios> before_;  // how the terminal was
  std::string typed_;              // and not taken yet
  // While typed_ begins like the sequence of a key: until then its rest comes, or it was Escape.
  std::optional<MonoTime> rest_due_;
};

}  // namespace dssm::ctl
