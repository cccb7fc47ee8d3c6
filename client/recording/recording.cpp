// SPDX-License-Identifier: Apache-2.0
//
// Recordings that are read: several files as one, streams with their incarnations, and samples by
// tid, time and order.
//
// The index: for each incarnation of a stream its parts (the samples of one chunk each) in the
// order of tids, with the least time of the part and all after it. That never falls from part to
// part, so that the last part with a time <= t is found by bisection, for every sequence of times.
// A part that turns out to be damaged is removed.
#include <fmt/format.h>

#include <algorithm>
#include <list>
#include <mutex>
#include <numeric>
#include <tuple>

#include "client/recording/file_reader.hpp"
#include "core/base/check.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::recording {
namespace {

constexpr std::uint64_t kCacheBytes = 64U << 20;
constexpr std::size_t kMinCachedChunks = 2;
constexpr std::size_t kMaxLateWarnings = 100;  // found while samples are read

// The recording that a file is part of: all of them have one name.
std::string recording_of(const FileReader& file) {
  return file.recording().empty() ? file.path().string() : file.recording();
}

}  // namespace

struct IndexPart {
  std::uint32_t file = 0, chunk = 0;
  Part part;
  std::int64_t min_time_from_here_ns = 0;
};

// One incarnation of a stream; its number is that in Recording::streams().
struct Life {
  std::vector<IndexPart> parts;
  std::vector<PropertyPlace> properties;
  std::size_t group = 0;
};

// The incarnations of one stream, in order.
struct Group {
  StreamId id;
  std::vector<std::size_t> lives;
};

// A sample of a stream.
struct Place {
  std::size_t life = 0;  // index in Group::lives
  std::size_t part = 0;
  std::size_t at = 0;  // in the part
};

struct FoundMessage {
  std::shared_ptr<const LoadedChunk> chunk;
  const Message* message = nullptr;  // in *chunk
};

struct Content {
  std::mutex mutex;  // of all that changes after open()
  std::vector<std::unique_ptr<FileReader>> files;
  std::vector<std::filesystem::path> paths;
  std::vector<RecordedStreamInfo> streams;
  std::vector<Life> lives;  // of the same numbers
  std::vector<Group> groups;
  std::vector<std::map<std::uint16_t, std::size_t>> stream_of_channel;  // by file
  std::vector<RecordedTrigger> triggers;
  std::vector<std::string> warnings;

  struct Cached {
    std::uint32_t file, chunk;
    std::shared_ptr<const LoadedChunk> loaded;  // null: damaged
  };
  std::list<Cached> cache;  // the one that was used last comes first
  std::uint64_t cached_bytes = 0;

  Result<void> add(std::uint32_t file);
  void add_properties(std::size_t stream, std::uint32_t file, const FileChannel& channel);
  Time first_time(std::uint32_t file, std::uint16_t channel) const;
  // The index of a property is that in RecordedStreamInfo::property_times. With the mutex held.
  Result<std::vector<std::byte>> property(std::size_t stream, std::size_t index);
  void finish();

  // --- with the mutex held

  // Null: damaged.
  std::shared_ptr<const LoadedChunk> load(std::uint32_t file, std::uint32_t chunk);
  // The chunk of a part, with its messages; null: the part was damaged, and is removed.
  const LoadedChunk::ChannelMessages* messages(std::size_t life, std::size_t part,
                                               std::shared_ptr<const LoadedChunk>& chunk);
  static void index_times(Life& life, std::size_t end);

  // The first sample with a tid >= `tid` of that life.
  std::optional<Place> from_tid(const Group& group, std::size_t life, Tid tid);
  // The last sample with time <= `t`, of all lives.
  std::optional<Place> at_time(const Group& group, std::int64_t t_ns);
  std::optional<Place> after(const Group& group, Place place, bool all_lives);
  std::optional<Place> first(const Group& group, std::size_t life, bool all_lives);
  std::optional<Place> last(const Group& group, std::size_t life, bool all_lives);
  // `place` was found in this call.
  FoundMessage get(const Group& group, const Place& place);
};

// --- opening

Result<void> Content::add(std::uint32_t number) {
  FileReader& file = *files[number];
  paths.push_back(file.path());
  warnings.insert(warnings.end(), file.warnings().begin(), file.warnings().end());
  file.warnings().clear();
  triggers.insert(triggers.end(), file.triggers().begin(), file.triggers().end());
  std::map<std::uint16_t, std::size_t>& numbers = stream_of_channel.emplace_back();
  for (auto& [id, channel] : file.channels()) {
    if (channel.is_left_out) continue;
    RecordedStream about;
    if (channel.stream) {
      about = *channel.stream;
    } else {
      about.id = DSSM_TRY(StreamId::parse(channel.channel.topic));
      about.incarnation = id;
      about.type.payload_bytes = channel.max_bytes;
    }
    const auto known = std::ranges::find_if(streams, [&](const RecordedStreamInfo& stream) {
      return stream.id == about.id && stream.incarnation == about.incarnation;
    });
    const auto at = static_cast<std::size_t>(known - streams.begin());
    numbers[id] = at;
    if (known == streams.end()) {
      RecordedStreamInfo& added = streams.emplace_back();
      static_cast<RecordedStream&>(added) = about;
      Life& life = lives.emplace_back();
      auto group = std::ranges::find(groups, about.id, &Group::id);
      if (group == groups.end()) group = groups.insert(group, {about.id, {}});
      life.group = static_cast<std::size_t>(group - groups.begin());
      group->lives.push_back(at);
    } else {
      if (channel.stream && !about.type.check_usable_as(known->type)) {
        return Error{Errc::conflict,
                     fmt::format("recording '{}': stream '{}' has another type there than in the "
                                 "files before; open it separately",
                                 file.path().string(), about.id.str())};
      }
      if (known->type.is_less_described_than(about.type)) known->type = about.type;
      known->type.payload_bytes = std::max(known->type.payload_bytes, about.type.payload_bytes);
    }
    add_properties(at, number, channel);
    for (const RecordedGap& gap : channel.gaps) streams[at].lost_samples += gap.count;
    streams[at].gaps.insert(streams[at].gaps.end(), channel.gaps.begin(), channel.gaps.end());
  }

  // Other programs' messages are counted over all files.
  std::map<std::uint16_t, Tid> first_tids;
  for (const auto& [id, channel] : file.channels()) {
    if (channel.stream || channel.is_left_out) continue;
    first_tids[id] = streams[numbers[id]].last_tid + 1;
  }
  for (std::uint32_t chunk = 0; chunk < file.chunks().size(); ++chunk) {
    for (Part& part : file.chunks()[chunk].parts) {
      if (const auto first = first_tids.find(part.channel); first != first_tids.end()) {
        part.first_tid += first->second;
        part.last_tid += first->second;
      }
      const std::size_t stream = numbers.at(part.channel);
      RecordedStreamInfo& about = streams[stream];
      std::vector<IndexPart>& parts = lives[stream].parts;
      if (!parts.empty() && part.first_tid <= parts.back().part.last_tid) {
        return Error{
            Errc::conflict,
            fmt::format("recordings '{}' and '{}' both have sample {} of stream '{}', or have it "
                        "out of order; open them separately",
                        paths[parts.back().file].string(), file.path().string(), part.first_tid,
                        about.id.str())};
      }
      const Time first_time = time_from_ns(part.min_time_ns);
      const Time last_time = time_from_ns(part.max_time_ns);
      about.first_time = about.samples == 0 ? first_time : std::min(about.first_time, first_time);
      about.last_time = about.samples == 0 ? last_time : std::max(about.last_time, last_time);
      if (about.samples == 0) about.first_tid = part.first_tid;
      about.last_tid = part.last_tid;
      about.samples += part.samples;
      about.payload_bytes += part.payload_bytes;
      parts.push_back({number, chunk, part, 0});
    }
  }
  return {};
}

// The least time of the channel in that file; the greatest of all times: it has no sample there.
Time Content::first_time(std::uint32_t file, std::uint16_t channel) const {
  Time first = Time::max();
  for (const auto& chunk : files[file]->chunks()) {
    for (const Part& part : chunk.parts) {
      if (part.channel == channel) first = std::min(first, time_from_ns(part.min_time_ns));
    }
  }
  return first;
}

// A file begins with the property that the stream had in the file before.
void Content::add_properties(std::size_t stream, std::uint32_t file, const FileChannel& channel) {
  if (channel.properties.empty()) return;
  RecordedStreamInfo& about = streams[stream];
  std::vector<PropertyPlace>& all = lives[stream].properties;
  const auto first = files[file]->property(channel.properties.front());
  const bool is_repeated = !all.empty() && first && *first == about.property;
  for (std::size_t i = is_repeated ? 1 : 0; i < channel.properties.size(); ++i) {
    PropertyPlace place = channel.properties[i];
    place.file = file;
    // What a file begins with holds for its own samples, as of an incident some time after another.
    if (place.from == Time::min() && !all.empty())
      place.from = first_time(file, channel.channel.id);
    add_property(all, place);
  }
  about.property = channel.stream->property;
  about.property_times.clear();
  for (const PropertyPlace& place : all) about.property_times.push_back(place.from);
}

Result<std::vector<std::byte>> Content::property(std::size_t stream, std::size_t index) {
  const PropertyPlace& place = lives[stream].properties[index];
  return files[place.file]->property(place);
}

void Content::finish() {
  std::ranges::stable_sort(triggers, {}, &RecordedTrigger::time);
  for (RecordedStreamInfo& stream : streams) {
    std::ranges::stable_sort(stream.gaps, {}, &RecordedGap::first);
  }
  for (Life& life : lives) index_times(life, life.parts.size());
  // Of another program's channels nothing tells how long messages may be: all of one topic have the
  // longest one's length.
  for (const Group& group : groups) {
    std::uint64_t most = 1;
    for (const std::size_t life : group.lives) {
      most = std::max(most, streams[life].type.payload_bytes);
    }
    for (const std::size_t life : group.lives) {
      TypeInfo& type = streams[life].type;
      if (type.name.empty() && type.fields.empty() && streams[life].depth == 0) {
        type.payload_bytes = most;
      }
    }
  }
}

// For the parts before `end`, from the last one on.
void Content::index_times(Life& life, std::size_t end) {
  std::int64_t least = end < life.parts.size() ? life.parts[end].min_time_from_here_ns : INT64_MAX;
  for (std::size_t i = end; i-- > 0;) {
    least = std::min(least, life.parts[i].part.min_time_ns);
    life.parts[i].min_time_from_here_ns = least;
  }
}

// --- chunks

std::shared_ptr<const LoadedChunk> Content::load(std::uint32_t file, std::uint32_t chunk) {
  const auto found = std::ranges::find_if(
      cache, [&](const Cached& entry) { return entry.file == file && entry.chunk == chunk; });
  if (found != cache.end()) {
    cache.splice(cache.begin(), cache, found);
    return found->loaded;
  }
  Result<std::shared_ptr<const LoadedChunk>> loaded =
      files[file]->load(files[file]->chunks()[chunk]);
  if (!loaded) {
    const std::string& why = loaded.error().message;
    if (warnings.size() < kMaxLateWarnings && std::ranges::find(warnings, why) == warnings.end()) {
      warnings.push_back(why);
    }
    return nullptr;
  }
  cached_bytes += (*loaded)->bytes();
  cache.push_front({file, chunk, *loaded});
  while (cached_bytes > kCacheBytes && cache.size() > kMinCachedChunks) {
    cached_bytes -= cache.back().loaded->bytes();
    cache.pop_back();
  }
  return *loaded;
}

const LoadedChunk::ChannelMessages* Content::messages(std::size_t number, std::size_t at,
                                                      std::shared_ptr<const LoadedChunk>& chunk) {
  Life& life = lives[number];
  const IndexPart& part = life.parts[at];
  chunk = load(part.file, part.chunk);
  if (chunk != nullptr) return &chunk->channels.at(part.part.channel);
  life.parts.erase(life.parts.begin() + static_cast<std::ptrdiff_t>(at));
  index_times(life, at);
  return nullptr;
}

// --- finding

std::optional<Place> Content::from_tid(const Group& group, std::size_t life, Tid tid) {
  const std::size_t number = group.lives[life];
  std::vector<IndexPart>& parts = lives[number].parts;
  while (true) {
    const auto part = std::ranges::lower_bound(
        parts, tid, {}, [](const IndexPart& each) { return each.part.last_tid; });
    if (part == parts.end()) return std::nullopt;
    const auto at = static_cast<std::size_t>(part - parts.begin());
    if (tid <= part->part.first_tid) return Place{life, at, 0};
    std::shared_ptr<const LoadedChunk> chunk;
    const auto* found = messages(number, at, chunk);
    if (found == nullptr) continue;
    const auto message = std::ranges::lower_bound(
        found->messages, tid, {}, [&](std::uint32_t index) { return chunk->messages[index].tid; });
    return Place{life, at, static_cast<std::size_t>(message - found->messages.begin())};
  }
}

std::optional<Place> Content::at_time(const Group& group, std::int64_t t_ns) {
  for (std::size_t life = group.lives.size(); life-- > 0;) {
    const std::size_t number = group.lives[life];
    std::vector<IndexPart>& parts = lives[number].parts;
    while (true) {
      const auto later =
          std::ranges::upper_bound(parts, t_ns, {}, &IndexPart::min_time_from_here_ns);
      if (later == parts.begin()) break;
      const auto at = static_cast<std::size_t>(later - parts.begin()) - 1;
      std::shared_ptr<const LoadedChunk> chunk;
      const auto* found = messages(number, at, chunk);
      if (found == nullptr) continue;
      const auto time = [&](std::uint32_t index) { return chunk->messages[index].time_ns; };
      auto end = found->messages.end();
      if (found->is_sorted) {
        end = std::ranges::upper_bound(found->messages, t_ns, {}, time);
      } else {
        while (time(*(end - 1)) > t_ns) --end;  // one is not: the least time is its
      }
      return Place{life, at, static_cast<std::size_t>(end - found->messages.begin()) - 1};
    }
  }
  return std::nullopt;
}

std::optional<Place> Content::after(const Group& group, Place place, bool all_lives) {
  const std::vector<IndexPart>& parts = lives[group.lives[place.life]].parts;
  if (place.at + 1 < parts[place.part].part.samples) {
    return Place{place.life, place.part, place.at + 1};
  }
  if (place.part + 1 < parts.size()) return Place{place.life, place.part + 1, 0};
  if (!all_lives) return std::nullopt;
  return first(group, place.life + 1, true);
}

std::optional<Place> Content::first(const Group& group, std::size_t life, bool all_lives) {
  for (; life < group.lives.size(); ++life) {
    if (!lives[group.lives[life]].parts.empty()) return Place{life, 0, 0};
    if (!all_lives) break;
  }
  return std::nullopt;
}

// The last sample of `life` or of an earlier one.
std::optional<Place> Content::last(const Group& group, std::size_t life, bool all_lives) {
  for (;; --life) {
    const std::vector<IndexPart>& parts = lives[group.lives[life]].parts;
    if (!parts.empty()) return Place{life, parts.size() - 1, parts.back().part.samples - 1U};
    if (!all_lives || life == 0) return std::nullopt;
  }
}

FoundMessage Content::get(const Group& group, const Place& place) {
  FoundMessage found;
  const auto* in_chunk = messages(group.lives[place.life], place.part, found.chunk);
  if (in_chunk != nullptr) found.message = &found.chunk->messages[in_chunk->messages[place.at]];
  return found;
}

using PlacedMessage = std::pair<Place, FoundMessage>;

// --- a reader

struct ReaderState {
  std::shared_ptr<Content> content;
  std::size_t group = 0;
  std::size_t life = 0;  // index in Group::lives
  Tid cursor = kNoTid;
  std::uint64_t lost = 0;
  std::uint64_t restarts = 0;

  const Group& streams() const { return content->groups[group]; }
  std::size_t number() const { return streams().lives[life]; }
  const RecordedStreamInfo& about() const { return content->streams[number()]; }

  // Goes to another incarnation; false: that is the current one.
  bool enter(std::size_t other) {
    if (other == life) return false;
    life = other;
    cursor = kNoTid;
    ++restarts;
    return true;
  }

  // Finds a place and gets what is there, again when the part turns out to be damaged.
  //   find  returns Place, or nullopt
  template <class Find>
  std::optional<PlacedMessage> found(Find find) const {
    while (const std::optional<Place> place = find()) {
      if (FoundMessage message = content->get(streams(), *place); message.message != nullptr) {
        return std::pair(*place, std::move(message));
      }
    }
    return std::nullopt;
  }
  auto at_time(Time t) const {
    return found([&] { return content->at_time(streams(), to_ns(t)); });
  }
  // The one after that, and the first one of all when there is none with time <= t.
  auto after_time(Time t) const {
    return found([&] {
      const auto before = content->at_time(streams(), to_ns(t));
      return before ? content->after(streams(), *before, true) : content->first(streams(), 0, true);
    });
  }
  bool is_empty() const { return !content->first(streams(), 0, true); }

  // Copies the sample, unless it is in another incarnation.
  ReadStatus copy(const std::optional<PlacedMessage>& sample, ReadStatus otherwise,
                  std::span<std::byte> payload, SampleInfo& info) {
    if (!sample) return otherwise;
    if (enter(sample->first.life)) return ReadStatus::restarted;
    copy_to(sample->second, payload, info);
    return ReadStatus::ok;
  }
  static void copy_to(const FoundMessage& found, std::span<std::byte> payload, SampleInfo& info) {
    const auto bytes = found.chunk->payload(*found.message);
    if (!bytes.empty()) std::memcpy(payload.data(), bytes.data(), bytes.size());
    info = found.message->info();
  }
  // Why sample `tid` of this incarnation is not there; to be called when it was not found.
  ReadStatus why_missing(Tid tid) const {
    const auto& parts = content->lives[number()].parts;
    if (tid < 0) return ReadStatus::too_old;
    if (parts.empty() || tid > parts.back().part.last_tid) return ReadStatus::not_yet;
    return tid < parts.front().part.first_tid ? ReadStatus::too_old : ReadStatus::lost;
  }
  static bool is_same(const FoundMessage& found, const SampleInfo& info) {
    return found.message->tid == info.tid && found.message->time_ns == to_ns(info.time);
  }
  // Which of the two is nearer to `t`: the earlier one of two equally near ones.
  static bool is_after_nearer(Time t, const PlacedMessage& before, const PlacedMessage& after) {
    return distance_ns(t, time_from_ns(after.second.message->time_ns)) <
           distance_ns(time_from_ns(before.second.message->time_ns), t);
  }
  auto at_tid(Tid tid) const {
    auto sample = found([&] { return content->from_tid(streams(), life, tid); });
    if (sample && sample->second.message->tid != tid) sample.reset();
    return sample;
  }
};

// Of one recording; its samples come in the order in which they were recorded.
struct Track {
  std::uint32_t first_file = 0, end_file = 0;
  std::uint32_t file = 0, chunk = 0;  // of the chunk after `loaded`
  std::size_t at = 0;                 // of the next message in `loaded`
  // nullptr: before the first one, or after the last one
  std::shared_ptr<const LoadedChunk> loaded = nullptr;
  std::int64_t from_ns = INT64_MIN;  // earlier ones are passed over, until one is not

  bool next_chunk(Content* content);
  bool previous_chunk(Content* content);
  // The next message, at `at`, and the one before, at `at` - 1; nullptr: there is none.
  const Message* next(Content* content);
  const Message* previous(Content* content);
};

// Several recordings, as the logs of several streams, are merged by time.
struct CursorState {
  std::shared_ptr<Content> content;
  std::vector<Track> tracks;

  void seek(std::int64_t t_ns);
  // The one whose next or previous message is the next or previous of all; nullptr: there is none.
  Track* next();
  Track* previous();
  void get(const Track& track, std::size_t at, RecordedSample& out) const;
};

void CursorState::seek(std::int64_t t_ns) {
  tracks.clear();
  const auto& files = content->files;
  for (std::uint32_t file = 0; file < files.size(); ++file) {
    if (file == 0 || recording_of(*files[file]) != recording_of(*files[file - 1])) {
      tracks.push_back({.first_file = file, .file = file, .from_ns = t_ns});
    }
    tracks.back().end_file = file + 1;
  }
}

// Goes to the next chunk; false after the last one.
bool Track::next_chunk(Content* content) {
  const std::lock_guard lock(content->mutex);
  at = 0;
  while (file < end_file) {
    const std::vector<IndexedChunk>& chunks = content->files[file]->chunks();
    if (chunk == chunks.size()) {
      ++file;
      chunk = 0;
      continue;
    }
    const bool is_wanted = std::ranges::any_of(
        chunks[chunk].parts, [&](const Part& part) { return part.max_time_ns >= from_ns; });
    if (is_wanted) loaded = content->load(file, chunk);
    ++chunk;
    if (is_wanted && loaded != nullptr) return true;
  }
  loaded = nullptr;
  return false;
}

// Goes behind the last message of the chunk before; false before the first one.
bool Track::previous_chunk(Content* content) {
  const std::lock_guard lock(content->mutex);
  if (loaded != nullptr) --chunk;
  loaded = nullptr;
  at = 0;
  for (;;) {
    while (chunk == 0) {
      if (file == first_file) return false;
      chunk = static_cast<std::uint32_t>(content->files[--file]->chunks().size());
    }
    loaded = content->load(file, chunk - 1);
    if (loaded == nullptr) {
      --chunk;
      continue;
    }
    at = loaded->messages.size();
    return true;
  }
}

const Message* Track::next(Content* content) {
  for (;; ++at) {
    while (loaded == nullptr || at == loaded->messages.size()) {
      if (next_chunk(content)) continue;
      from_ns = INT64_MIN;
      return nullptr;
    }
    if (loaded->messages[at].time_ns >= from_ns) break;
  }
  from_ns = INT64_MIN;
  return &loaded->messages[at];
}

const Message* Track::previous(Content* content) {
  if (from_ns != INT64_MIN) next(content);
  while (loaded == nullptr || at == 0) {
    if (!previous_chunk(content)) return nullptr;
  }
  return &loaded->messages[at - 1];
}

Track* CursorState::next() {
  Track* first = nullptr;
  std::int64_t first_ns = 0;
  for (Track& track : tracks) {
    const Message* message = track.next(content.get());
    if (message == nullptr || (first != nullptr && message->time_ns >= first_ns)) continue;
    first = &track;
    first_ns = message->time_ns;
  }
  return first;
}

Track* CursorState::previous() {
  Track* last = nullptr;
  std::int64_t last_ns = 0;
  for (Track& track : tracks) {
    const Message* message = track.previous(content.get());
    if (message == nullptr || (last != nullptr && message->time_ns < last_ns)) continue;
    last = &track;
    last_ns = message->time_ns;
  }
  return last;
}

void CursorState::get(const Track& track, std::size_t at, RecordedSample& out) const {
  const Message& message = track.loaded->messages[at];
  out.stream = content->stream_of_channel[track.file].at(message.channel);
  out.info = message.info();
  out.clock_error = Duration(message.clock_bound_ns);
  out.payload = track.loaded->payload(message);
}

}  // namespace dssm::recording

namespace dssm {

using recording::Content;
using recording::Place;

// --- Recording

Recording::Recording(std::shared_ptr<Content> content) noexcept : content_(std::move(content)) {}

Result<Recording> Recording::open(const std::filesystem::path& path) {
  std::error_code error;
  if (!std::filesystem::is_directory(path, error)) return open(std::span(&path, 1));
  std::vector<std::filesystem::path> files, logs;
  for (std::filesystem::directory_iterator each(path, error), end; !error && each != end;
       each.increment(error)) {
    if (each->path().extension() == ".mcap") files.push_back(each->path());
    if (each->path().extension() == ".log") logs.push_back(each->path());
  }
  if (error) return os_error(fmt::format("open folder '{}'", path.string()), error.value());
  if (files.empty()) files = std::move(logs);
  if (files.empty()) {
    return Error{Errc::not_found,
                 fmt::format("open recording '{}': the folder has no file *.mcap, and no *.log",
                             path.string())};
  }
  return open(files);
}

Result<Recording> Recording::open(std::span<const std::filesystem::path> files) {
  auto content = std::make_shared<Content>();
  if (files.empty()) return Error{Errc::invalid_argument, "open a recording: no file is given"};
  for (const std::filesystem::path& file : files) {
    content->files.push_back(DSSM_TRY(recording::FileReader::open(file)));
  }
  // Files of one recording by their numbers, recordings by their first sample.
  std::map<std::string, std::int64_t> starts;
  for (const auto& file : content->files) {
    std::int64_t& start =
        starts.try_emplace(recording::recording_of(*file), INT64_MAX).first->second;
    for (const auto& chunk : file->chunks()) {
      for (const auto& part : chunk.parts) start = std::min(start, part.min_time_ns);
    }
  }
  const auto key = [&](const auto& file) {
    const std::string name = recording::recording_of(*file);
    return std::tuple(starts[name], name, file->number(), file->path());
  };
  std::ranges::sort(content->files, [&](const auto& a, const auto& b) { return key(a) < key(b); });
  for (std::uint32_t i = 0; i < content->files.size(); ++i) DSSM_TRY(content->add(i));
  content->finish();
  return Recording(std::move(content));
}

const std::vector<RecordedStreamInfo>& Recording::streams() const noexcept {
  return content_->streams;
}

const std::vector<std::filesystem::path>& Recording::files() const noexcept {
  return content_->paths;
}

const std::vector<RecordedTrigger>& Recording::triggers() const noexcept {
  return content_->triggers;
}

std::optional<std::size_t> RecordedStreamInfo::property_at(Time t) const noexcept {
  const auto after = std::ranges::upper_bound(property_times, t);
  if (after == property_times.begin()) return std::nullopt;
  return static_cast<std::size_t>(after - property_times.begin()) - 1;
}

Result<std::vector<std::byte>> Recording::property(std::size_t stream, std::size_t index) const {
  const std::vector<RecordedStreamInfo>& all = streams();
  if (stream >= all.size() || index >= all[stream].property_times.size()) {
    return Error{Errc::invalid_argument,
                 fmt::format("recording '{}' has no property {} of stream {}; streams() has the "
                             "numbers",
                             content_->paths.front().string(), index, stream)};
  }
  const std::lock_guard lock(content_->mutex);
  return content_->property(stream, index);
}

std::vector<std::string> Recording::warnings() const {
  const std::lock_guard lock(content_->mutex);
  return content_->warnings;
}

Result<RecordedRawReader> Recording::open_raw_reader(const StreamId& id,
                                                     const TypeInfo* wanted) const {
  const std::string what =
      fmt::format("open stream '{}' of recording '{}'", id.str(), content_->paths.front().string());
  std::vector<std::size_t> found;
  std::string others;
  for (std::size_t i = 0; i < content_->groups.size(); ++i) {
    const StreamId& has = content_->groups[i].id;
    others += (others.empty() ? "'" : ", '") + has.str() + "'";
    if (has.name == id.name && has.id == id.id && (id.host.empty() || has.host == id.host)) {
      found.push_back(i);
    }
  }
  if (found.empty()) {
    return Error{Errc::not_found, others.empty()
                                      ? fmt::format("{}: it has no streams", what)
                                      : fmt::format("{}: there is none; it has {}", what, others)};
  }
  if (found.size() > 1) {
    return Error{Errc::conflict,
                 fmt::format("{}: several hosts have one; write name:id@host: {}", what, others)};
  }
  const recording::Group& group = content_->groups[found.front()];
  const TypeInfo& first = content_->streams[group.lives.front()].type;
  for (const std::size_t life : group.lives) {
    const TypeInfo& type = content_->streams[life].type;
    if (wanted != nullptr) DSSM_TRY(type.check_usable_as(*wanted), what);
    if (!type.check_usable_as(first)) {
      return Error{Errc::conflict,
                   fmt::format("{}: it restarted with another type, first {}, then {}; read it "
                               "with a cursor()",
                               what, first.description(), type.description())};
    }
  }
  auto state = std::make_unique<recording::ReaderState>();
  state->content = content_;
  state->group = found.front();
  return RecordedRawReader(std::move(state));
}

RecordingCursor Recording::cursor() const {
  auto state = std::make_unique<recording::CursorState>();
  state->content = content_;
  state->seek(INT64_MIN);
  return RecordingCursor(std::move(state));
}

Result<RecordingRepair> repair_recording(const std::filesystem::path& file) {
  return DSSM_TRY(recording::FileReader::open(file, true))->repair();
}

// --- RecordingCursor

RecordingCursor::RecordingCursor(std::unique_ptr<recording::CursorState> state) noexcept
    : state_(std::move(state)) {}
RecordingCursor::RecordingCursor(RecordingCursor&&) noexcept = default;
RecordingCursor& RecordingCursor::operator=(RecordingCursor&&) noexcept = default;
RecordingCursor::~RecordingCursor() = default;

bool RecordingCursor::next(RecordedSample& out) noexcept {
  recording::Track* const track = state_->next();
  if (track == nullptr) return false;
  state_->get(*track, track->at++, out);
  return true;
}

bool RecordingCursor::previous(RecordedSample& out) noexcept {
  recording::Track* const track = state_->previous();
  if (track == nullptr) return false;
  state_->get(*track, --track->at, out);
  return true;
}

void RecordingCursor::seek(Time t) noexcept { state_->seek(to_ns(t)); }

// --- RecordedRawReader

RecordedRawReader::RecordedRawReader(std::unique_ptr<recording::ReaderState> state) noexcept
    : state_(std::move(state)) {}
RecordedRawReader::RecordedRawReader(RecordedRawReader&&) noexcept = default;
RecordedRawReader& RecordedRawReader::operator=(RecordedRawReader&&) noexcept = default;
RecordedRawReader::~RecordedRawReader() = default;

ReadStatus RecordedRawReader::read_newest(std::span<std::byte> payload, SampleInfo& info) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  const recording::Group& group = state_->streams();
  const auto sample =
      state_->found([&] { return state_->content->last(group, group.lives.size() - 1, true); });
  const ReadStatus status = state_->copy(sample, ReadStatus::not_yet, payload, info);
  if (status == ReadStatus::ok) state_->cursor = info.tid;
  return status;
}

ReadStatus RecordedRawReader::read_tid(Tid tid, std::span<std::byte> payload,
                                       SampleInfo& info) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  const auto sample = state_->at_tid(tid);
  if (!sample) return state_->why_missing(tid);
  state_->copy_to(sample->second, payload, info);
  state_->cursor = tid;
  return ReadStatus::ok;
}

ReadStatus RecordedRawReader::read_next(std::span<std::byte> payload, SampleInfo& info) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  recording::ReaderState& state = *state_;
  const auto sample = state.found([&]() -> std::optional<Place> {
    if (state.cursor == INT64_MAX) return std::nullopt;
    return state.content->from_tid(state.streams(), state.life, state.cursor + 1);
  });
  if (!sample) {
    if (state.life + 1 == state.streams().lives.size()) return ReadStatus::not_yet;
    state.enter(state.life + 1);
    return ReadStatus::restarted;
  }
  state.copy_to(sample->second, payload, info);
  if (state.cursor >= 0) state.lost += static_cast<std::uint64_t>(info.tid - state.cursor - 1);
  state.cursor = info.tid;
  return ReadStatus::ok;
}

ReadStatus RecordedRawReader::read_previous(std::span<std::byte> payload,
                                            SampleInfo& info) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  recording::ReaderState& state = *state_;
  if (state.cursor < 0) return ReadStatus::not_yet;
  const auto sample = state.found([&]() -> std::optional<Place> {
    const auto here = state.content->from_tid(state.streams(), state.life, state.cursor);
    if (!here) return state.content->last(state.streams(), state.life, false);
    if (here->at > 0) return Place{here->life, here->part, here->at - 1};
    if (here->part == 0) return std::nullopt;
    const auto& parts = state.content->lives[state.number()].parts;
    return Place{here->life, here->part - 1, parts[here->part - 1].part.samples - 1U};
  });
  if (sample) {
    state.copy_to(sample->second, payload, info);
    state.cursor = info.tid;
    return ReadStatus::ok;
  }
  if (state.life == 0) return ReadStatus::too_old;
  const auto earlier = state.content->last(state.streams(), state.life - 1, true);
  if (!earlier) return ReadStatus::too_old;
  state.enter(earlier->life);
  state.cursor = state.content->lives[state.number()].parts.back().part.last_tid;
  if (state.cursor < INT64_MAX) ++state.cursor;
  return ReadStatus::restarted;
}

ReadStatus RecordedRawReader::read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                                      Duration max_age) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  const auto sample = state_->at_time(t);
  if (!sample) return state_->is_empty() ? ReadStatus::not_yet : ReadStatus::too_old;
  if (is_stale(t, sample->second.message->info().time, max_age)) return ReadStatus::stale;
  return state_->copy(sample, ReadStatus::not_yet, payload, info);
}

ReadStatus RecordedRawReader::read_at_or_after(Time t, std::span<std::byte> payload,
                                               SampleInfo& info) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  const auto sample =
      t == Time::min()
          ? state_->found([&] { return state_->content->first(state_->streams(), 0, true); })
          : state_->after_time(t - Duration(1));
  return state_->copy(sample, ReadStatus::not_yet, payload, info);
}

ReadStatus RecordedRawReader::read_nearest(Time t, std::span<std::byte> payload,
                                           SampleInfo& info) noexcept {
  DSSM_CHECK(payload.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  const auto before = state_->at_time(t);
  const auto after = state_->after_time(t);
  const bool takes_after = after && (!before || state_->is_after_nearer(t, *before, *after));
  return state_->copy(takes_after ? after : before, ReadStatus::not_yet, payload, info);
}

ReadStatus RecordedRawReader::find_neighbours(Time t, Neighbours& out) const noexcept {
  const std::lock_guard lock(state_->content->mutex);
  const auto before = state_->at_time(t);
  if (!before) return state_->is_empty() ? ReadStatus::not_yet : ReadStatus::too_old;
  const auto after = state_->after_time(t);
  if (!after) return ReadStatus::not_yet;
  out = {before->second.message->info(), after->second.message->info()};
  return ReadStatus::ok;
}

ReadStatus RecordedRawReader::read_neighbours(Time t, std::span<std::byte> before,
                                              std::span<std::byte> after,
                                              Neighbours& infos) noexcept {
  DSSM_CHECK(before.size() == payload_bytes() && after.size() == payload_bytes());
  const std::lock_guard lock(state_->content->mutex);
  const auto earlier = state_->at_time(t);
  if (!earlier) return state_->is_empty() ? ReadStatus::not_yet : ReadStatus::too_old;
  const auto later = state_->after_time(t);
  if (!later) return ReadStatus::not_yet;
  if (state_->enter(earlier->first.life)) return ReadStatus::restarted;
  state_->copy_to(earlier->second, before, infos.before);
  state_->copy_to(later->second, after, infos.after);
  return ReadStatus::ok;
}

ReadStatus RecordedRawReader::read_info(Tid tid, SampleInfo& info) const noexcept {
  const std::lock_guard lock(state_->content->mutex);
  const auto sample = state_->at_tid(tid);
  if (!sample) return state_->why_missing(tid);
  info = sample->second.message->info();
  return ReadStatus::ok;
}

ReadStatus RecordedRawReader::find(Time t, SampleInfo& info) const noexcept {
  const std::lock_guard lock(state_->content->mutex);
  const auto sample = state_->at_time(t);
  if (!sample) return state_->is_empty() ? ReadStatus::not_yet : ReadStatus::too_old;
  info = sample->second.message->info();
  return ReadStatus::ok;
}

Duration RecordedRawReader::clock_error(const SampleInfo& info) const noexcept {
  const std::lock_guard lock(state_->content->mutex);
  const auto in_life = [&](std::size_t life) -> std::optional<Duration> {
    const auto sample =
        state_->found([&] { return state_->content->from_tid(state_->streams(), life, info.tid); });
    if (!sample || !state_->is_same(sample->second, info)) return std::nullopt;
    return Duration(sample->second.message->clock_bound_ns);
  };
  if (const auto error = in_life(state_->life)) return *error;
  for (std::size_t life = 0; life < state_->streams().lives.size(); ++life) {
    if (const auto error = in_life(life)) return *error;
  }
  return kUnknownClockError;
}

Tid RecordedRawReader::newest_tid() const noexcept {
  const std::lock_guard lock(state_->content->mutex);
  const auto& parts = state_->content->lives[state_->number()].parts;
  return parts.empty() ? kNoTid : parts.back().part.last_tid;
}

Tid RecordedRawReader::oldest_tid() const noexcept {
  const std::lock_guard lock(state_->content->mutex);
  const auto& parts = state_->content->lives[state_->number()].parts;
  return parts.empty() ? kNoTid : parts.front().part.first_tid;
}

Tid RecordedRawReader::cursor() const noexcept { return state_->cursor; }
void RecordedRawReader::seek(Tid tid) noexcept { state_->cursor = tid; }
const StreamId& RecordedRawReader::id() const noexcept { return state_->about().id; }
const TypeInfo& RecordedRawReader::type() const noexcept { return state_->about().type; }
std::uint64_t RecordedRawReader::payload_bytes() const noexcept {
  return state_->about().type.payload_bytes;
}
std::uint64_t RecordedRawReader::depth() const noexcept { return state_->about().depth; }
Duration RecordedRawReader::cycle() const noexcept { return state_->about().cycle; }
std::uint64_t RecordedRawReader::incarnation() const noexcept {
  return state_->about().incarnation;
}

Result<std::vector<std::byte>> RecordedRawReader::property() const {
  const std::lock_guard lock(state_->content->mutex);
  const recording::ReaderState& state = *state_;
  const auto sample = state.found([&] {
    return state.content->from_tid(state.streams(), state.life, std::max<Tid>(state.cursor, 0));
  });
  const Time time = sample ? sample->second.message->info().time : Time::max();
  if (const auto index = state.about().property_at(time)) {
    std::vector<std::byte> property = DSSM_TRY(state.content->property(state.number(), *index));
    if (!property.empty()) return property;
  }
  return Error{Errc::not_found,
               fmt::format("stream '{}' has no property there in this recording", id().str())};
}

std::uint64_t RecordedRawReader::lost_samples() const noexcept { return state_->lost; }
std::uint64_t RecordedRawReader::restarts() const noexcept { return state_->restarts; }

JointRead read_joint_at(Time t, std::span<RecordedJointSample> samples, Duration max_error,
                        Duration max_age) noexcept {
  JointRead read{ReadStatus::ok, 0, Duration::zero()};
  for (std::size_t i = 0; i < samples.size(); ++i) {
    RecordedJointSample& sample = samples[i];
    const ReadStatus status = sample.reader->read_at(t, sample.payload, sample.info, max_age);
    if (status != ReadStatus::ok) return {status, i, kUnknownClockError};
    zero_rest(sample.payload, sample.info);
    const Duration error = sample.reader->clock_error(sample.info);
    if (error > read.clock_error) read = {ReadStatus::ok, i, error};
  }
  if (read.clock_error > max_error) read.status = ReadStatus::clock_out_of_bounds;
  return read;
}

}  // namespace dssm
