// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/top_display.hpp"

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>
#include <array>
#include <ctime>
#include <map>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/nodes.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

constexpr std::size_t kViews = 3;
// Lines around the rows of a table: headline, view, header, keys.
constexpr std::size_t kAroundTable = 4, kAroundText = 3;

constexpr std::string_view kHelpText =
    "Tab           the next view          s h p or 1 2 3  streams, hosts, programs\n"
    "Up Down, k j  select a row           PgUp PgDn Home End  as everywhere\n"
    "Enter         details of the row     Esc             back\n"
    "/             filter: part of a name, or a shell pattern such as lidar*\n"
    "S, > or <     sort by the next key, the one before\n"
    "r             reverse the order      Space           hold, and continue\n"
    "q, Ctrl-C     quit                   Ctrl-L          draw again\n";

// The first of `parts` that fit in one line.
std::string first_that_fit(const std::vector<std::string>& parts, std::size_t columns) {
  constexpr std::string_view kGap = "  ";
  std::string line;
  for (const std::string& part : parts) {
    if (part.empty()) continue;
    const std::size_t width = columns_of(line) + kGap.size() + columns_of(part);
    if (!line.empty() && width > columns) break;
    line.append(line.empty() ? "" : kGap).append(part);
  }
  return shortened(line, columns);
}

std::string time_of_day(Time time, bool iso) {
  const std::time_t seconds = to_ns(time) / 1'000'000'000;
  std::tm parts{};
  if (iso) {
    ::gmtime_r(&seconds, &parts);
  } else {
    ::localtime_r(&seconds, &parts);
  }
  return fmt::format("{:%H:%M:%S}{}", parts, iso ? "Z" : "");
}

bool is_pattern(const std::string& filter) {
  return filter.find_first_of("*?[") != std::string::npos;
}

bool passes(const std::string& filter, const std::string& name) {
  if (is_pattern(filter)) return ::fnmatch(filter.c_str(), name.c_str(), 0) == 0;
  return name.find(filter) != std::string::npos;
}

bool passes(const std::string& filter, const StreamId& id) {
  if (is_pattern(filter)) return StreamFilter({}, {filter}).takes(id);
  return passes(filter, id.str());
}

bool passes(const std::string& filter, const HostInfo& host) {
  return passes(filter, host.name) ||
         std::any_of(host.addresses.begin(), host.addresses.end(),
                     [&](const std::string& address) { return passes(filter, address); });
}

bool passes(const std::string& filter, const NodeInfo& program) {
  return passes(filter, program.program) || passes(filter, program.program + "@" + program.host);
}

std::ptrdiff_t uses(const NodeInfo& program, Role role) {
  return std::count_if(program.streams.begin(), program.streams.end(),
                       [role](const NodeStream& use) { return use.role == role; });
}

std::string used_names(const NodeInfo& program, Role role) {
  std::vector<std::string> names;
  for (const NodeStream& use : program.streams) {
    if (use.role == role) names.push_back(stream_name_on(program.host, use.stream));
  }
  return or_dash(list_text(names));
}

std::string pid_text(const NodeInfo& program) {
  return program.pid > 0 ? std::to_string(program.pid) : "-";
}

// What tells the rows of a table apart.
std::string identity(const StreamInfo& stream) { return stream.id.str(); }
std::string identity(const HostInfo& host) {
  return fmt::format("{} {}", host.name, fmt::join(host.addresses, " "));
}
std::string identity(const NodeInfo& program) {
  return fmt::format("{} {} {}", program.host, program.pid, program.program);
}

template <class Item>
std::vector<std::string> identities(const std::vector<Item>& items) {
  std::vector<std::string> all(items.size());
  std::ranges::transform(items, all.begin(), [](const Item& item) { return identity(item); });
  return all;
}

template <class Item>
const Item* find_identity(const std::vector<Item>& items, const std::string& wanted) {
  const auto found = std::find_if(items.begin(), items.end(),
                                  [&](const Item& item) { return identity(item) == wanted; });
  return found == items.end() ? nullptr : &*found;
}

void add_fact(Output& out, std::string_view key, const std::string& value) {
  out.add(fmt::format("{:<13} {}\n", std::string(key) + ":", or_dash(value)));
}

void print_host_details(const HostInfo& host, Output& out) {
  out.add(or_dash(escaped(host.name)) + "\n");
  add_fact(out, "state", fmt::format("{} for {}", name_of(host.state), duration_text(host.since)));
  if (!host.error.empty()) add_fact(out, "note", escaped_message(host.error));
  add_fact(out, "addresses", list_text(host.addresses));
  add_fact(out, "found by", list_text(host.found_by));
  add_fact(out, "version", escaped(host.version));
  add_fact(out, "id", escaped(host.id));
  if (host.round_trip > Duration::zero()) {
    add_fact(out, "round trip",
             fmt::format("{}, at least {}", duration_text(host.round_trip),
                         duration_text(host.min_round_trip)));
  }
  if (host.carried_bytes_per_s > 0) {
    add_fact(
        out, "network",
        "carries " + byte_rate_text(static_cast<double>(host.carried_bytes_per_s)) + " from there");
  }
  add_fact(out, "encrypted", host.insecure ? "no" : "yes, or this PC");
  add_fact(out, "streams", std::to_string(host.streams));
  if (host.clock) {
    add_fact(out, "clock",
             fmt::format("{}, bound {}", status_text(*host.clock), bound_text(host.clock_bound())));
    add_fact(out, "follows", escaped(host.clock_reference));
    add_fact(out, "from here", "at most " + bound_text(host.clock_distance));
  }
  if (!host.clock_reason.empty()) add_fact(out, "samples", escaped_message(host.clock_reason));
}

void print_program_details(const NodeInfo& program, Output& out) {
  out.add(or_dash(escaped(program.program)) + "\n");
  add_fact(out, "host", escaped(program.host));
  add_fact(out, "pid", pid_text(program));
  add_fact(out, "uid", program.uid ? std::to_string(*program.uid) : "");
  if (!program.error.empty()) add_fact(out, "not known", escaped_message(program.error));
  if (program.streams.empty()) return;
  Table table({{"STREAM"}, {"ROLE"}, {"VIA"}});
  for (const NodeStream& use : program.streams) {
    table.add_row({escaped(stream_name_on(program.host, use.stream)),
                   std::string(role_name(use.role)), std::string(name_of(use.via))});
  }
  out.add("\n");
  table.print(out);
}

template <class Item, class Print>
std::string text_of(const Item* item, const std::string& identity, Print print) {
  if (!item) return fmt::format("{} is not there any more\n", escaped(identity));
  Output out(-1);  // only to gather what is printed
  print(*item, out);
  return out.take();
}

}  // namespace

std::span<const std::string_view> sort_keys(TopView view) {
  static constexpr std::array<std::string_view, 6> kHostKeys = {"found", "host",    "state",
                                                                "rtt",   "streams", "clock"};
  static constexpr std::array<std::string_view, 5> kProgramKeys = {"host", "pid", "program",
                                                                   "writes", "reads"};
  if (view == TopView::hosts) return kHostKeys;
  if (view == TopView::programs) return kProgramKeys;
  return stream_sort_keys();
}

std::string_view view_name(TopView view) {
  return view == TopView::streams ? "streams" : view == TopView::hosts ? "hosts" : "programs";
}

StreamListing shown_streams(const TopState& state, const TopOrder& order) {
  StreamListing listing;
  listing.duplicates.emplace(state.streams);
  for (const StreamInfo& stream : state.streams) {
    if (passes(order.filter, stream.id)) listing.streams.push_back(stream);
  }
  sort_streams(listing.streams, order.sort);
  if (order.reverse) std::reverse(listing.streams.begin(), listing.streams.end());
  return listing;
}

std::vector<HostInfo> shown_hosts(const TopState& state, const TopOrder& order) {
  std::vector<HostInfo> hosts;
  for (const HostInfo& host : state.hosts) {
    if (passes(order.filter, host)) hosts.push_back(host);
  }
  if (order.sort == "host") sort_by(hosts, [](const auto& h) { return h.name; });
  if (order.sort == "state") sort_by(hosts, [](const auto& h) { return h.state; });
  if (order.sort == "rtt") {
    sort_by(hosts, [](const auto& h) {
      return std::pair(h.round_trip == Duration::zero(), h.round_trip);
    });
  }
  if (order.sort == "streams") sort_by(hosts, [](const auto& h) { return h.streams; });
  if (order.sort == "clock") sort_by(hosts, [](const auto& h) { return h.clock_bound(); });
  if (order.reverse) std::reverse(hosts.begin(), hosts.end());
  return hosts;
}

std::vector<NodeInfo> shown_programs(const TopState& state, const TopOrder& order) {
  std::vector<NodeInfo> programs;
  if (!state.programs) return programs;
  for (const NodeInfo& program : *state.programs) {
    if (passes(order.filter, program)) programs.push_back(program);
  }
  if (order.sort == "pid") sort_by(programs, [](const auto& p) { return p.pid; });
  if (order.sort == "program") sort_by(programs, [](const auto& p) { return p.program; });
  if (order.sort == "writes") {
    sort_by(programs, [](const auto& p) { return uses(p, Role::writer); });
  }
  if (order.sort == "reads") {
    sort_by(programs, [](const auto& p) { return uses(p, Role::reader); });
  }
  if (order.reverse) std::reverse(programs.begin(), programs.end());
  return programs;
}

Table host_table(const std::vector<HostInfo>& hosts) {
  std::vector<Table::Column> columns = host_columns();
  columns.back().fit = Table::Column::Fit::cut;
  Table table(std::move(columns));
  for (const HostInfo& host : hosts) table.add_row(host_row(host));
  return table;
}

Table program_table(const std::vector<NodeInfo>& programs) {
  constexpr auto kLeft = Table::Align::left;
  constexpr auto kCut = Table::Column::Fit::cut;
  Table table({{"HOST"},
               {"PID", Table::Align::right},
               {"PROGRAM"},
               {"WRITES", kLeft, 0, kCut},
               {"READS", kLeft, 0, kCut}});
  for (const NodeInfo& program : programs) {
    const bool is_known = program.error.empty();
    table.add_row({escaped(program.host), pid_text(program), or_dash(escaped(program.program)),
                   is_known ? used_names(program, Role::writer)
                            : "not known: " + escaped_message(program.error),
                   is_known ? used_names(program, Role::reader) : "-"});
  }
  return table;
}

std::string headline(const TopState& state, bool is_connected, bool iso, std::size_t columns) {
  std::vector<std::string> parts;
  const std::string time = time_of_day(state.time, iso);
  const bool is_present = is_connected && state.error.empty();
  if (!is_present) parts.push_back(fmt::format("dssmd does not answer; all is of {}", time));
  if (!state.hosts.empty()) parts.push_back(escaped(state.hosts.front().name));

  const std::vector<StreamInfo>& streams = state.streams;
  const auto live = std::count_if(streams.begin(), streams.end(), [](const StreamInfo& stream) {
    return stream.state == StreamState::live;
  });
  const auto stalled = std::count_if(streams.begin(), streams.end(), is_silent);
  parts.push_back(fmt::format("{}: {} live, {} stalled",
                              counted(streams.size(), "stream", "streams"), live, stalled));

  // A host has a row for each address; one that has never answered has no name yet.
  std::map<std::string, bool> hosts;
  std::size_t unnamed = 0;
  for (const HostInfo& host : state.hosts) {
    const bool up = is_up(host.state);
    if (host.name.empty()) {
      ++unnamed;
    } else {
      hosts[host.name] |= up;
    }
  }
  const auto up = std::count_if(hosts.begin(), hosts.end(), [](const auto& e) { return e.second; });
  parts.push_back(fmt::format("{} of {} up", up, counted(hosts.size() + unnamed, "host", "hosts")));
  if (!state.hosts.empty()) {
    parts.push_back("clock " + bound_text(state.hosts.front().clock_bound()));
  }
  if (is_present) parts.push_back(time);
  return first_that_fit(parts, columns);
}

TopDisplay::TopDisplay(const TopOptions& options) : iso_(options.iso), view_(options.view) {
  now().order = {options.pattern, options.sort, options.reverse};
}

void TopDisplay::set_state(TopState state) {
  if (is_held_) {
    if (!state_.programs) state_.programs = std::move(state.programs);
    const bool is_new =
        state.details && (!state_.details || state_.details->id != state.details->id);
    if (is_new) state_.details = std::move(state.details);
  } else if (state.error.empty()) {
    // Until others come, the last ones are shown.
    if (!state.programs) state.programs = std::move(state_.programs);
    state_ = std::move(state);
  } else {
    state_.error = std::move(state.error);
  }
  shown_.reset();
}

std::optional<StreamId> TopDisplay::wanted_details() const {
  if (mode_ != Mode::details || view_ != TopView::streams) return std::nullopt;
  const StreamInfo* stream = find_identity(state_.streams, detailed_);
  return stream ? std::optional(stream->id) : std::nullopt;
}

// --- keys

bool TopDisplay::on_key(Key key) {
  if (mode_ == Mode::filter) return on_filter_key(key), true;
  if (key == Key::q) return false;
  if (mode_ == Mode::help) {
    mode_ = before_help_;
  } else if (key == Key('?')) {
    before_help_ = mode_;
    mode_ = Mode::help;
  } else if (key == Key::space) {
    is_held_ = !is_held_;
  } else if (mode_ == Mode::details) {
    on_details_key(key);
  } else {
    on_table_key(key);
  }
  return true;
}

void TopDisplay::on_table_key(Key key) {
  const auto page = static_cast<std::ptrdiff_t>(page_);
  switch (static_cast<int>(key)) {
    case '1':
    case 's':
      return switch_to(TopView::streams);
    case '2':
    case 'h':
      return switch_to(TopView::hosts);
    case '3':
    case 'p':
      return switch_to(TopView::programs);
    case static_cast<int>(Key::tab):
      return switch_to(static_cast<TopView>((static_cast<std::size_t>(view_) + 1) % kViews));
    case 'k':
    case static_cast<int>(Key::up):
      return move(-1);
    case 'j':
    case static_cast<int>(Key::down):
      return move(1);
    case static_cast<int>(Key::page_up):
      return move(-page);
    case static_cast<int>(Key::page_down):
      return move(page);
    case static_cast<int>(Key::home):
      now().selected.clear();
      now().row = 0;
      return;
    case static_cast<int>(Key::end):
      return move(PTRDIFF_MAX);
    case '>':
    case 'S':
      return cycle_sort(1);
    case '<':
      return cycle_sort(-1);
    case 'r':
      now().order.reverse = !now().order.reverse;
      return change_order();
    case '/':
      filter_before_ = now().order.filter;
      mode_ = Mode::filter;
      return;
    case static_cast<int>(Key::escape):
      now().order.filter.clear();
      return change_order();
    case static_cast<int>(Key::enter):
      return open_details();
    default:
      return;
  }
}

void TopDisplay::on_details_key(Key key) {
  const std::size_t first = std::min(first_line_, last_first_line_);
  const auto back_by = [&](std::size_t lines) { first_line_ = first - std::min(first, lines); };
  switch (static_cast<int>(key)) {
    case 'k':
    case static_cast<int>(Key::up):
      return back_by(1);
    case 'j':
    case static_cast<int>(Key::down):
      first_line_ = first + 1;
      return;
    case static_cast<int>(Key::page_up):
      return back_by(page_);
    case static_cast<int>(Key::page_down):
      first_line_ = first + page_;
      return;
    case static_cast<int>(Key::home):
      first_line_ = 0;
      return;
    case static_cast<int>(Key::end):
      first_line_ = SIZE_MAX;
      return;
    case static_cast<int>(Key::escape):
    case static_cast<int>(Key::enter):
      mode_ = Mode::table;
      return;
    default:
      return;
  }
}

void TopDisplay::on_filter_key(Key key) {
  constexpr std::size_t kMaxBytes = 200;
  std::string& filter = now().order.filter;
  const auto byte = static_cast<unsigned>(key);
  if (key == Key::enter) {
    mode_ = Mode::table;
  } else if (key == Key::escape) {
    filter = filter_before_;
    mode_ = Mode::table;
  } else if (key == Key::backspace) {
    // All bytes of a character of UTF-8.
    while (!filter.empty() && (static_cast<unsigned char>(filter.back()) & 0xc0U) == 0x80) {
      filter.pop_back();
    }
    if (!filter.empty()) filter.pop_back();
  } else if (byte >= 0x20 && byte <= 0xff && filter.size() < kMaxBytes) {
    filter += static_cast<char>(byte);
  }
  change_order();
}

void TopDisplay::switch_to(TopView view) {
  view_ = view;
  shown_.reset();
}

// What is first then is what a person wants to see.
void TopDisplay::change_order() {
  now().selected.clear();
  now().row = now().first = 0;
  shown_.reset();
}

std::string_view TopDisplay::sort_key() const {
  return now().order.sort.empty() ? sort_keys(view_).front() : std::string_view(now().order.sort);
}

void TopDisplay::cycle_sort(int by) {
  const auto keys = sort_keys(view_);
  const auto at =
      static_cast<std::size_t>(std::find(keys.begin(), keys.end(), sort_key()) - keys.begin());
  now().order.sort = keys[(at + keys.size() + static_cast<std::size_t>(by)) % keys.size()];
  change_order();
}

void TopDisplay::move(std::ptrdiff_t by) {
  if (!shown_ || shown_->ids.empty()) return;
  const auto last = static_cast<std::ptrdiff_t>(shown_->ids.size()) - 1;
  const auto row = std::min(static_cast<std::ptrdiff_t>(now().row), last);
  now().row = static_cast<std::size_t>(by > last - row ? last : std::max(row + by, {}));
  now().selected = shown_->ids[now().row];
}

void TopDisplay::open_details() {
  if (!shown_ || now().row >= shown_->ids.size()) return;
  detailed_ = now().selected = shown_->ids[now().row];
  first_line_ = 0;
  mode_ = Mode::details;
}

// --- lines

TopDisplay::Shown TopDisplay::make_shown(std::size_t columns) const {
  const TopOrder& order = now().order;
  if (view_ == TopView::hosts) {
    const std::vector<HostInfo> hosts = shown_hosts(state_, order);
    return {host_table(hosts), identities(hosts), columns};
  }
  if (view_ == TopView::programs) {
    const std::vector<NodeInfo> programs = shown_programs(state_, order);
    return {program_table(programs), identities(programs), columns};
  }
  const StreamListing listing = shown_streams(state_, order);
  return {stream_table(listing, columns), identities(listing.streams), columns};
}

std::string TopDisplay::details_text() const {
  if (view_ == TopView::hosts) {
    return text_of(find_identity(state_.hosts, detailed_), detailed_, print_host_details);
  }
  if (view_ == TopView::programs) {
    const NodeInfo* program =
        state_.programs ? find_identity(*state_.programs, detailed_) : nullptr;
    return text_of(program, detailed_, print_program_details);
  }
  // Until the details come, what the list has of it.
  const bool has_details = state_.details && identity(*state_.details) == detailed_;
  const StreamInfo* stream =
      has_details ? &*state_.details : find_identity(state_.streams, detailed_);
  return text_of(stream, detailed_,
                 [this](const StreamInfo& info, Output& out) { print_stream(info, iso_, out); });
}

std::string TopDisplay::view_line(std::size_t columns) const {
  if (!state_.error.empty()) return shortened(escaped_message(state_.error), columns);
  std::vector<std::string> parts;
  const TopOrder& order = now().order;
  for (const TopView view : {TopView::streams, TopView::hosts, TopView::programs}) {
    const bool is_shown = view == view_;
    parts.push_back(
        fmt::format("{}{}{}", is_shown ? "[" : "", view_name(view), is_shown ? "]" : ""));
  }
  if (is_held_) parts.emplace_back("held");
  if (!order.filter.empty()) parts.push_back(fmt::format("filter {}", escaped(order.filter)));
  parts.push_back(fmt::format("by {}{}", sort_key(), order.reverse ? ", reversed" : ""));
  if (shown_ && now().first + page_ < shown_->ids.size()) {
    parts.push_back(fmt::format("row {} of {}", now().row + 1, shown_->ids.size()));
  }
  return first_that_fit(parts, columns);
}

std::string TopDisplay::bottom_line(std::size_t columns) const {
  switch (mode_) {
    case Mode::filter: {
      std::string text = fmt::format("/{}_", escaped(now().order.filter));
      // Its end is what is being typed. Characters of UTF-8 go with all their bytes.
      while (columns_of(text) > columns) {
        do {
          text.erase(0, 1);
        } while ((static_cast<unsigned char>(text.front()) & 0xc0U) == 0x80);
      }
      return first_that_fit({text, "Enter done", "Esc undo"}, columns);
    }
    case Mode::details:
      return first_that_fit({"q quit", "Esc back", "? help", "Up Down scroll", "Space hold"},
                            columns);
    case Mode::help:
      return first_that_fit({"q quit", "any other key: back"}, columns);
    case Mode::table:
      break;
  }
  return first_that_fit({"q quit", "? help", "Tab view", "Enter details", "/ filter", "S sort",
                         "r reverse", "Space hold"},
                        columns);
}

void TopDisplay::add_table(std::vector<ScreenLine>& lines, ScreenSize size) {
  page_ = size.rows > kAroundTable ? size.rows - kAroundTable : 1;
  ViewState& state = now();
  const std::vector<std::string>& ids = shown_->ids;
  // The row that was selected may be elsewhere; when it is gone, another one is in its place.
  if (!state.selected.empty()) {
    const auto found = std::find(ids.begin(), ids.end(), state.selected);
    if (found != ids.end()) state.row = static_cast<std::size_t>(found - ids.begin());
  }
  state.row = std::min(state.row, ids.empty() ? 0 : ids.size() - 1);
  if (state.row < state.first) state.first = state.row;
  if (state.row >= state.first + page_) state.first = state.row - page_ + 1;
  state.first = std::min(state.first, ids.size() > page_ ? ids.size() - page_ : 0);

  using Style = ScreenLine::Style;
  std::vector<std::string> rows = shown_->table.lines(size.columns, state.first, page_);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const bool is_selected = i > 0 && state.first + i - 1 == state.row;
    lines.push_back({std::move(rows[i]), i == 0        ? Style::title
                                         : is_selected ? Style::selected
                                                       : Style::plain});
  }
  if (ids.empty()) {
    const std::string& filter = state.order.filter;
    const bool is_read = view_ != TopView::programs || state_.programs;
    lines.push_back({!is_read ? "..."
                     : filter.empty()
                         ? fmt::format("no {}", view_name(view_))
                         : fmt::format("no {} that fit '{}'", view_name(view_), escaped(filter))});
  }
}

void TopDisplay::add_text(std::vector<ScreenLine>& lines, const std::string& text,
                          ScreenSize size) {
  page_ = size.rows > kAroundText ? size.rows - kAroundText : 1;
  std::vector<std::string_view> all;
  for (std::size_t at = 0; at < text.size();) {
    const std::size_t end = std::min(text.find('\n', at), text.size());
    all.push_back(std::string_view(text).substr(at, end - at));
    at = end + 1;
  }
  last_first_line_ = all.size() > page_ ? all.size() - page_ : 0;
  const std::size_t first = std::min(first_line_, last_first_line_);
  for (std::size_t i = first; i < all.size() && i < first + page_; ++i) {
    lines.push_back({shortened(all[i], size.columns)});
  }
}

std::vector<ScreenLine> TopDisplay::lines(ScreenSize size) {
  if (!shown_ || shown_->columns != size.columns) shown_ = make_shown(size.columns);
  std::vector<ScreenLine> body;
  if (mode_ == Mode::details) {
    add_text(body, details_text(), size);
  } else if (mode_ == Mode::help) {
    add_text(body, std::string(kHelpText), size);
  } else {
    add_table(body, size);
  }
  std::vector<ScreenLine> lines;
  lines.push_back({headline(state_, is_connected_, iso_, size.columns), ScreenLine::Style::title});
  lines.push_back({view_line(size.columns)});
  for (ScreenLine& line : body) lines.push_back(std::move(line));
  lines.resize(std::max<std::size_t>(size.rows, 1) - 1);
  lines.push_back({bottom_line(size.columns)});
  for (ScreenLine& line : lines) line.text = shortened(line.text, size.columns);
  return lines;
}

}  // namespace dssm::ctl
