// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/description.hpp"

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"

namespace dssm::daemon {

void describe(const Stream& stream, const OpenTable& opens, proto::Stream& out) {
  StreamInfo info = stream.info();
  const OpenTable::Counts counts = opens.counts(stream);
  info.writers = counts.writers;
  info.readers = counts.readers;
  wire::to_message(info, out);
}

void describe_with_users(const Stream& stream, const OpenTable& opens, proto::Stream& out) {
  describe(stream, opens, out);
  for (const StreamUser& user : opens.users(stream)) {
    proto::User& message = *out.add_users();
    message.set_pid(user.pid);
    message.set_uid(user.uid);
    message.set_program(user.program);
    message.set_writer(user.role == Role::writer);
  }
}

void describe_all(const Registry& registry, const OpenTable& opens, std::size_t max_bytes,
                  proto::StreamList& out) {
  std::size_t bytes = 0;
  for (const std::shared_ptr<Stream>& stream : registry.streams()) {
    proto::Stream& entry = *out.add_streams();
    describe(*stream, opens, entry);
    bytes += entry.ByteSizeLong();
    if (bytes <= max_bytes) continue;
    bytes -= entry.ByteSizeLong();
    entry.mutable_type()->clear_fields();
    bytes += entry.ByteSizeLong();
  }
}

Result<std::string> property_of(const Stream& stream) {
  std::string property = DSSM_TRY(stream.property(), "stream '" + stream.id().str() + "'");
  if (!property.empty()) return property;
  return Error{Errc::not_found, "stream '" + stream.id().str() +
                                    "' has no property set; `dssmctl property set` sets one"};
}

}  // namespace dssm::daemon
