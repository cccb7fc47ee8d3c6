// SPDX-License-Identifier: Apache-2.0
//
// What `dssmctl top` shows and how it follows keys, without the terminal: it gets what dssmd states
// and keys, and gives the lines to draw.
#pragma once

#include <dssm/session.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/keyboard.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/screen.hpp"
#include "client/dssmctl/stream_list.hpp"

namespace dssm::ctl {

// What dssmd states at one moment.
struct TopState {
  Time time{};
  std::vector<HostInfo> hosts;  // this PC first
  std::vector<StreamInfo> streams;
  std::optional<std::vector<NodeInfo>> programs;  // none: they were not asked for
  std::optional<StreamInfo> details;              // of the stream that is wanted
  std::string error;  // why dssmd did not answer, for people; empty: it did
};

// The keys to sort a view by; the first one is the order in which dssmd lists it.
std::span<const std::string_view> sort_keys(TopView view);

std::string_view view_name(TopView view);

// What the table of a view shows, in which order.
struct TopOrder {
  std::string filter;  // a shell pattern (with *, ? or [), or a part of the name; empty: all
  std::string sort;    // a key of the view; empty: the first one
  bool reverse = false;
};

// What of `state` is shown, in that order; streams with their marks.
StreamListing shown_streams(const TopState& state, const TopOrder& order);
std::vector<HostInfo> shown_hosts(const TopState& state, const TopOrder& order);
std::vector<NodeInfo> shown_programs(const TopState& state, const TopOrder& order);

// One line for each host or process, whatever is known of it.
Table host_table(const std::vector<HostInfo>& hosts);
Table program_table(const std::vector<NodeInfo>& programs);

// "pc1", "12 streams: 10 live, 1 stalled", "2 of 3 hosts up", "clock 1.20 ms", the time; first that
// dssmd does not answer, if so. The first parts that fit in so many columns.
//   iso  the time in UTC, not of the local time zone
std::string headline(const TopState& state, bool is_connected, bool iso, std::size_t columns);

class TopDisplay {
 public:
  // The options' pattern and order are those of its view.
  explicit TopDisplay(const TopOptions& options);

  // What dssmd states now; with an error the last state stays, but for that. While the display is
  // held, only what it does not have yet is taken over: programs, and the details of a stream.
  void set_state(TopState state);
  void set_connected(bool is_connected) { is_connected_ = is_connected; }

  // False: the program is to end.
  bool on_key(Key key);

  // As many lines as the screen has rows, none wider than it.
  std::vector<ScreenLine> lines(ScreenSize size);

  // What the next state is to have, and whether there is to be one.
  bool wants_programs() const { return view_ == TopView::programs; }
  std::optional<StreamId> wanted_details() const;
  bool is_held() const { return is_held_; }

 private:
  enum class Mode : unsigned char { table, details, filter, help };

  // Each view has its own.
  struct ViewState {
    TopOrder order;
    std::string selected;   // identity of the row; empty: the first one, whatever it is
    std::size_t row = 0;    // where that was last
    std::size_t first = 0;  // row that is shown at the top
  };

  // The table that is shown, of all rows; made when something has changed.
  struct Shown {
    Table table;
    std::vector<std::string> ids;  // identities of the rows
    std::size_t columns;           // that it is made for
  };

  ViewState& now() { return views_[static_cast<std::size_t>(view_)]; }
  const ViewState& now() const { return views_[static_cast<std::size_t>(view_)]; }
  std::string_view sort_key() const;
  Shown make_shown(std::size_t columns) const;
  void switch_to(TopView view);
  void change_order();
  void cycle_sort(int by);
  void move(std::ptrdiff_t by);
  void on_table_key(Key key);
  void on_details_key(Key key);
  void on_filter_key(Key key);
  void open_details();
  std::string details_text() const;
  std::string view_line(std::size_t columns) const;
  std::string bottom_line(std::size_t columns) const;
  void add_table(std::vector<ScreenLine>& lines, ScreenSize size);
  void add_text(std::vector<ScreenLine>& lines, const std::string& text, ScreenSize size);

  bool iso_;
  TopState state_;
  bool is_connected_ = true;
  bool is_held_ = false;
  TopView view_;
  ViewState views_[3];
  Mode mode_ = Mode::table;
  Mode before_help_ = Mode::table;
  std::string filter_before_;  // while one is typed
  std::string detailed_;       // identity of the row whose details are shown
  // Of details: the line that is wanted at the top, beyond the last one that can be there for the
  // end, also of a text that grows.
  std::size_t first_line_ = 0, last_first_line_ = 0;
  std::size_t page_ = 1;        // rows of the table or of details that are seen
  std::optional<Shown> shown_;  // none: to be made
};

}  // namespace dssm::ctl
