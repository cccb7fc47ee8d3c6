// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/keyboard.hpp"

#include <poll.h>
#include <unistd.h>

#include <string_view>
#include <utility>

#include "core/base/time.hpp"

namespace dssm::ctl {

Keyboard::Keyboard() {
  termios now{};
  if (::tcgetpgrp(STDIN_FILENO) != ::getpgrp() || ::tcgetattr(STDIN_FILENO, &now) != 0) return;
  before_ = now;
  now.c_lflag &= ~static_cast<tcflag_t>(ICANON | ECHO);
  now.c_cc[VMIN] = 0;
  now.c_cc[VTIME] = 0;
  ::tcsetattr(STDIN_FILENO, TCSANOW, &now);
}

Keyboard::~Keyboard() {
  if (before_) ::tcsetattr(STDIN_FILENO, TCSANOW, &*before_);
}

std::optional<Key> Keyboard::wait(MonoTime due) {
  if (const auto key = take_key()) return key;
  pollfd input{before_ ? STDIN_FILENO : -1, POLLIN, 0};
  const timespec timeout = timespec_of(due - MonoClock::now());
  if (::ppoll(&input, 1, &timeout, nullptr) <= 0) return std::nullopt;
  char text[64];
  const ssize_t got = ::read(STDIN_FILENO, text, sizeof text);
  if (got <= 0) {
    before_.reset();  // the terminal is gone
    return std::nullopt;
  }
  typed_.append(text, static_cast<std::size_t>(got));
  return take_key();
}

std::optional<Key> Keyboard::take_key() {
  // As xterm and its successors send them.
  static constexpr std::pair<std::string_view, Key> kKeys[] = {
      {" ", Key::space},           {"r", Key::r},          {"q", Key::q},
      {"\x1b[A", Key::up},         {"\x1bOA", Key::up},    {"\x1b[B", Key::down},
      {"\x1bOB", Key::down},       {"\x1b[C", Key::right}, {"\x1bOC", Key::right},
      {"\x1b[D", Key::left},       {"\x1bOD", Key::left},  {"\x1b[5~", Key::page_up},
      {"\x1b[6~", Key::page_down}, {"\x1b[H", Key::home},  {"\x1bOH", Key::home},
      {"\x1b[1~", Key::home}};
  for (; !typed_.empty(); typed_.erase(0, 1)) {
    for (const auto& [text, key] : kKeys) {
      if (!typed_.starts_with(text)) continue;
      typed_.erase(0, text.size());
      return key;
    }
  }
  return std::nullopt;
}

}  // namespace dssm::ctl
