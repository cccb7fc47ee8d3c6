// SPDX-License-Identifier: Apache-2.0
//
// What top shows and how it follows keys, without a terminal.
#include "client/dssmctl/top_display.hpp"

#include <gtest/gtest.h>

#include "client/dssmctl/text.hpp"
#include "tests/unit/client/dssmctl/printed.hpp"

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;
using Strings = std::vector<std::string>;

StreamInfo a_stream(const std::string& name, const std::string& host, StreamState state,
                    double rate_hz = 0) {
  StreamInfo info;
  info.id = {name, 0, host};
  info.type.name = "Pose";
  info.state = state;
  info.rate_hz = rate_hz;
  info.age = 10ms;
  return info;
}

HostInfo a_host(const std::string& name, HostState state, Duration round_trip = {}) {
  HostInfo info;
  info.name = name;
  info.state = state;
  info.round_trip = round_trip;
  info.addresses = {name + ":13776"};
  return info;
}

NodeInfo a_program(const std::string& name, std::int32_t pid, int reads) {
  NodeInfo info;
  info.host = "pc1";
  info.pid = pid;
  info.program = name;
  for (int i = 0; i < reads; ++i) {
    info.streams.push_back({{"s" + std::to_string(i), 0, "pc1"}, Role::reader, StreamVia::local});
  }
  return info;
}

TopState example_state() {
  TopState state;
  state.time = time_from_ns(3'723'000'000'000);
  state.hosts = {a_host("pc1", HostState::self), a_host("pc3", HostState::down),
                 a_host("pc2", HostState::up, 2ms), a_host("pc2", HostState::up, 1ms),
                 a_host("", HostState::down)};
  state.streams = {a_stream("odometry", "pc1", StreamState::live, 50),
                   a_stream("lidar", "pc2", StreamState::live, 10),
                   a_stream("camera", "pc2", StreamState::stalled, 30),
                   a_stream("lidar", "pc1", StreamState::empty)};
  state.programs = {a_program("viewer", 7, 2), a_program("mapper", 9, 1)};
  return state;
}

TopDisplay display_of(TopState state, TopView view = TopView::streams) {
  TopOptions options;
  options.view = view;
  options.iso = true;
  TopDisplay display(options);
  display.set_state(std::move(state));
  return display;
}

Strings screen_texts(TopDisplay& display, ScreenSize size) {
  Strings texts;
  for (const ScreenLine& line : display.lines(size)) texts.push_back(line.text);
  return texts;
}

std::string selected_row(TopDisplay& display, ScreenSize size = {}) {
  for (const ScreenLine& line : display.lines(size)) {
    if (line.style == ScreenLine::Style::selected) return line.text.substr(0, line.text.find("  "));
  }
  return {};
}

void press_keys(TopDisplay& display, std::string_view keys) {
  for (const char key : keys) {
    display.lines({});  // as the program does
    EXPECT_TRUE(display.on_key(static_cast<Key>(static_cast<unsigned char>(key))));
  }
}

Strings top_names(const std::vector<StreamInfo>& streams) {
  Strings names;
  for (const StreamInfo& one : streams) names.push_back(one.id.str());
  return names;
}
Strings top_names(const std::vector<HostInfo>& hosts) {
  Strings names;
  for (const HostInfo& one : hosts) names.push_back(one.name);
  return names;
}
Strings top_names(const std::vector<NodeInfo>& programs) {
  Strings names;
  for (const NodeInfo& one : programs) names.push_back(one.program);
  return names;
}

TEST(TopOrder, FiltersByAPartOfTheNameOrAPattern) {
  const TopState state = example_state();
  const auto streams = [&](const char* filter) {
    return top_names(shown_streams(state, {filter, "", false}).streams);
  };
  EXPECT_EQ(streams("").size(), 4U);
  EXPECT_EQ(streams("ida"), (Strings{"lidar:0@pc2", "lidar:0@pc1"}));
  EXPECT_EQ(streams("r:0@pc1"), (Strings{"lidar:0@pc1"}));
  EXPECT_EQ(streams("*a"), (Strings{"camera:0@pc2"})) << "the whole name";
  EXPECT_EQ(streams("[lo]*@pc1"), (Strings{"odometry:0@pc1", "lidar:0@pc1"}));
  EXPECT_EQ(streams("ida?"), Strings{});
  EXPECT_EQ(top_names(shown_hosts(state, {"c3", "", false})), Strings{"pc3"});
  EXPECT_EQ(top_names(shown_hosts(state, {"pc2:*", "", false})), (Strings{"pc2", "pc2"}))
      << "an address";
  EXPECT_EQ(top_names(shown_programs(state, {"map*", "", false})), Strings{"mapper"});
  EXPECT_EQ(top_names(shown_programs(state, {"r@pc", "", false})), (Strings{"viewer", "mapper"}));
}

TEST(TopOrder, SortsByTheKeysOfTheView) {
  const TopState state = example_state();
  EXPECT_EQ(top_names(shown_streams(state, {"", "rate", true}).streams),
            (Strings{"odometry:0@pc1", "lidar:0@pc2", "lidar:0@pc1", "camera:0@pc2"}))
      << "a stalled stream has no rate";
  EXPECT_EQ(top_names(shown_hosts(state, {"", "rtt", false})),
            (Strings{"pc2", "pc2", "pc1", "pc3", ""}));
  EXPECT_EQ(shown_hosts(state, {"", "rtt", false}).front().round_trip, 1ms);
  EXPECT_EQ(top_names(shown_hosts(state, {"", "host", false})),
            (Strings{"", "pc1", "pc2", "pc2", "pc3"}));
  EXPECT_EQ(top_names(shown_hosts(state, {"", "state", false})).front(), "pc1");
  EXPECT_EQ(top_names(shown_programs(state, {"", "reads", false})), (Strings{"mapper", "viewer"}));
  EXPECT_EQ(top_names(shown_programs(state, {"", "pid", true})), (Strings{"mapper", "viewer"}));
  EXPECT_EQ(top_names(shown_programs(state, {"", "program", false})),
            (Strings{"mapper", "viewer"}));
  for (const TopView view : {TopView::streams, TopView::hosts, TopView::programs}) {
    for (const std::string_view key : sort_keys(view)) {  // none loses a row
      EXPECT_EQ(shown_streams(state, {"", std::string(key), false}).streams.size(), 4U);
      EXPECT_EQ(shown_hosts(state, {"", std::string(key), true}).size(), 5U);
      EXPECT_EQ(shown_programs(state, {"", std::string(key), true}).size(), 2U);
    }
  }
}

TEST(TopHeadline, CountsHostsOnceAndHasTheFirstPartsThatFit) {
  const TopState state = example_state();
  EXPECT_EQ(headline(state, true, true, 200),
            "pc1  4 streams: 2 live, 1 stalled  2 of 4 hosts up  clock unknown  01:02:03Z");
  EXPECT_EQ(headline(state, true, true, 54), "pc1  4 streams: 2 live, 1 stalled  2 of 4 hosts up");
  EXPECT_EQ(headline(state, true, true, 40), "pc1  4 streams: 2 live, 1 stalled");
  EXPECT_EQ(headline(state, false, true, 60), "dssmd does not answer; all is of 01:02:03Z  pc1");
}

TEST(TopDisplay, HasAsManyLinesAsTheScreenAndNoneIsWider) {
  for (const TopView view : {TopView::streams, TopView::hosts, TopView::programs}) {
    TopState state = example_state();
    state.streams[1].id.name = "\x1b[2J\n";
    state.hosts[1].name = state.hosts[1].error = "\x1b[2J\n";
    state.programs->at(0).program = "\x1b[2J\n";
    TopDisplay display = display_of(state, view);
    for (const char* keys : {"", "/a_filter_that_is_long", "\n", "\x1b", "\n", "?"}) {
      press_keys(display, keys);
      for (const ScreenSize size : {ScreenSize{24, 80}, ScreenSize{50, 200}, ScreenSize{10, 40},
                                    ScreenSize{3, 12}, ScreenSize{1, 5}}) {
        const Strings lines = screen_texts(display, size);
        EXPECT_EQ(lines.size(), size.rows);
        for (const std::string& line : lines) {
          EXPECT_LE(columns_of(line), size.columns) << line;
          EXPECT_EQ(line, escaped_message(line)) << "nothing that a terminal would follow";
        }
      }
    }
  }
}

TEST(TopDisplay, ShowsHeadlineViewTableAndKeys) {
  TopDisplay display = display_of(example_state());
  const Strings lines = screen_texts(display, {24, 80});
  EXPECT_TRUE(lines[0].starts_with("pc1  4 streams"));
  EXPECT_EQ(lines[1], "[streams]  hosts  programs  by created");
  EXPECT_EQ(lines[2],
            "NAME      HOST  SIZE  CYCLE     RATE      AGE  STATE    WRITERS  READERS  TYPE");
}

TEST(TopDisplay, ShowsThePartOfALongTableThatHasTheSelectedRow) {
  TopState state;
  for (int i = 0; i < 100; ++i) {
    state.streams.push_back(a_stream("s" + std::to_string(i), "pc1", StreamState::live));
  }
  TopDisplay display = display_of(std::move(state));
  const ScreenSize size{14, 80};  // 10 rows of the table
  display.lines(size);
  display.on_key(Key::end);
  EXPECT_EQ(selected_row(display, size), "s99");
  Strings lines = screen_texts(display, size);
  EXPECT_TRUE(lines[3].starts_with("s90 ")) << lines[3];
  EXPECT_TRUE(lines[12].starts_with("s99 ")) << lines[12];
  display.on_key(Key::page_up);
  EXPECT_EQ(selected_row(display, size), "s89");
  lines = screen_texts(display, size);
  EXPECT_TRUE(lines[3].starts_with("s89 ")) << lines[3];
  EXPECT_NE(lines[1].find("row 90 of 100"), std::string::npos) << lines[1];
  display.on_key(Key::home);
  EXPECT_EQ(selected_row(display, size), "s0");
}

TEST(TopDisplay, KeepsTheSelectionWithItsRow) {
  TopState state = example_state();
  TopDisplay display = display_of(state);
  press_keys(display, "jj");
  EXPECT_EQ(selected_row(display), "camera");
  std::reverse(state.streams.begin(), state.streams.end());
  display.set_state(state);
  EXPECT_EQ(selected_row(display), "camera");
  state.streams.erase(state.streams.begin() + 1);  // the camera
  display.set_state(state);
  EXPECT_EQ(selected_row(display), "lidar *") << "the one in its place";
  press_keys(display, "hj");
  EXPECT_EQ(selected_row(display), "pc3");
  press_keys(display, "s");
  EXPECT_EQ(selected_row(display), "lidar *") << "each view has its own";
  press_keys(display, "r");
  EXPECT_EQ(selected_row(display), "odometry") << "the first of another order";
}

TEST(TopDisplay, ShowsDetailsUntilTheRowIsGone) {
  TopState state = example_state();
  TopDisplay display = display_of(state);
  press_keys(display, "jj\n");
  ASSERT_TRUE(display.wanted_details());
  EXPECT_EQ(display.wanted_details()->str(), "camera:0@pc2");
  EXPECT_EQ(screen_texts(display, {})[2], "camera:0@pc2") << "what the list has";
  state.details = state.streams[2];
  state.details->users.push_back({.pid = 3, .program = "driver", .host = "pc2"});
  display.set_state(state);
  const auto has_user = [](const Strings& lines) {
    return std::any_of(lines.begin(), lines.end(),
                       [](const std::string& line) { return line.starts_with("driver"); });
  };
  EXPECT_TRUE(has_user(screen_texts(display, {})));
  EXPECT_FALSE(has_user(screen_texts(display, {10, 40})));
  display.on_key(Key::end);
  EXPECT_TRUE(has_user(screen_texts(display, {10, 40})));
  state.details->users.push_back({.pid = 4, .program = "last", .host = "pc2"});
  display.set_state(state);
  EXPECT_TRUE(screen_texts(display, {10, 40})[8].starts_with("last")) << "still the end";
  display.on_key(Key::up);
  EXPECT_TRUE(screen_texts(display, {10, 40})[8].starts_with("driver"));
  display.on_key(Key::down);
  display.on_key(Key::down);
  display.on_key(Key::down);
  EXPECT_TRUE(screen_texts(display, {10, 40})[8].starts_with("last"));
  display.on_key(Key::up);
  EXPECT_TRUE(screen_texts(display, {10, 40})[8].starts_with("driver"));
  state.details.reset();
  state.streams.erase(state.streams.begin() + 2);
  display.set_state(state);
  EXPECT_EQ(screen_texts(display, {})[2], "camera:0@pc2 is not there any more");
  press_keys(display, "\x1b");
  EXPECT_FALSE(display.wanted_details());

  press_keys(display, "p\n");
  EXPECT_EQ(screen_texts(display, {})[2], "viewer");
  press_keys(display, "\x1bh\n");
  EXPECT_EQ(screen_texts(display, {})[2], "pc1");
}

TEST(TopDisplay, KeepsTheLastStateWithAnError) {
  TopDisplay display = display_of(example_state());
  TopState failed;
  failed.error = "no answer\x1b[31m";
  display.set_state(failed);
  Strings lines = screen_texts(display, {});
  EXPECT_TRUE(lines[0].starts_with("dssmd does not answer")) << lines[0];
  EXPECT_EQ(lines[1], "no answer\\x1b[31m");
  EXPECT_TRUE(lines[3].starts_with("odometry")) << lines[3];
  display.set_state(example_state());
  EXPECT_TRUE(screen_texts(display, {})[0].starts_with("pc1  "));
  display.set_connected(false);
  EXPECT_TRUE(screen_texts(display, {})[0].starts_with("dssmd does not answer"));
}

TEST(TopDisplay, ShowsTheLastProgramsUntilOthersCome) {
  TopState state = example_state();
  state.programs.reset();
  TopDisplay display = display_of(state);
  press_keys(display, "p");
  EXPECT_TRUE(display.wants_programs());
  EXPECT_EQ(screen_texts(display, {})[3], "...");
  display.set_state(example_state());
  EXPECT_NE(screen_texts(display, {})[3].find("viewer"), std::string::npos);
  display.set_state(state);
  EXPECT_NE(screen_texts(display, {})[3].find("viewer"), std::string::npos);
}

TEST(TopDisplay, EndsByQButNotInAFilter) {
  TopDisplay display = display_of(example_state());
  press_keys(display, "/q");
  EXPECT_EQ(screen_texts(display, {}).back(), "/q_  Enter done  Esc undo");
  EXPECT_EQ(screen_texts(display, {})[3], "no streams that fit 'q'");
  press_keys(display, "\n");
  EXPECT_FALSE(display.on_key(Key::q));
}

TEST(TopDisplay, TakesACharacterOfUtf8AsOneInAFilter) {
  TopDisplay display = display_of(example_state());
  press_keys(display, "/a\xc3\xbc");
  EXPECT_EQ(screen_texts(display, {})[3], "no streams that fit 'a\\xc3\\xbc'");
  press_keys(display, "\x7f");
  EXPECT_EQ(screen_texts(display, {}).back(), "/a_  Enter done  Esc undo");
}

TEST(TopDisplay, ShowsWhyTheProgramsOfAHostAreNotKnown) {
  NodeInfo silent;
  silent.host = "pc9";
  silent.error = "has not answered";
  EXPECT_EQ(printed([&](Output& out) {
              program_table({silent, a_program("map", 1, 2)}).print(out);
            }),
            "HOST  PID  PROGRAM  WRITES                       READS\n"
            "pc9     -  -        not known: has not answered  -\n"
            "pc1     1  map      -                            s0, s1\n");
}

}  // namespace
}  // namespace dssm::ctl
