// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/output.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#include "tests/unit/client/dssmctl/printed.hpp"

namespace dssm::ctl {
namespace {

TEST(Table, AlignsColumnsToTheirContentsWithoutTrailingBlanks) {
  Table table({{"NAME"}, {"N", Table::Align::right}, {"TYPE"}});
  table.add_row({"a", "1000", "x"});
  table.add_row({"long name", "7", ""});
  EXPECT_EQ(printed([&](Output& out) { table.print(out); }),
            "NAME          N  TYPE\n"
            "a          1000  x\n"
            "long name     7\n");
}

// What `print(Output&)` prints on a terminal of so many columns and 4 rows.
template <class Print>
std::string on_terminal(unsigned short columns, Print print) {
  const int master = ::posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
  EXPECT_EQ(::grantpt(master) | ::unlockpt(master), 0);
  const int slave = ::open(::ptsname(master), O_RDWR | O_NOCTTY | O_CLOEXEC);
  termios raw{};
  ::tcgetattr(slave, &raw);
  ::cfmakeraw(&raw);
  ::tcsetattr(slave, TCSANOW, &raw);
  const winsize size{4, columns, 0, 0};
  EXPECT_EQ(::ioctl(slave, TIOCSWINSZ, &size), 0);
  ::setenv("NO_COLOR", "1", 1);
  Output out(slave);
  ::unsetenv("NO_COLOR");
  print(out);
  out.flush();
  ::close(slave);
  std::string text;
  char part[4096];
  for (ssize_t got = 0; (got = ::read(master, part, sizeof part)) > 0;) {  // then EIO
    text.append(part, static_cast<std::size_t>(got));
  }
  ::close(master);
  return text;
}

std::string on_terminal(unsigned short columns, const Table& table, bool wide = false) {
  return on_terminal(columns, [&](Output& out) {
    if (wide) out.set_wide();
    table.print(out);
  });
}

TEST(Output, DrawsAScreenOverTheLastOne) {
  EXPECT_EQ(on_terminal(80,
                        [](Output& out) {
                          out.add("one\ntwo\n");
                          EXPECT_TRUE(out.flush_screen());
                          out.add("1\n2\n3\n4\n5\n");
                          EXPECT_TRUE(out.flush_screen());
                        }),
            "\x1b[2J\x1b[Hone\x1b[K\ntwo\x1b[K\n\x1b[J"
            "\x1b[H1\x1b[K\n2\x1b[K\n3\x1b[K\n\x1b[J")
      << "what does not fit would scroll";
}

TEST(Output, WritesOnlyWhatHasChanged) {
  EXPECT_EQ(printed([](Output& out) {
              for (const char* text : {"a\n", "a\n", "b\n", "a\n"}) {
                out.add(text);
                EXPECT_TRUE(out.flush_changed("\n"));
              }
            }),
            "a\n\nb\n\na\n\n");
}

TEST(Output, IsWatchedWithoutRepeatingWhatIsTheSame) {
  ::signal(SIGPIPE, SIG_IGN);
  for (const bool json : {true, false}) {
    int ends[2];
    ASSERT_EQ(::pipe2(ends, O_CLOEXEC), 0);
    Output out(ends[1]);
    const char* const texts[] = {"a\n", "a\n", "b\n", "b\n", "a\n", "a\n"};
    std::size_t shown = 0;
    std::string text(4096, '\0');
    const auto print = [&]() -> Result<void> {
      if (shown == std::size(texts)) {
        text.resize(static_cast<std::size_t>(::read(ends[0], text.data(), text.size())));
        ::close(ends[0]);  // which ends it
        return {};
      }
      out.add(texts[shown++]);
      return {};
    };
    EXPECT_TRUE(print_once_or_watch(true, json, out, print, Duration(1)));
    EXPECT_EQ(text, json ? "a\nb\na\n" : "a\n\nb\n\na\n\n");
    ::close(ends[1]);
  }
}

Table table_to_fit() {
  using Fit = Table::Column::Fit;
  Table table({{"NAME"},
               {"ID", Table::Align::right, 1},
               {"SIZE", Table::Align::right, 2},
               {"TYPE", Table::Align::left, 0, Fit::cut},
               {"NOTE", Table::Align::left, 0, Fit::below}});
  table.add_row({"odom", "0", "1000", "vehicle::Odometry", "the host is down"});
  return table;
}

TEST(Table, FitsATerminalByWhatItsColumnsAllow) {
  const std::string whole =
      "NAME  ID  SIZE  TYPE               NOTE\n"
      "odom   0  1000  vehicle::Odometry  the host is down\n";
  EXPECT_EQ(on_terminal(51, table_to_fit()), whole);
  EXPECT_EQ(on_terminal(20, table_to_fit(), true), whole);
  EXPECT_EQ(on_terminal(50, table_to_fit()),
            "NAME  ID  SIZE  TYPE\n"
            "odom   0  1000  vehicle::Odometry\n"
            "    the host is down\n");
  EXPECT_EQ(on_terminal(32, table_to_fit()),
            "NAME  SIZE  TYPE\n"
            "odom  1000  vehicle::Odometry\n"
            "    the host is down\n");
  EXPECT_EQ(on_terminal(16, table_to_fit()),
            "NAME  TYPE\n"
            "odom  vehicle...\n"
            "    the host is\n"
            "    down\n");
}

TEST(Table, HasNoLineBelowForAnEmptyCell) {
  using Fit = Table::Column::Fit;
  Table table({{"NAME"}, {"NOTE", Table::Align::left, 0, Fit::below}});
  for (const char* note : {"-", "", "down"}) table.add_row({"odometry", note});
  EXPECT_EQ(on_terminal(14, table),
            "NAME      NOTE\n"
            "odometry  -\n"
            "odometry\n"
            "odometry  down\n");
  EXPECT_EQ(on_terminal(12, table),
            "NAME\n"
            "odometry\n"
            "odometry\n"
            "odometry\n"
            "    down\n");
}

TEST(Table, HasLinesForAWindowOfItsRows) {
  using Strings = std::vector<std::string>;
  Table table = table_to_fit();
  for (const char* name : {"a", "a long name", "b"}) table.add_row({name, "1", "2", "T", "-"});
  EXPECT_EQ(table.rows(), 4U);
  EXPECT_EQ(table.lines(80, 1, 2), (Strings{"NAME         ID  SIZE  TYPE               NOTE",
                                            "a             1     2  T                  -",
                                            "a long name   1     2  T                  -"}));
  EXPECT_EQ(table.lines(30, 0, 1), (Strings{"NAME         TYPE", "odom         vehicle::Odometry"}))
      << "without what is below";
  EXPECT_EQ(table.lines(80, 3, 9).size(), 2U);
  EXPECT_EQ(table.lines(80, 4, 9).size(), 1U);
}

TEST(Table, CutsTheWidestOfSeveralColumnsFirst) {
  constexpr auto kCut = Table::Column::Fit::cut;
  Table table({{"A", Table::Align::left, 0, kCut}, {"B", Table::Align::left, 0, kCut}});
  table.add_row({"0123456789", "012345"});
  EXPECT_EQ(on_terminal(14, table), "A       B\n012...  012345\n");
  EXPECT_EQ(on_terminal(12, table), "A      B\n01...  01...\n");
}

TEST(Table, PrintsItsHeaderWithoutRows) {
  EXPECT_EQ(printed([&](Output& out) { Table({{"NAME"}, {"N"}}).print(out); }), "NAME  N\n");
}

}  // namespace
}  // namespace dssm::ctl
