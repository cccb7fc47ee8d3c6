// SPDX-License-Identifier: Apache-2.0
//
// dssmctl create and rm.
#include <fmt/format.h>

#include <bit>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// The cycle of a stream when --cycle is not given; only tools use it.
constexpr Duration kDefaultCycle = std::chrono::milliseconds(100);

// A C++ type's size is a multiple of its alignment, so the greatest power of two in the size is
// what a type of that size can have at most; no more than a double's.
std::uint32_t likely_alignment(std::uint64_t payload_bytes) {
  constexpr std::uint64_t kMaxAlignment = 8;
  return static_cast<std::uint32_t>(std::min(kMaxAlignment, payload_bytes & (~payload_bytes + 1)));
}

Result<History> history_of(const CreateOptions& options) {
  if (options.life) return History::for_life(*options.life, *options.cycle);
  return History{options.depth, options.cycle.value_or(kDefaultCycle)};
}

// A library's error speaks to programs that were compiled with a type.
Error with_advice(Error error, Session& session, const StreamId& id, const TypeInfo& type) {
  if (error.code != Errc::type_mismatch) return error;
  const Result<StreamInfo> existing = session.stream_info(id);
  if (!existing) return error;
  return {error.code, fmt::format("create '{}': it exists with samples of {}, not {}; keep it, or "
                                  "remove it first: dssmctl rm {}",
                                  id.str(), existing->type.str(), type.str(), id.str())};
}

}  // namespace

Result<void> run(const CreateOptions& options, Output& out) {
  StreamId id = DSSM_TRY(StreamId::parse(options.stream));
  const History history = DSSM_TRY(history_of(options), fmt::format("create '{}'", id.str()));
  TypeInfo type;
  type.name = options.type;
  type.payload_bytes = options.payload_bytes;
  type.alignment_bytes =
      options.alignment_bytes ? options.alignment_bytes : likely_alignment(options.payload_bytes);

  Session session = DSSM_TRY(connect(options));
  StreamId wanted = id;
  if (wanted.host.empty()) {  // created here, whatever other hosts have
    const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
    wanted.host = daemon.host;
  }
  const bool there = session.stream_info(wanted).has_value();
  Result<RawWriter> created = session.create_raw(id, type, history, {.keep_existing = true});
  if (!created) return with_advice(std::move(created).error(), session, wanted, type);
  RawWriter writer = *std::move(created);
  // Not the writer's own figures: for another host's stream those of a ring on the way there.
  const StreamInfo stream = DSSM_TRY(session.stream_info(writer.id()));
  if (options.json) {
    out.add(json_document({{"stream", stream.id.str()},
                           {"created", !there},
                           {"payload_bytes", stream.type.payload_bytes},
                           {"depth", stream.depth},
                           {"cycle_ns", to_ns(stream.cycle)}}));
  } else {
    const std::string less =
        stream.depth < history.depth
            ? fmt::format(", fewer than the {} asked for; remove it first to get those",
                          history.depth)
            : "";
    out.add(fmt::format("{}: {} with {} slots of {}{}\n", escaped(stream.id.str()),
                        there ? "exists already, kept" : "created", stream.depth,
                        bytes_text(stream.type.payload_bytes), less));
  }
  return {};
}

// Removes as many as it can; the message then names all that failed.
Result<void> run(const RmOptions& options, Output& out) {
  std::vector<StreamId> ids;
  for (const std::string& text : options.streams) {
    ids.push_back(DSSM_TRY(StreamId::parse(text)));
  }
  Session session = DSSM_TRY(connect(options));
  Json removed = Json::array();
  std::optional<Error> failure;
  for (const StreamId& id : ids) {
    const std::string name = full_name(session, id);
    if (Result<void> result = session.remove(id); result) {
      removed.push_back(name);
      if (!options.json) out.add(fmt::format("{}: removed\n", escaped(name)));
    } else {
      Error error = with_similar_names(std::move(result).error(), session, id);
      if (failure) error.message.insert(0, failure->message + "; and ");
      failure = std::move(error);
    }
  }
  if (options.json) out.add(json_document({{"removed", std::move(removed)}}));
  if (failure) return std::move(*failure);
  return {};
}

}  // namespace dssm::ctl
