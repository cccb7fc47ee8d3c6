// SPDX-License-Identifier: Apache-2.0
//
// Single keys from a terminal, without Enter and without an echo.
#pragma once

#include <termios.h>

#include <dssm/time.hpp>
#include <optional>
#include <string>

namespace dssm::ctl {

enum class Key : unsigned char { space, left, right, up, down, page_up, page_down, home, r, q };

// While it exists, standard input gives keys, if that is a terminal and this program is in its
// foreground. Ctrl-C and Ctrl-Z work as ever.
class Keyboard {
 public:
  Keyboard();
  Keyboard(const Keyboard&) = delete;
  Keyboard& operator=(const Keyboard&) = delete;
  ~Keyboard();

  bool is_there() const noexcept { return before_.has_value(); }

  // Waits for a key of the above, until `due`; without a keyboard it only waits. May return nothing
  // before that.
  std::optional<Key> wait(MonoTime due);

 private:
  std::optional<Key> take_key();  // out of typed_

  std::optional<termios> before_;  // how the terminal was
  std::string typed_;              // and not taken yet
};

}  // namespace dssm::ctl
