// SPDX-License-Identifier: Apache-2.0
//
// A log of SSM that is read as a recording with one stream. Its records have no tids: they are
// counted. Its incarnation is its start, so that several logs of one stream are one recording.
// Like the records of another program they are in no chunk; some of them together are one here.
#include <fmt/format.h>

#include <algorithm>
#include <cstring>

#include "client/recording/file_reader.hpp"
#include "client/recording/stream_channel.hpp"
#include "core/base/seconds.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::recording {
namespace {

constexpr std::uint64_t kChunkBytes = 1U << 20;
constexpr std::uint16_t kChannel = 1;

RecordedStream stream_of_log(const SsmLogHead& head, std::string_view line) {
  RecordedStream stream;
  stream.id = {head.stream_name, head.stream_id, ""};
  stream.type = {"", head.data_bytes, 1, {}};
  if (head.data_bytes == 0) stream.type = {kEmptySsmType, 1, 1, {}};
  stream.depth = static_cast<std::uint64_t>(std::max(head.buffer_num, 0));
  stream.cycle = Duration(std::max<std::int64_t>(ns_from_seconds(head.cycle_s), 1));
  stream.incarnation = static_cast<std::uint64_t>(ns_from_seconds(head.start_time_s));
  stream.metadata[kSsmLogKey] = line.substr(0, line.find('\n'));
  return stream;
}

// Of records [first, end) those that are no samples.
void add_gaps(std::vector<RecordedGap>& gaps, const std::vector<Message>& samples, Tid first,
              Tid end) {
  const auto add = [&](Tid next) {
    if (next == first) return;
    const auto count = static_cast<std::uint64_t>(next - first);
    const bool continues =
        !gaps.empty() && gaps.back().first + static_cast<Tid>(gaps.back().count) == first;
    continues ? void(gaps.back().count += count) : gaps.push_back({first, count});
  };
  for (const Message& sample : samples) {
    add(sample.tid);
    first = sample.tid + 1;
  }
  add(end);
}

}  // namespace

Result<void> FileReader::begin_log(std::string_view begin) {
  log_ = DSSM_TRY(ssm_log_head_untrusted(begin, bytes_));
  const SsmLogHead& head = *log_;
  FileChannel& channel = channels_[kChannel];
  channel.stream = stream_of_log(head, begin);
  DSSM_TRY(channel.stream->id.check());
  DSSM_TRY(channel.stream->type.check());
  channel.channel.topic = topic_of(channel.stream->id);
  const auto property = DSSM_TRY(read(head.line_bytes, head.property_bytes));
  channel.stream->property.assign(property.begin(), property.end());
  if (!property.empty()) {
    channel.properties.push_back({Time::min(), head.line_bytes, head.property_bytes, 0});
  }
  is_whole_ = true;
  data_start_ = data_end_ = head.records_at();
  return {};
}

void FileReader::scan_log() {
  const std::uint64_t record_bytes = log_->record_bytes();
  const std::uint64_t records = (bytes_ - data_start_) / record_bytes;
  const std::uint64_t at_once = std::max<std::uint64_t>(kChunkBytes / record_bytes, 1);
  data_end_ = data_start_ + records * record_bytes;
  if (data_end_ < bytes_) {
    warn(fmt::format("it ends in the middle of a record: its last {} bytes are left out",
                     bytes_ - data_end_));
  }
  std::uint64_t left_out = 0, rounded = 0;
  for (std::uint64_t first = 0; first < records; first += at_once) {
    IndexedChunk chunk;
    chunk.is_bare = true;
    chunk.index.offset = data_start_ + first * record_bytes;
    chunk.index.length = std::min(at_once, records - first) * record_bytes;
    LoadedChunk loaded;
    if (Result<void> data = load_data(chunk, loaded.data); !data) {
      return warn(data.error().message);
    }
    decode_records(loaded, chunk);
    const std::uint64_t samples = loaded.messages.size();
    left_out += chunk.index.length / record_bytes - samples;
    add_gaps(channels_[kChannel].gaps, loaded.messages, static_cast<Tid>(first),
             static_cast<Tid>(first + chunk.index.length / record_bytes));
    for (const Message& message : loaded.messages) {
      double seconds = 0;
      std::memcpy(&seconds, loaded.data.data() + message.offset - sizeof seconds, sizeof seconds);
      rounded += seconds_from_ns(message.time_ns) != seconds ? 1 : 0;
    }
    if (samples == 0) continue;
    chunk.parts.push_back(loaded.channels.at(kChannel).part);
    summary_.chunks.push_back(std::move(chunk));
  }
  if (left_out > 0) {
    warn(fmt::format("{} records are left out: their times are not between the years 1678 and 2261",
                     left_out));
  }
  if (rounded > 0) {
    warn(fmt::format("{} times are rounded to a nanosecond", rounded));
  }
}

void FileReader::decode_records(LoadedChunk& chunk, const IndexedChunk& about) const {
  const std::uint64_t record_bytes = log_->record_bytes();
  const std::uint64_t first = (about.index.offset - data_start_) / record_bytes;
  LoadedChunk::ChannelMessages messages;
  messages.part.channel = kChannel;
  for (std::uint64_t at = 0; at + record_bytes <= chunk.data.size(); at += record_bytes) {
    double seconds = 0;
    std::memcpy(&seconds, chunk.data.data() + at, sizeof seconds);
    if (!is_sample_time(seconds)) continue;
    Message message;
    message.tid = static_cast<Tid>(first + at / record_bytes);
    message.time_ns = ns_from_seconds(seconds);
    message.clock_error_ns = message.clock_bound_ns = to_ns(kUnknownClockError);
    message.offset = static_cast<std::uint32_t>(at + sizeof seconds);
    message.payload_bytes = static_cast<std::uint32_t>(log_->data_bytes);
    message.channel = kChannel;
    if (!chunk.messages.empty() && message.time_ns < chunk.messages.back().time_ns) {
      messages.is_sorted = false;
    }
    messages.messages.push_back(static_cast<std::uint32_t>(chunk.messages.size()));
    messages.part.add(message.info());
    chunk.messages.push_back(message);
  }
  if (!chunk.messages.empty()) chunk.channels.emplace(kChannel, std::move(messages));
}

}  // namespace dssm::recording
