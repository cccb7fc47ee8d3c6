// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/output.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <signal.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstdlib>
#include <limits>
#include <thread>
#include <utility>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

std::atomic<bool> stop_mark{false};
static_assert(std::atomic<bool>::is_always_lock_free);  // or a handler may not touch it

void on_signal(int) { stop_mark.store(true, std::memory_order_relaxed); }

}  // namespace

void catch_stop_signals() {
  struct sigaction action {};
  action.sa_handler = on_signal;  // without SA_RESTART: waits end
  ::sigaction(SIGINT, &action, nullptr);
  ::sigaction(SIGTERM, &action, nullptr);
  struct sigaction hangup {};  // the terminal was closed; ignored under nohup
  if (::sigaction(SIGHUP, nullptr, &hangup) == 0 && hangup.sa_handler != SIG_IGN) {
    ::sigaction(SIGHUP, &action, nullptr);
  }
}

bool stop_requested() { return stop_mark.load(std::memory_order_relaxed); }

Output::Output(int fd) : fd_(fd), terminal_(::isatty(fd) == 1) {
  // https://no-color.org: set and not empty
  const char* no_color = std::getenv("NO_COLOR");  // NOLINT(concurrency-mt-unsafe): one thread
  colour_ = terminal_ && (!no_color || !*no_color);
}

std::size_t Output::columns() const {
  winsize size{};
  const bool is_limited =
      terminal_ && !wide_ && ::ioctl(fd_, TIOCGWINSZ, &size) == 0 && size.ws_col > 0;
  return is_limited ? size.ws_col : std::numeric_limits<std::size_t>::max();
}

bool Output::flush() {
  std::string_view rest = pending_;
  while (!stopped_ && !rest.empty()) {
    const ssize_t written = ::write(fd_, rest.data(), rest.size());
    if (written >= 0) {
      rest.remove_prefix(static_cast<std::size_t>(written));
    } else if (errno == EAGAIN) {  // another program made our terminal or pipe non-blocking
      pollfd wanted{fd_, POLLOUT, 0};
      ::poll(&wanted, 1, -1);
    } else if (errno != EINTR) {
      if (errno != EPIPE) result_ = os_error("write to standard output");
      stopped_ = true;
    }
  }
  pending_.clear();
  return !stopped_;
}

bool Output::flush_changed(std::string_view end) {
  if (pending_ == screen_) {
    pending_.clear();
    return !stopped_;
  }
  screen_ = pending_;
  pending_ += end;
  return flush();
}

bool Output::flush_screen() {
  winsize size{};
  const std::size_t rows = ::ioctl(fd_, TIOCGWINSZ, &size) == 0 && size.ws_row > 1
                               ? size.ws_row - 1U
                               : std::numeric_limits<std::size_t>::max();
  // Line by line over the last ones: to clear the screen first would flicker.
  std::string drawn = screen_.empty() ? "\x1b[2J\x1b[H" : "\x1b[H";
  screen_ = std::exchange(pending_, {});
  std::string_view rest = screen_;
  for (std::size_t row = 0; row < rows && !rest.empty(); ++row) {
    const std::size_t line = rest.find('\n');
    drawn.append(rest.substr(0, line)).append("\x1b[K\n");
    rest.remove_prefix(line == std::string_view::npos ? rest.size() : line + 1);
  }
  pending_ = drawn + "\x1b[J";
  return flush();
}

Result<void> print_once_or_watch(bool watch, bool json, Output& out,
                                 const std::function<Result<void>()>& print, Duration period) {
  if (!watch) return print();
  catch_stop_signals();
  for (MonoTime next = MonoClock::now();; next += period) {
    DSSM_TRY(print());
    const bool is_read = json             ? out.flush_changed("")
                         : out.terminal() ? out.flush_screen()
                                          : out.flush_changed("\n");
    if (!is_read || !out.sleep_until(next + period)) return {};
  }
}

bool Output::must_stop() {
  pollfd state{fd_, 0, 0};
  if (::poll(&state, 1, 0) > 0 && (state.revents & POLLERR)) stopped_ = true;
  return stopped_ || stop_requested();
}

void Output::redraw_line(const std::function<std::string()>& text, bool now) {
  if (!terminal_ || (!now && MonoClock::now() < next_line_)) return;
  next_line_ = deadline_in(kLinePeriod);
  clear_line();
  add(text());
  flush();
  has_line_ = true;
}

void Output::clear_line() {
  if (!std::exchange(has_line_, false)) return;
  add("\r\x1b[K");
  flush();
}

bool Output::sleep_until(MonoTime due) {
  while (!must_stop()) {
    const Duration rest = due - MonoClock::now();
    if (rest <= Duration::zero()) return true;
    std::this_thread::sleep_for(std::min(rest, kStopCheckPeriod));
  }
  return false;
}

std::string Output::bold(std::string_view text) const {
  return colour_ ? fmt::format("\x1b[1m{}\x1b[0m", text) : std::string(text);
}

void print_error(std::string_view text) {
  Output err(STDERR_FILENO);
  err.add(text);
  err.flush();
}

std::vector<std::size_t> Table::widths() const {
  std::vector<std::size_t> widths;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    std::size_t width = columns_of(columns_[i].title);
    for (const auto& row : rows_) width = std::max(width, columns_of(row[i]));
    widths.push_back(width);
  }
  return widths;
}

namespace {

constexpr std::size_t kBetween = 2;  // blanks

// What is left of a table that has to fit.
struct Layout {
  std::vector<std::size_t> shown;   // indices of columns
  std::vector<std::size_t> widths;  // of all columns
  bool last_below = false;

  std::size_t width() const {
    std::size_t sum = 0;
    for (const std::size_t i : shown) sum += widths[i] + kBetween;
    return sum > 0 ? sum - kBetween : 0;
  }
};

Layout layout_of(const std::vector<Table::Column>& columns, std::vector<std::size_t> widths,
                 std::size_t available) {
  using Fit = Table::Column::Fit;
  Layout layout{{}, std::move(widths)};
  for (std::size_t i = 0; i < columns.size(); ++i) layout.shown.push_back(i);
  if (layout.width() > available && columns.back().fit == Fit::below) {
    layout.shown.pop_back();
    layout.last_below = true;
  }
  for (unsigned drop = 1; drop <= columns.size() && layout.width() > available; ++drop) {
    std::erase_if(layout.shown, [&](std::size_t i) { return columns[i].drop == drop; });
  }
  while (layout.width() > available) {
    std::size_t* widest = nullptr;
    for (const std::size_t i : layout.shown) {
      std::size_t& width = layout.widths[i];
      const bool can_be_cut = columns[i].fit == Fit::cut && width > columns_of(columns[i].title);
      if (can_be_cut && (!widest || width > *widest)) widest = &width;
    }
    if (!widest) break;
    --*widest;
  }
  return layout;
}

std::string line_of(const std::vector<Table::Column>& columns, const Layout& layout,
                    const std::vector<std::string>& cells) {
  std::string line;
  for (const std::size_t i : layout.shown) {
    const std::string cell = shortened(cells[i], layout.widths[i]);
    const std::size_t blanks = layout.widths[i] - columns_of(cell);
    if (i != layout.shown.front()) line.append(kBetween, ' ');
    if (columns[i].align == Table::Align::right) line.append(blanks, ' ');
    line += cell;
    if (columns[i].align == Table::Align::left) line.append(blanks, ' ');
  }
  line.erase(line.find_last_not_of(' ') + 1);
  return line;
}

std::string header_of(const std::vector<Table::Column>& columns, const Layout& layout) {
  std::vector<std::string> titles(columns.size());
  std::ranges::transform(columns, titles.begin(), &Table::Column::title);
  return line_of(columns, layout, titles);
}

// `text` in lines of `columns` columns at most, broken at blanks, each after four blanks.
std::string wrapped(std::string_view text, std::size_t columns) {
  constexpr std::string_view kIndent = "    ";
  std::string out, line;
  while (!text.empty()) {
    const std::size_t end = std::min(text.find(' '), text.size());
    const std::string_view word = text.substr(0, end);
    text.remove_prefix(std::min(end + 1, text.size()));
    if (!line.empty() && kIndent.size() + columns_of(line) + 1 + columns_of(word) > columns) {
      out.append(kIndent).append(line).append("\n");
      line.clear();
    }
    line.append(line.empty() ? "" : " ").append(word);
  }
  if (!line.empty()) out.append(kIndent).append(line).append("\n");
  return out;
}

}  // namespace

bool Table::fits(std::size_t columns) const {
  std::size_t sum = 0;
  for (const std::size_t width : widths()) sum += width + kBetween;
  return sum <= columns || sum - kBetween <= columns;
}

void Table::print(Output& out) const {
  const Layout layout = layout_of(columns_, widths(), out.columns());
  out.add(out.bold(header_of(columns_, layout)));
  out.add("\n");
  for (const auto& row : rows_) {
    out.add(line_of(columns_, layout, row));
    out.add("\n");
    const bool is_empty = row.back().empty() || row.back() == "-";
    if (layout.last_below && !is_empty) out.add(wrapped(row.back(), out.columns()));
  }
}

std::vector<std::string> Table::lines(std::size_t columns, std::size_t first,
                                      std::size_t count) const {
  const Layout layout = layout_of(columns_, widths(), columns);
  std::vector<std::string> lines = {header_of(columns_, layout)};
  for (std::size_t i = first; i < rows_.size() && i - first < count; ++i) {
    lines.push_back(line_of(columns_, layout, rows_[i]));
  }
  return lines;
}

}  // namespace dssm::ctl
