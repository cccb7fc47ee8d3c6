// SPDX-License-Identifier: Apache-2.0
#include "client/view/streams.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <memory>
#include <utility>

#include "client/dssmctl/describe_stream.hpp"
#include "client/dssmctl/fields.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

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

OpenStream::OpenStream(StreamReader opened, TypeInfo program_type)
    : reader(std::move(opened)), obvious(std::move(program_type)) {
  follow_restart();
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
  const auto result = std::make_shared<Result<OpenStream>>(Error{Errc::unavailable, {}});
  worker_.add([this, name, result] {
    *result = open_in_source(*StreamId::parse(name));  // find() has tried that
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

Result<OpenStream> Streams::open_in_source(const StreamId& id) {
  auto* const session = std::get_if<Session>(&source_);
  if (!session) return OpenStream(DSSM_TRY(std::get<Recording>(source_).open_raw_reader(id)));
  RawReader reader = DSSM_TRY(session->open_raw_reader(id));
  std::optional<ctl::ProgramType> program;
  if (reader.type().fields.empty()) program = ctl::obvious_type_of_programs(*session, reader.id());
  return OpenStream(std::move(reader), program ? std::move(program->found.type) : TypeInfo());
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
    return !named.second.is_opening && now - named.second.used > kUnusedTime;
  });
}

}  // namespace dssm::view
