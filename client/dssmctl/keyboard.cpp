// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/keyboard.hpp"

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <string_view>
#include <utility>

#include "core/base/time.hpp"

namespace dssm::ctl {
namespace {

// A terminal sends a sequence at once; a slow network may part it.
constexpr Duration kSequenceTime = std::chrono::milliseconds(50);

bool is_in_foreground() { return ::tcgetpgrp(STDIN_FILENO) == ::getpgrp(); }

// How long the control sequence is that `typed` begins with, after an escape character: 1 if it is
// not one, 0 if its end is still to come.
std::size_t sequence_bytes(std::string_view typed) {
  constexpr std::size_t kMaxBytes = 32;
  if (typed.size() == 1) return 0;
  if (typed[1] == 'O') return typed.size() < 3 ? 0 : 3;
  if (typed[1] != '[') return 1;
  for (std::size_t i = 2; i < std::min(typed.size(), kMaxBytes); ++i) {
    if (typed[i] >= 0x40 && typed[i] < 0x7f) return i + 1;
  }
  return typed.size() < kMaxBytes ? 0 : kMaxBytes;
}

// As xterm and its successors send them.
std::optional<Key> key_of(std::string_view sequence) {
  static constexpr std::pair<std::string_view, Key> kKeys[] = {
      {"\x1b", Key::escape},     {"\x1b[A", Key::up},         {"\x1bOA", Key::up},
      {"\x1b[B", Key::down},     {"\x1bOB", Key::down},       {"\x1b[C", Key::right},
      {"\x1bOC", Key::right},    {"\x1b[D", Key::left},       {"\x1bOD", Key::left},
      {"\x1b[5~", Key::page_up}, {"\x1b[6~", Key::page_down}, {"\x1b[H", Key::home},
      {"\x1bOH", Key::home},     {"\x1b[1~", Key::home},      {"\x1b[F", Key::end},
      {"\x1bOF", Key::end},      {"\x1b[4~", Key::end}};
  for (const auto& [text, key] : kKeys) {
    if (text == sequence) return key;
  }
  return std::nullopt;
}

Key key_of(char byte) {
  if (byte == '\r') return Key::enter;
  if (byte == '\b') return Key::backspace;
  return static_cast<Key>(static_cast<unsigned char>(byte));
}

}  // namespace

Keyboard::Keyboard() {
  termios now{};
  if (!is_in_foreground() || ::tcgetattr(STDIN_FILENO, &now) != 0) return;
  before_ = now;
  now.c_lflag &= ~static_cast<tcflag_t>(ICANON | ECHO);
  now.c_cc[VMIN] = 0;
  now.c_cc[VTIME] = 0;
  ::tcsetattr(STDIN_FILENO, TCSANOW, &now);
}

Keyboard::~Keyboard() {
  // In the background the terminal is another program's, and this one would be stopped.
  if (before_ && is_in_foreground()) ::tcsetattr(STDIN_FILENO, TCSANOW, &*before_);
}

std::optional<Key> Keyboard::wait(MonoTime due) {
  if (const auto key = take_key(false)) return key;
  pollfd input{before_ ? STDIN_FILENO : -1, POLLIN, 0};
  const MonoTime until = rest_due_ ? std::min(due, *rest_due_) : due;
  const timespec timeout = timespec_of(until - MonoClock::now());
  if (::ppoll(&input, 1, &timeout, nullptr) <= 0) {
    return rest_due_ && MonoClock::now() >= *rest_due_ ? take_key(true) : std::nullopt;
  }
  char text[64];
  const ssize_t got = ::read(STDIN_FILENO, text, sizeof text);
  if (got <= 0) {
    before_.reset();  // the terminal is gone
    return std::nullopt;
  }
  typed_.append(text, static_cast<std::size_t>(got));
  rest_due_.reset();
  return take_key(false);
}

// `is_all`: what is not here yet does not come.
std::optional<Key> Keyboard::take_key(bool is_all) {
  while (!typed_.empty()) {
    if (typed_.front() != '\x1b') {
      const Key key = key_of(typed_.front());
      typed_.erase(0, 1);
      return key;
    }
    std::size_t bytes = sequence_bytes(typed_);
    if (bytes == 0 && !is_all) {
      if (!rest_due_) rest_due_ = deadline_in(kSequenceTime);
      return std::nullopt;
    }
    rest_due_.reset();
    bytes = std::max<std::size_t>(bytes, 1);
    const auto key = key_of(std::string_view(typed_).substr(0, bytes));
    typed_.erase(0, bytes);
    if (key) return key;
  }
  return std::nullopt;
}

}  // namespace dssm::ctl
