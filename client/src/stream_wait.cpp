// SPDX-License-Identifier: Apache-2.0
#include "client/src/stream_wait.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/base/names.hpp"

namespace dssm::detail {

void StreamWait::failed(Error error, bool is_watched, MonoTime now) {
  const bool is_missing = error.code == Errc::not_found;
  was_missing_ |= is_missing;
  // Only for a missing stream is there an event when it can be opened.
  if (!was_added_) next_attempt_ = is_missing && is_watched ? kNever : now + kRetryPause;
  last_error_ = std::move(error);
  has_failed_ = true;
}

MonoTime StreamWait::next_notice() const noexcept {
  return has_failed_ && !reported_.contains(last_error_.code) ? began_ + kNoticeAfter : kNever;
}

std::string StreamWait::take_notice(MonoTime now, const std::vector<StreamId>& known) {
  reported_.insert(last_error_.code);
  const auto typed = [&](const StreamId& id) {
    return id_.host.empty() ? short_name(id) : short_name(id) + "@" + id.host;
  };
  // What was tried is what the text begins with.
  std::string_view reason = last_error_.message;
  const std::string tried = "open '" + id_.str() + "': ";
  if (reason.starts_with(tried)) reason.remove_prefix(tried.size());
  std::string text =
      fmt::format("has waited {1} s for stream '{0}': {2}", typed(id_),
                  std::chrono::duration_cast<std::chrono::seconds>(now - began_).count(), reason);
  if (last_error_.code != Errc::not_found) return text;
  std::vector<std::string> names;
  names.reserve(known.size());
  for (const StreamId& id : known) names.push_back(typed(id));
  std::vector<std::string> full;
  for (const std::string& name : similar_names(typed(id_), std::move(names))) {
    for (const StreamId& id : known) {
      if (typed(id) == name) full.push_back(short_name(id) + "@" + id.host);
    }
  }
  if (!full.empty()) text += fmt::format("; similar names: '{}'", fmt::join(full, "', '"));
  return text;
}

}  // namespace dssm::detail
