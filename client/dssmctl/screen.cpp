// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/screen.hpp"

#include <signal.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <atomic>
#include <utility>

#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// Alternate screen, no cursor, no line goes on in the next one.
constexpr std::string_view kEnter = "\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[H\x1b[2J";
constexpr std::string_view kLeave = "\x1b[?7h\x1b[?25h\x1b[?1049l";

std::atomic<bool> is_to_suspend{false}, was_continued{false};

void on_screen_signal(int number) {
  if (number == SIGTSTP) is_to_suspend.store(true, std::memory_order_relaxed);
  if (number == SIGCONT) was_continued.store(true, std::memory_order_relaxed);
  // SIGWINCH only ends the wait for a key.
}

void handle(int number, void (*handler)(int)) {
  struct sigaction action {};
  action.sa_handler = handler;  // without SA_RESTART: waits end
  ::sigaction(number, &action, nullptr);
}

// A shell without job control starts programs with this ignored.
bool can_suspend() {
  struct sigaction now {};
  return ::sigaction(SIGTSTP, nullptr, &now) == 0 && now.sa_handler != SIG_IGN;
}

std::string styled(const ScreenLine& line, std::size_t columns, const Output& out) {
  std::string text = shortened(line.text, columns);
  const std::size_t width = columns_of(text);
  if (line.style == ScreenLine::Style::selected) {
    return "\x1b[7m" + text + std::string(columns - width, ' ') + "\x1b[0m";
  }
  if (line.style == ScreenLine::Style::title) text = out.bold(text);
  // Behind the last column it would erase the character there.
  return width < columns ? text + "\x1b[K" : text;
}

}  // namespace

Screen::Screen(Output& out) : out_(out) {
  if (can_suspend()) handle(SIGTSTP, on_screen_signal);
  handle(SIGCONT, on_screen_signal);
  handle(SIGWINCH, on_screen_signal);
  enter();
}

Screen::~Screen() {
  if (can_suspend()) handle(SIGTSTP, SIG_DFL);
  handle(SIGCONT, SIG_DFL);
  handle(SIGWINCH, SIG_DFL);
  leave();
}

ScreenSize Screen::size() {
  winsize window{};
  if (::ioctl(STDOUT_FILENO, TIOCGWINSZ, &window) != 0 || window.ws_row == 0 ||
      window.ws_col == 0) {
    return {};
  }
  return {window.ws_row, window.ws_col};
}

bool Screen::draw(const std::vector<ScreenLine>& lines, ScreenSize size) {
  std::string text = "\x1b[H";
  for (std::size_t row = 0; row < size.rows; ++row) {
    if (row > 0) text += "\r\n";
    text += row < lines.size() ? styled(lines[row], size.columns, out_) : "\x1b[K";
  }
  if (text == shown_) return true;
  shown_ = std::move(text);
  out_.add(shown_);
  return out_.flush();
}

std::optional<Key> Screen::wait(MonoTime due) {
  if (is_to_suspend.exchange(false, std::memory_order_relaxed)) suspend();
  if (was_continued.exchange(false, std::memory_order_relaxed)) {
    // After SIGSTOP: the shell has set the terminal, and written to it.
    leave();
    enter();
    return std::nullopt;
  }
  return keyboard_->wait(due);
}

void Screen::enter() {
  // A program in the background waits for its turn, as one that reads the terminal does.
  const pid_t foreground = ::tcgetpgrp(STDOUT_FILENO);
  if (foreground > 0 && foreground != ::getpgrp()) ::raise(SIGTTOU);
  keyboard_.emplace();
  out_.add(kEnter);
  out_.flush();
  shown_.clear();
  was_continued.store(false, std::memory_order_relaxed);
}

void Screen::leave() {
  out_.add(kLeave);
  out_.flush();
  keyboard_.reset();
}

void Screen::suspend() {
  leave();
  handle(SIGTSTP, SIG_DFL);
  ::raise(SIGTSTP);  // until SIGCONT
  handle(SIGTSTP, on_screen_signal);
  enter();
}

}  // namespace dssm::ctl
