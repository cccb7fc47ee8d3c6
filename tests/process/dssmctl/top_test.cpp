// SPDX-License-Identifier: Apache-2.0
//
// dssmctl top: on a terminal, whose screen is kept here as a terminal keeps it, and without one.
#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#include <algorithm>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;
using Strings = std::vector<std::string>;

// What a terminal shows of what is written to it. It knows the control sequences that top needs,
// and notes all others, and what a terminal would do that must not happen.
class TerminalScreen {
 public:
  TerminalScreen(std::size_t rows, std::size_t columns) { resize(rows, columns); }

  void resize(std::size_t rows, std::size_t columns) {
    columns_ = columns;
    rows_.assign(rows, Row(columns));
    row_ = column_ = 0;
  }

  void write(std::string_view bytes) {
    pending_ += bytes;
    while (!pending_.empty() && take()) {
    }
  }

  std::string text(std::size_t row) const {
    std::string text;
    for (const Cell& cell : rows_[row].cells) text += cell.character;
    text.erase(text.find_last_not_of(' ') + 1);
    return text;
  }
  Strings lines() const {
    Strings all;
    for (std::size_t row = 0; row < rows_.size(); ++row) all.push_back(text(row));
    return all;
  }
  // Of the row that is drawn in reverse, over its whole width.
  std::string selected() const {
    for (std::size_t row = 0; row < rows_.size(); ++row) {
      const std::vector<Cell>& cells = rows_[row].cells;
      if (std::all_of(cells.begin(), cells.end(), [](const Cell& c) { return c.is_reverse; })) {
        return text(row);
      }
    }
    return {};
  }

  bool is_alternate = false, has_cursor = true, wraps = true;
  std::string main_text;  // what was written outside the alternate screen
  std::string first_mistake;

 private:
  struct Cell {
    std::string character = " ";
    bool is_reverse = false;
  };
  struct Row {
    explicit Row(std::size_t columns) : cells(columns) {}
    std::vector<Cell> cells;
  };

  void note(const std::string& mistake) {
    if (first_mistake.empty()) first_mistake = mistake;
  }

  // Takes one character or control sequence off pending_; false: its rest is to come.
  bool take() {
    const auto lead = static_cast<unsigned char>(pending_.front());
    if (lead == 0x1b) return take_sequence();
    const std::size_t bytes = lead < 0x80 ? 1 : lead < 0xe0 ? 2 : lead < 0xf0 ? 3 : 4;
    if (pending_.size() < bytes) return false;
    put(pending_.substr(0, bytes));
    pending_.erase(0, bytes);
    return true;
  }

  void put(const std::string& character) {
    if (!is_alternate) {
      main_text += character;
    } else if (character == "\r") {
      column_ = 0;
    } else if (character == "\n") {
      if (++row_ >= rows_.size()) note("it scrolls");
      row_ = std::min(row_, rows_.size() - 1);
    } else if (static_cast<unsigned char>(character.front()) < 0x20) {
      note("a control character");
    } else if (column_ >= columns_) {
      note("'" + character + "' is beyond the last column");
    } else {
      rows_[row_].cells[column_++] = {character, is_reverse_};
    }
  }

  bool take_sequence() {
    const std::size_t end = pending_.find_first_of("ABCDHJKhlm", 1);
    if (end == std::string::npos) return false;
    const std::string sequence = pending_.substr(1, end);
    pending_.erase(0, end + 1);
    if (sequence == "[?1049h" || sequence == "[?1049l") {
      is_alternate = sequence.back() == 'h';
    } else if (sequence == "[?25h" || sequence == "[?25l") {
      has_cursor = sequence.back() == 'h';
    } else if (sequence == "[?7h" || sequence == "[?7l") {
      wraps = sequence.back() == 'h';
    } else if (sequence == "[H") {
      row_ = column_ = 0;
    } else if (sequence == "[2J") {
      rows_.assign(rows_.size(), Row(columns_));
    } else if (sequence == "[K") {
      if (column_ == columns_) note("it erases the last column");
      for (std::size_t i = column_; i < columns_; ++i) rows_[row_].cells[i] = {};
    } else if (sequence == "[7m" || sequence == "[0m") {
      is_reverse_ = sequence == "[7m";
    } else if (sequence != "[1m") {
      note("the sequence '" + sequence + "'");
    }
    return true;
  }

  std::size_t columns_ = 0, row_ = 0, column_ = 0;
  std::vector<Row> rows_;
  bool is_reverse_ = false;
  std::string pending_;
};

// So many fields that details are longer than the screen.
struct Attitude {
  double x, y, z, roll, pitch, yaw;
};
DSSM_DESCRIBE(Attitude, x, y, z, roll, pitch, yaw)

class TopOnATerminal : public FleetTest {
 protected:
  ~TopOnATerminal() override {
    EXPECT_EQ(screen_.first_mistake, "");
    if (pid_ > 0) ::kill(pid_, SIGKILL), wait_for(pid_);
    if (terminal_ >= 0) ::close(terminal_);
  }

  // Until top has drawn for the first time.
  void top(Strings words = {}, const std::string& locale = "C.UTF-8") {
    words.insert(words.begin(), {dssmctl_path(), "top"});
    start_on_terminal(std::move(words), locale);
    await_row(23, "q quit");
  }
  void start_on_terminal(Strings words, const std::string& locale = "C.UTF-8") {
    std::vector<char*> pointers;
    for (std::string& word : words) pointers.push_back(word.data());
    pointers.push_back(nullptr);
    std::string socket = environment().front();
    const winsize size{.ws_row = 24, .ws_col = 80, .ws_xpixel = 0, .ws_ypixel = 0};
    pid_ = ::forkpty(&terminal_, nullptr, nullptr, &size);
    if (pid_ == 0) {
      ::signal(SIGHUP, SIG_DFL);  // under nohup(1) it is ignored
      ::putenv(socket.data());
      ::setenv("LC_ALL", locale.c_str(), 1);
      ::setenv("TZ", "UTC", 1);
      ::execv(pointers[0], pointers.data());
      ::_exit(127);
    }
  }

  void press(std::string_view keys) {
    ASSERT_EQ(::write(terminal_, keys.data(), keys.size()), static_cast<ssize_t>(keys.size()));
  }

  // Reads what is there, or comes within a moment. False: the program has ended.
  bool read_some() {
    pollfd input{terminal_, POLLIN, 0};
    if (::poll(&input, 1, 10) <= 0) return true;
    char buffer[4096];
    const ssize_t got = ::read(terminal_, buffer, sizeof buffer);
    if (got <= 0) return false;
    shown_.append(buffer, static_cast<std::size_t>(got));
    screen_.write({buffer, static_cast<std::size_t>(got)});
    return true;
  }
  template <class Condition>
  void await_screen(Condition condition) {
    while (!condition()) {
      if (!read_some()) FAIL() << "it has ended: " << Json(screen_.lines()) << screen_.main_text;
    }
  }
  void await_row(std::size_t row, const std::string& part) {
    await_screen([&] { return contains(screen_.text(row), part); });
  }
  // The first words of the rows of the table, from the third row of the screen on.
  Strings names() const {
    Strings names;
    const Strings lines = screen_.lines();
    for (std::size_t row = 3; row + 1 < lines.size() && !lines[row].empty(); ++row) {
      names.push_back(words_of(lines[row]).front());
    }
    return names;
  }
  void await_names(const Strings& wanted) {
    await_screen([&] { return names() == wanted; });
  }
  void await_selected(const std::string& name) {
    await_screen([&] { return screen_.selected().starts_with(name); });
  }

  // Reads all until the program has ended, and returns its status.
  int end() {
    while (read_some()) {
    }
    return wait_for(std::exchange(pid_, -1));
  }
  void expect_restored() {
    EXPECT_FALSE(screen_.is_alternate);
    EXPECT_TRUE(screen_.has_cursor);
    EXPECT_TRUE(screen_.wraps);
    termios now{};
    ASSERT_EQ(::tcgetattr(terminal_, &now), 0);
    EXPECT_TRUE(now.c_lflag & ECHO);
    EXPECT_TRUE(now.c_lflag & ICANON);
  }

  Writer<Attitude> create(Session& session, const std::string& name, std::uint64_t depth) {
    return session.create<Attitude>(name, depth_of(depth)).value();
  }

  TerminalScreen screen_{24, 80};
  std::string shown_;
  pid_t pid_ = -1;
  int terminal_ = -1;
  static constexpr std::string_view kDown = "\x1b[B", kEscape = "\x1b", kEnter = "\r",
                                    kEnd = "\x1b[F";
  Writer<Attitude> odometry_ = create(session_, "odometry", 16),
                   lidar_ = create(session_, "lidar", 64), camera_ = create(on_pc2_, "camera", 32);
};

TEST_F(TopOnATerminal, ShowsThreeViews) {
  await_streams(1);
  odometry_.write({}, at_ns(0), Duration());
  top();
  await_names({"odometry", "lidar", "camera"});
  EXPECT_TRUE(screen_.is_alternate);
  EXPECT_FALSE(screen_.has_cursor);
  await_row(0, "pc1  3 streams: 0 live");
  await_row(0, "3 of 3 hosts up  clock unknown");
  EXPECT_TRUE(screen_.text(1).starts_with("[streams]  hosts  programs"));
  EXPECT_EQ(words_of(screen_.text(2)).front(), "NAME");

  press("h");
  await_names({"pc1", "pc2", "pc3"});
  EXPECT_TRUE(screen_.text(1).starts_with("streams  [hosts]  programs"));
  press("p");
  const auto has_rows_of_programs = [&] {
    const Strings lines = screen_.lines();
    return std::any_of(lines.begin(), lines.end(), [](const std::string& line) {
      return line.starts_with("pc1 ") && contains(line, "the test") &&
             contains(line, "lidar, odometry");
    });
  };
  await_screen(has_rows_of_programs);
  press("\t");
  await_names({"odometry", "lidar", "camera"});
  press("3");
  await_screen(has_rows_of_programs);
  press("q");
  EXPECT_EQ(end(), 0);
  expect_restored();
}

TEST_F(TopOnATerminal, SortsByKeys) {
  await_streams(1);
  top({"--sort", "depth", "--reverse"});
  await_names({"lidar", "camera", "odometry"});
  press("r");
  await_names({"odometry", "camera", "lidar"});
  press("<<<<");  // size, host, id, name
  await_row(1, "by name");
  await_names({"camera", "lidar", "odometry"});
  press("S");
  await_row(1, "by id");
  press("hS");  // each view has its own order
  await_row(1, "by host");
  press("sr");
  await_row(1, "by id, reversed");
}

TEST_F(TopOnATerminal, Filters) {
  await_streams(1);
  top();
  await_names({"odometry", "lidar", "camera"});
  press("/da");
  await_row(23, "/da_");
  await_names({"lidar"});
  press("\x7f");  // "d" is in two
  await_names({"odometry", "lidar"});
  press(kEnter);
  await_row(1, "filter d");
  await_row(23, "q quit");
  press("/\x7fq*\x7f\x7f*a");
  await_names({"camera"});
  press(kEscape);
  await_names({"odometry", "lidar"});
  press(kEscape);
  await_names({"odometry", "lidar", "camera"});
  press("/@pc2\r");
  await_names({"camera"});
}

TEST_F(TopOnATerminal, ShowsDetailsOfTheSelectedRow) {
  await_streams(1);
  odometry_.write({}, at_ns(0), Duration());
  top();
  await_names({"odometry", "lidar", "camera"});
  await_selected("odometry");
  press(kDown);
  await_selected("lidar");
  press("jjk");
  await_selected("lidar");
  press(kEnter);
  await_row(2, "lidar:0@pc1");
  press(kEnd);
  await_screen([&] {  // which only the details have
    const Strings lines = screen_.lines();
    return std::any_of(lines.begin(), lines.end(),
                       [](const std::string& line) { return line.starts_with("the test"); });
  });
  press("\x1b[Hjj");  // from the first line on
  await_row(2, "type:");
  press(kEscape);
  await_selected("lidar");
  press("hj\r");
  await_row(2, "pc2");
  await_row(3, "up for ");
  press(
      "\x1b"
      "p");
  await_row(1, "[programs]");
}

TEST_F(TopOnATerminal, FollowsTheSizeOfItsWindow) {
  await_streams(1);
  top();
  await_names({"odometry", "lidar", "camera"});
  const auto resize = [&](unsigned short rows, unsigned short columns) {
    const winsize size{.ws_row = rows, .ws_col = columns, .ws_xpixel = 0, .ws_ypixel = 0};
    press(" ");  // held: nothing is drawn but for what follows
    await_row(1, "held");
    screen_.resize(rows, columns);
    ASSERT_EQ(::ioctl(terminal_, TIOCSWINSZ, &size), 0);
    await_row(rows - 1U, "q quit");
    press(" ");
    await_screen([&] { return !contains(screen_.text(1), "held"); });
  };
  resize(50, 200);
  await_names({"odometry", "lidar", "camera"});
  await_row(2, "DEPTH");
  resize(24, 30);
  await_names({"odometry", "lidar", "camera"});
  EXPECT_TRUE(contains(screen_.text(2), "NAME")) << screen_.text(2);
  EXPECT_FALSE(contains(screen_.text(2), "DEPTH")) << screen_.text(2);
}

TEST_F(TopOnATerminal, RestoresTheTerminalWhenASignalEndsIt) {
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) {
    top();
    EXPECT_TRUE(screen_.is_alternate);
    const EndingSignal sent(pid_, number);
    EXPECT_EQ(end(), 0) << number;
    expect_restored();
    ::close(std::exchange(terminal_, -1));
    screen_.resize(24, 80);
  }
}

TEST_F(TopOnATerminal, EndsAfterAsManyUpdatesAsAreWanted) {
  start_on_terminal({dssmctl_path(), "top", "-n", "3", "-i", "10ms"});
  EXPECT_EQ(end(), 0);
  expect_restored();
}

// By the shell, as a person does it.
TEST_F(TopOnATerminal, GivesTheTerminalBackWhileItIsStopped) {
  const std::string script =
      "set -m; \"$0\" top; echo stopped; read -r line; fg >/dev/null; echo \"ended $?\"";
  await_streams(1);
  start_on_terminal({"/bin/bash", "--norc", "-c", script, dssmctl_path()});
  await_names({"odometry", "lidar", "camera"});
  press("\x1a");  // Ctrl-Z
  await_screen([&] { return contains(screen_.main_text, "stopped"); });
  expect_restored();
  screen_.resize(24, 80);
  press("\n");
  await_names({"odometry", "lidar", "camera"});
  EXPECT_TRUE(screen_.is_alternate);
  EXPECT_FALSE(screen_.has_cursor);
  press("p");  // keys are taken again
  await_row(1, "[programs]");
  press("q");
  await_screen([&] { return contains(screen_.main_text, "ended 0"); });
  EXPECT_EQ(end(), 0);
}

TEST_F(TopOnATerminal, KeepsWhatItKnowsWhileDssmdIsGone) {
  top({"--every", "100ms"});
  await_screen([&] { return names().size() >= 2; });
  daemon_.kill_hard();
  await_row(0, "dssmd does not answer");
  const Strings kept = names();
  EXPECT_EQ(kept[0] + " " + kept[1], "odometry lidar");
  press("j");  // keys are followed
  await_selected("lidar");
  daemon_.start();
  await_row(0, "pc1  ");
  await_screen([&] { return !contains(screen_.text(0), "dssmd does not answer"); });
  auto later = create(session_, "later", 4);
  await_screen([&] {
    const Strings all = names();
    return std::find(all.begin(), all.end(), "later") != all.end();
  });
  press("q");
  EXPECT_EQ(end(), 0);
}

TEST_F(TopOnATerminal, EscapesNamesAndStaysWithinTheWindow) {
  const Session other =
      Session::connect({.socket_path = daemon_.socket_path(),
                        .program = std::string("\x1b[31mred\n") + std::string(100, 'x')})
          .value();
  Session writing = other;
  auto stream = create(writing, std::string("\xe7\x8c\xab") + std::string(28, 'n'), 4);
  top({"--view", "programs"}, "C");
  await_screen([&] {
    const Strings lines = screen_.lines();
    return std::any_of(lines.begin(), lines.end(),
                       [](const std::string& line) { return contains(line, "?[31mred?xxx"); });
  });
  press("s");
  await_screen([&] {
    const Strings all = names();
    return std::any_of(all.begin(), all.end(), [](const std::string& name) {
      return name.starts_with("\\xe7\\x8c\\xabnnn");
    });
  });
  press("q");
  EXPECT_EQ(end(), 0);
  EXPECT_TRUE(std::all_of(shown_.begin(), shown_.end(), [](char c) {
    return static_cast<unsigned char>(c) < 0x80;
  })) << "not plain ASCII";
}

// --- without a terminal

class TopRows : public CtlTest {};

TEST_F(TopRows, AreHeadlineAndTable) {
  auto odometry = session_.create<Attitude>("odometry", depth_of(16)).value();
  auto lidar = session_.create<Attitude>("lidar", depth_of(64)).value();
  const Strings lines = lines_of(output({"top", "--sort", "name", "-n", "2", "-i", "10ms"}));
  ASSERT_EQ(lines.size(), 9U);
  for (const std::size_t first : {std::size_t{0}, std::size_t{5}}) {
    EXPECT_TRUE(lines[first].starts_with("pc1  2 streams: 0 live, 0 stalled  1 of 1 host up  "))
        << lines[first];
    EXPECT_TRUE(lines[first + 1].starts_with("NAME "));
    EXPECT_TRUE(lines[first + 2].starts_with("lidar "));
    EXPECT_TRUE(lines[first + 3].starts_with("odometry "));
  }
  EXPECT_EQ(lines[4], "");
  EXPECT_EQ(lines_of(output({"top", "lid*", "-n", "1"})).size(), 3U);
  EXPECT_TRUE(contains(output({"top", "--view", "programs", "-n", "1"}), "the test  lidar"));
  EXPECT_TRUE(contains(output({"top", "--view", "hosts", "-n", "1"}), "self"));
  EXPECT_EQ(ctl({"top", "--sort", "nothing"}).exit_status, 2);
  EXPECT_EQ(ctl({"top", "--view", "hosts", "--sort", "depth"}).exit_status, 2);
}

TEST_F(TopRows, AreALineOfJsonForEachUpdateAlsoWhileDssmdIsGone) {
  auto odometry = session_.create<Attitude>("odometry", depth_of(16)).value();
  Running top(argv({"top", "--json", "-i", "20ms"}), environment());
  Json state = Json::parse(top.line());
  EXPECT_GT(state["time_ns"], 0);
  EXPECT_TRUE(state["error"].is_null());
  EXPECT_EQ(state["hosts"][0]["host"], "pc1");
  EXPECT_EQ(state["streams"][0]["stream"], "odometry:0@pc1");
  EXPECT_EQ(state["streams"][0]["duplicate"], false);
  EXPECT_EQ(state["programs"][0]["program"], "the test");
  daemon_.kill_hard();
  while ((state = Json::parse(top.line()))["error"].is_null()) {
  }
  EXPECT_TRUE(state["streams"].is_null() && state["hosts"].is_null()) << state;
  daemon_.start();
  while (!(state = Json::parse(top.line()))["error"].is_null()) {
  }
  EXPECT_EQ(state["hosts"][0]["host"], "pc1");
  top.signal(SIGINT);
  top.rest();
  EXPECT_EQ(top.status(), 0);
}

TEST_F(TopRows, FailWithoutDssmd) {
  const Finished top = run(argv({"top"}), {"DSSM_SOCKET=/nonexistent/dssmd.sock"});
  EXPECT_EQ(top.exit_status, 1);
  EXPECT_TRUE(contains(top.err, "dssmctl: top: ")) << top.err;
}

}  // namespace
}  // namespace dssm::test
