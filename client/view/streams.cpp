// SPDX-License-Identifier: Apache-2.0
#include "client/view/streams.hpp"

#include <memory>
#include <utility>

#include "client/dssmctl/fields.hpp"
#include "core/base/try.hpp"

namespace dssm::view {

OpenStream::OpenStream(StreamReader opened) : reader(std::move(opened)) { follow_restart(); }

const TypeInfo& OpenStream::type() const {
  return std::visit([](const auto& any) -> const TypeInfo& { return any.type(); }, reader);
}

void OpenStream::follow_restart() { fields = ctl::readable_fields_untrusted(type()); }

Streams::Found Streams::find(const std::string& name) {
  if (!entries_.contains(name)) {
    const Result<StreamId> id = StreamId::parse(name);
    if (!id) return {nullptr, id.error().message};
    if (entries_.size() >= kMaxStreams) {
      return {nullptr, "too many streams are open here; try again in half a minute"};
    }
  }
  Entry& entry = entries_[name];
  const MonoTime now = MonoClock::now();
  entry.used = now;
  if (entry.stream) {
    const auto* const live = std::get_if<RawReader>(&entry.stream->reader);
    const std::optional<Error> error = live ? live->restart_error() : std::nullopt;
    if (!error) return {&*entry.stream, {}};
    entry.error = error->message;  // it cannot go on
    entry.stream.reset();
  }
  if (!entry.is_opening && now >= entry.retry_at) open(name);
  return {nullptr, entry.error};
}

void Streams::open(const std::string& name) {
  Entry& entry = entries_[name];
  entry.is_opening = true;
  entry.retry_at = deadline_in(kRetryPeriod);
  const auto result = std::make_shared<Result<StreamReader>>(Error{Errc::unavailable, {}});
  worker_.add([this, name, result] {
    // find() has parsed the name.
    const auto open_in = [&](auto& source) -> Result<StreamReader> {
      return StreamReader(DSSM_TRY(source.open_raw_reader(*StreamId::parse(name))));
    };
    *result = std::visit(open_in, source_);
    server_.post([this, name, result] {
      Entry& opened = entries_[name];
      opened.is_opening = false;
      if (*result) {
        opened.error.clear();
        opened.stream.emplace(*std::move(*result));
      } else {
        opened.error = result->error().message;
      }
    });
  });
}

void Streams::close_unused() {
  const MonoTime now = MonoClock::now();
  std::erase_if(entries_, [&](const auto& named) {
    return !named.second.is_opening && now - named.second.used > kUnusedTime;
  });
}

}  // namespace dssm::view
