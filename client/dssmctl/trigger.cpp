// SPDX-License-Identifier: Apache-2.0
//
// dssmctl trigger: asks the black boxes of all hosts to record an incident, by a sample in the
// stream kTriggerStream of each.
#include <fmt/format.h>

#include <algorithm>
#include <thread>

#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Another host's dssmd gets it by then.
constexpr Duration kMaxWait = std::chrono::seconds(3);
constexpr Duration kPollPeriod = std::chrono::milliseconds(20);

// Whether a black box of the stream's host reads it, or its host does not answer.
bool may_be_read(Session& session, const StreamInfo& stream) {
  if (stream.state != StreamState::unknown && stream.readers == 0) return false;
  const Result<StreamInfo> now = session.stream_info(stream.id);
  if (!now || now->state == StreamState::unknown) return true;
  return std::ranges::any_of(now->users, [](const StreamUser& user) {
    return user.role == Role::reader && user.via == StreamVia::local &&
           user.program == kBlackBoxProgram;
  });
}

// Until the sample is in the stream's ring on its host.
Result<void> request(Session& session, const StreamInfo& stream, const TriggerRequest& request) {
  Writer<TriggerRequest> writer = DSSM_TRY(session.open_writer<TriggerRequest>(stream.id.str()));
  if (writer.write(request) == kNoTid) {
    return Error{Errc::unavailable, "another program has held the stream's lock for 2 s"};
  }
  const MonoTime end = deadline_in(kMaxWait);
  while (true) {
    const Result<StreamInfo> now = session.stream_info(stream.id);
    if (now && now->newest > stream.newest) return {};
    if (MonoClock::now() >= end) {
      return Error{Errc::unavailable,
                   fmt::format("host '{}' has not received it for {}; see `dssmctl hosts`",
                               stream.id.host, duration_text(kMaxWait))};
    }
    std::this_thread::sleep_for(kPollPeriod);
  }
}

}  // namespace

Result<void> run(const TriggerOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  std::vector<StreamInfo> recorders = DSSM_TRY(session.list_streams());
  std::erase_if(recorders, [&](const StreamInfo& stream) {
    return stream.id.name != kTriggerStream || !may_be_read(session, stream);
  });
  if (recorders.empty()) {
    return Error{Errc::not_found,
                 "no host has a black box that waits for triggers; is dssm-record.service active "
                 "(`systemctl status dssm-record`), with black_box = true in record.conf?"};
  }
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  TriggerRequest wanted{};
  set_text(wanted.name, options.name);
  set_text(wanted.reason, options.reason);
  set_text(wanted.host, daemon.host);
  Json hosts = Json::array();
  std::vector<std::string> names;
  std::optional<Error> failed;
  for (const StreamInfo& recorder : recorders) {
    if (Result<void> requested = request(session, recorder, wanted); !requested) {
      if (!failed) {
        failed = std::move(requested).error().context(
            fmt::format("trigger the black box of host '{}'", recorder.id.host));
      }
      continue;
    }
    names.push_back(recorder.id.host);
    hosts.push_back(recorder.id.host);
  }
  if (options.json) {
    out.add(json_document({{"trigger", options.name}, {"hosts", hosts}}));
  } else if (!names.empty()) {
    out.add(fmt::format("{}: requested of {}\n", escaped(options.name), list_text(names)));
  }
  if (failed) return *std::move(failed);
  return {};
}

}  // namespace dssm::ctl
