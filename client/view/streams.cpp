// SPDX-License-Identifier: Apache-2.0
#include "client/view/streams.hpp"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <memory>
#include <utility>

#include "client/dssmctl/describe_stream.hpp"
#include "client/dssmctl/fields.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

// The programs that have it open, apart from this one, as a key to see whether they change.
std::string users_of(const StreamInfo& stream) {
  std::string users;
  for (const StreamUser& user : stream.users) {
    if (user.pid == ::getpid()) continue;
    users += fmt::format("{} {} {} {}\n", user.host, user.pid, int(user.role), user.program);
  }
  return users;
}

Result<std::vector<std::byte>> recorded_property(const Recording& recording, const StreamId& id,
                                                 std::optional<Time> t) {
  std::optional<std::size_t> stream, index;
  for (std::size_t i = 0; i < recording.streams().size(); ++i) {
    const RecordedStreamInfo& one = recording.streams()[i];
    const bool is_later = stream && t && one.samples > 0 && one.first_time > *t;  // an incarnation
    if (one.id != id || is_later) continue;
    stream = i;
    index.reset();
    if (!one.property_times.empty()) {
      index = t ? one.property_at(*t) : one.property_times.size() - 1;
    }
  }
  if (index) {
    std::vector<std::byte> property = DSSM_TRY(recording.property(*stream, *index));
    if (!property.empty()) return property;
  }
  return Error{Errc::not_found, fmt::format("'{}' has no property then", id.str())};
}

}  // namespace

OpenStream::OpenStream(StreamReader opened) : reader(std::move(opened)) { follow_restart(); }

bool OpenStream::is_undescribed() const {
  return std::holds_alternative<RawReader>(reader) && type().fields.empty();
}

const TypeInfo& OpenStream::type() const {
  return std::visit([](const auto& any) -> const TypeInfo& { return any.type(); }, reader);
}

void OpenStream::follow_restart() {
  fields = ctl::readable_fields_untrusted(ctl::type_to_show(type(), obvious));
}

std::optional<Time> oldest_time(const RawReader& reader) {
  constexpr int kMaxTries = 64;
  Tid tid = reader.oldest_tid();
  for (int i = 0; i < kMaxTries; ++i) {
    SampleInfo info;
    const ReadStatus status = reader.read_info(tid, info);
    if (status == ReadStatus::ok) return info.time;
    if (status == ReadStatus::too_old) {
      tid = std::max(tid + 1, reader.oldest_tid());  // it was overwritten meanwhile
    } else if (status == ReadStatus::lost) {
      ++tid;
    } else {
      break;
    }
  }
  return std::nullopt;
}

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
    if (!error) {
      if (entry.stream->is_undescribed()) describe(name, entry);
      return {&*entry.stream, {}};
    }
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
  const auto result = std::make_shared<Result<OpenStream>>(Error{Errc::unavailable, {}});
  const auto description = std::make_shared<Description>(descriptions_[name]);
  worker_.add([this, name, result, description] {
    const StreamId id = *StreamId::parse(name);  // find() has tried that
    *result = open_in_source(id);
    if (*result && (*result)->is_undescribed()) {
      *description = find_description(id, std::move(*description));
    }
    server_.post([this, name, result, description] {
      Entry& opened = entries_[name];
      opened.is_opening = false;
      if (*result) {
        opened.error.clear();
        opened.stream.emplace(*std::move(*result));
        use(name, *description);
      } else {
        opened.error = result->error().message;
      }
    });
  });
}

Result<OpenStream> Streams::open_in_source(const StreamId& id) {
  if (auto* const session = std::get_if<Session>(&source_)) {
    return OpenStream(DSSM_TRY(session->open_raw_reader(id)));
  }
  return OpenStream(DSSM_TRY(std::get<Recording>(source_).open_raw_reader(id)));
}

void Streams::describe(const std::string& name, Entry& entry) {
  const MonoTime now = MonoClock::now();
  if (entry.is_describing || now < entry.describe_at) return;
  entry.is_describing = true;
  worker_.add([this, name, id = *StreamId::parse(name), known = descriptions_[name]] {
    server_.post([this, name, description = find_description(id, known)] {
      entries_[name].is_describing = false;
      use(name, description);
    });
  });
}

void Streams::use(const std::string& name, const Description& description) {
  Entry& entry = entries_[name];
  entry.describe_at = deadline_in(kDescribePeriod);
  descriptions_[name] = description;
  if (!entry.stream || !entry.stream->is_undescribed()) return;
  if (std::get<RawReader>(entry.stream->reader).incarnation() != description.incarnation) return;
  entry.stream->obvious = description.type;
  entry.stream->follow_restart();
}

Streams::Description Streams::find_description(const StreamId& id, Description known) {
  auto& session = std::get<Session>(source_);
  const Result<StreamInfo> stream = session.stream_info(id);
  if (!stream) return known;
  Description now{stream->incarnation, users_of(*stream), {}};
  if (!stream->type.fields.empty()) {
    now.type = stream->type;  // by `dssmctl describe`
  } else if (known.incarnation == now.incarnation &&
             (!known.type.fields.empty() || known.users == now.users)) {
    now.type = std::move(known.type);
  } else if (auto program = ctl::obvious_type_of_programs(session, id)) {
    now.type = std::move(program->found.type);
  }
  return now;
}

void Streams::ask_property(const std::string& name, std::optional<Time> t, PropertyDone done) {
  const Result<StreamId> id = StreamId::parse(name);
  if (!id) return done(id.error());
  const std::pair key(name, t);
  if (!properties_.contains(key) && properties_.size() >= kMaxProperties) {
    return done(Error{Errc::limit_exceeded, "too many properties are asked for; try again"});
  }
  std::vector<PropertyDone>& waiting = properties_[key];
  waiting.push_back(std::move(done));
  if (waiting.size() > 1) return;
  property_worker_.add([this, id = *id, key] {
    auto* const session = std::get_if<Session>(&source_);
    const Result<std::vector<std::byte>> property =
        session ? session->property(id)
                : recorded_property(std::get<Recording>(source_), id, key.second);
    server_.post([this, property, key] {
      const std::vector<PropertyDone> all = std::move(properties_[key]);
      properties_.erase(key);
      for (const PropertyDone& call : all) call(property);
    });
  });
}

std::optional<Time> Streams::known_oldest(const StreamInfo& stream, const std::string& host) const {
  const auto found = entries_.find(stream.id.str());
  if (found == entries_.end() || !found->second.stream) return std::nullopt;
  const bool has_history = stream.mirror && stream.mirror->history_wanted;
  if (stream.id.host != host && !has_history) return std::nullopt;
  const auto* const reader = std::get_if<RawReader>(&found->second.stream->reader);
  if (!reader || reader->incarnation() != stream.incarnation) return std::nullopt;
  return oldest_time(*reader);
}

void Streams::close_unused() {
  const MonoTime now = MonoClock::now();
  std::erase_if(entries_, [&](const auto& named) {
    const Entry& entry = named.second;
    return !entry.is_opening && !entry.is_describing && now - entry.used > kUnusedTime;
  });
  // The fields that were found remain known, also when no program has the stream open then.
  std::erase_if(descriptions_, [&](const auto& named) {
    const bool is_kept = !named.second.type.fields.empty() && descriptions_.size() <= kMaxStreams;
    return !entries_.contains(named.first) && !is_kept;
  });
}

}  // namespace dssm::view
