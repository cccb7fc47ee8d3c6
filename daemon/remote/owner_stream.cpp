// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/owner_stream.hpp"

#include <string>
#include <utility>

#include "core/wire/messages.hpp"
#include "daemon/link/sample_pump.hpp"

namespace dssm::daemon {

Result<StreamInfo> owner_stream_untrusted(const proto::Opened& opened, const StreamId& expected) {
  const Result<StreamId> id = wire::stream_id_untrusted(opened.stream().id());
  if (!id) return id.error();
  if (*id != expected) {
    return Error{Errc::protocol,
                 "it opened '" + id->str() + "' in place of '" + expected.str() + "'"};
  }
  Result<TypeInfo> type = wire::type_untrusted(opened.stream().type());
  if (!type) return std::move(type).error();
  StreamInfo stream = wire::stream_info(opened.stream());
  stream.type = *std::move(type);
  if (stream.cycle <= Duration::zero() || stream.incarnation == 0 || stream.newest < kNoTid ||
      stream.newest > kLastTid) {
    return Error{Errc::protocol, "its description of '" + expected.str() +
                                     "' lacks a cycle or an incarnation, or has no sensible tids"};
  }
  return stream;
}

Error unexpected_frame(const char* what) {
  return {Errc::protocol, std::string(what) + " came, which nobody asked for"};
}

}  // namespace dssm::daemon
