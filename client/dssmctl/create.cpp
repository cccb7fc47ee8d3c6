// SPDX-License-Identifier: Apache-2.0
//
// dssmctl create and rm.
#include <bit>

#include "client/dssmctl/json.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

// The cycle of a stream when --cycle is not given; only tools use it.
constexpr Duration kDefaultCycle = std::chrono::milliseconds(100);

// A C++ type's size is a multiple of its alignment, so the greatest power of two in the size is
// what a type of that size can have at most; no more than a double's.
std::uint32_t likely_alignment(std::uint64_t payload_bytes) {
  constexpr std::uint64_t kMost = 8;
  return static_cast<std::uint32_t>(std::min(kMost, payload_bytes & (~payload_bytes + 1)));
}

Result<History> history_of(const CreateOptions& options) {
  if (options.life) return History::for_life(*options.life, *options.cycle);
  return History{options.depth, options.cycle.value_or(kDefaultCycle)};
}

}  // namespace

Result<void> run(const CreateOptions& options, Output& out) {
  Result<StreamId> id = StreamId::parse(options.stream);
  if (!id) return std::move(id).error();
  const std::string tried = "create '" + id->str() + "'";
  const Result<History> history = history_of(options);
  if (!history) return Error(history.error()).context(tried);
  TypeInfo type;
  type.name = options.type;
  type.payload_bytes = options.payload_bytes;
  type.alignment_bytes =
      options.alignment_bytes ? options.alignment_bytes : likely_alignment(options.payload_bytes);

  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  StreamId wanted = *id;
  if (wanted.host.empty()) {  // created here, whatever other hosts have
    const Result<DaemonInfo> daemon = session->daemon_info();
    if (!daemon) return daemon.error();
    wanted.host = daemon->host;
  }
  const bool there = session->stream_info(wanted).has_value();
  Result<RawWriter> writer = session->create_raw(*id, type, *history);
  if (!writer) return std::move(writer).error();
  // Not the writer's own figures: for another host's stream those of a ring on the way there.
  const Result<StreamInfo> stream = session->stream_info(writer->id());
  if (!stream) return stream.error();
  if (options.json) {
    out.add(json_document({{"stream", stream->id.str()},
                           {"created", !there},
                           {"payload_bytes", stream->type.payload_bytes},
                           {"depth", stream->depth},
                           {"cycle_ns", to_ns(stream->cycle)}}));
  } else {
    out.add(escaped(stream->id.str()) +
            (there ? ": exists already, kept with " : ": created with ") +
            std::to_string(stream->depth) + " slots of " + bytes_text(stream->type.payload_bytes) +
            "\n");
  }
  return {};
}

// Removes as many as it can; the message then names all that failed.
Result<void> run(const RmOptions& options, Output& out) {
  std::vector<StreamId> ids;
  for (const std::string& text : options.streams) {
    Result<StreamId> id = StreamId::parse(text);
    if (!id) return std::move(id).error();
    ids.push_back(std::move(*id));
  }
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  Json removed = Json::array();
  std::optional<Error> failure;
  for (const StreamId& id : ids) {
    if (Result<void> result = session->remove(id); result) {
      removed.push_back(id.str());
    } else {
      Error error = with_similar_names(std::move(result).error(), *session, id);
      if (failure) error.message.insert(0, failure->message + "; and ");
      failure = std::move(error);
    }
  }
  if (options.json) out.add(json_document({{"removed", std::move(removed)}}));
  if (failure) return std::move(*failure);
  return {};
}

}  // namespace dssm::ctl
