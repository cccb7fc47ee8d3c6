// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/open_stream.hpp"

#include <algorithm>
#include <utility>

#include "client/dssmctl/stop_signal.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// libdssm waits for a stream without heeding signals: look up this often.
constexpr Duration kLookUp = std::chrono::milliseconds(100);

// Longer names than the format allows are not worth comparing.
constexpr std::size_t kMaxCompared = 2 * kMaxFullNameBytes;

// Levenshtein's distance: single characters to insert, delete or replace.
std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 0; i < a.size(); ++i) {
    std::size_t diagonal = std::exchange(row[0], i + 1);
    for (std::size_t j = 0; j < b.size(); ++j) {
      const std::size_t replaced = diagonal + (a[i] == b[j] ? 0 : 1);
      diagonal = std::exchange(row[j + 1], std::min({replaced, row[j] + 1, row[j + 1] + 1}));
    }
  }
  return row[b.size()];
}

}  // namespace

Result<Session> connect(const Options& options) {
  SessionOptions session_options;
  session_options.socket_path = options.socket_path;
  session_options.program = "dssmctl " + options.verb_name;
  return Session::connect(std::move(session_options));
}

Result<std::optional<OpenedStream>> open_stream(Session& session, const Options& options) {
  Result<StreamId> id = StreamId::parse(options.stream);
  if (!id) return std::move(id).error();
  Result<RawReader> reader = session.open_raw_reader(*id);
  if (reader) return std::optional(OpenedStream{std::move(*reader), false});

  const MonoTime deadline = deadline_in(options.wait);
  while (reader.error().code == Errc::not_found && MonoClock::now() < deadline) {
    if (stop_requested()) return std::optional<OpenedStream>();
    reader = session.await_raw_reader(*id, std::min(deadline, deadline_in(kLookUp)));
    if (reader) return std::optional(OpenedStream{std::move(*reader), true});
  }
  Error error = with_similar_names(std::move(reader).error(), session, *id);
  if (error.code == Errc::not_found && options.wait == Duration::zero()) {
    error.message += "; --wait SECONDS waits for it";
  }
  return error;
}

Error with_similar_names(Error error, Session& session, const StreamId& wanted) {
  if (error.code != Errc::not_found) return error;
  const Result<std::vector<StreamInfo>> streams = session.list();
  if (!streams) return error;  // the first failure is the one to tell
  if (streams->empty()) {
    error.message += "; there are no streams at all";
    return error;
  }
  std::vector<std::string> names;
  for (const StreamInfo& stream : *streams) {
    // It is there: something of it was not found.
    if (stream.id.name == wanted.name && stream.id.id == wanted.id) return error;
    names.push_back(short_name(stream.id));
  }
  const std::vector<std::string> similar = similar_names(short_name(wanted), std::move(names));
  for (const std::string& name : similar) {
    error.message += (&name == &similar.front() ? "; is it '" : "' or '") + escaped(name);
  }
  if (!similar.empty()) error.message += "'?";
  return error;
}

std::vector<std::string> similar_names(std::string_view wanted, std::vector<std::string> names) {
  constexpr std::size_t kMost = 3;
  if (wanted.size() > kMaxCompared) return {};
  std::vector<std::pair<std::size_t, std::string>> ranked;
  for (std::string& name : names) {
    const bool contains = wanted.size() >= 3 && (name.find(wanted) != std::string::npos ||
                                                 wanted.find(name) != std::string_view::npos);
    const std::size_t distance = edit_distance(wanted, name);
    if (contains || distance <= std::max<std::size_t>(1, wanted.size() / 3)) {
      ranked.emplace_back(distance, std::move(name));
    }
  }
  std::sort(ranked.begin(), ranked.end());
  if (ranked.size() > kMost) ranked.resize(kMost);
  std::vector<std::string> best;
  for (auto& [distance, name] : ranked) best.push_back(std::move(name));
  return best;
}

std::string short_name(const StreamId& id) {
  return id.id == 0 ? id.name : id.name + ":" + std::to_string(id.id);
}

}  // namespace dssm::ctl
