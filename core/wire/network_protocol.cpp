// SPDX-License-Identifier: Apache-2.0
//
// The greeting: the first frame of both ends, and how it is checked. Texts that a peer sends are
// shown in logs and tables, so they are short and hold no control characters.
#include "core/wire/network_protocol.hpp"

#include <sys/random.h>

#include <algorithm>
#include <cstring>

#include "core/base/text.hpp"

namespace dssm::wire {
namespace {

Error bad(const std::string& who, std::string_view why) {
  return Error{Errc::protocol, who + " greets with " + std::string(why)};
}

// It is not known how old the report is, but after kPeerTimeout the connection would be dead.
std::shared_ptr<const ClockReport> report_of(const proto::ClockReport& clock) {
  return std::make_shared<const ClockReport>(
      clock_report_untrusted(clock, MonoClock::now() - kPeerTimeout));
}

void fill_randomly(void* bytes, std::size_t size) {
  // For up to 256 bytes it neither fails nor fills fewer; early in the boot it waits for entropy.
  while (::getrandom(bytes, size, 0) != static_cast<ssize_t>(size)) {
  }
}

}  // namespace

bool Greeting::has_feature(std::string_view feature) const noexcept {
  return std::find(features.begin(), features.end(), feature) != features.end();
}

std::string Greeting::str() const {
  if (is_dssmd()) return "dssmd of host '" + host + "'";
  return "'" + program + "' on host '" + host + "'";
}

void to_message(const Greeting& greeting, proto::Hello& out) {
  out.set_protocol_version(kNetworkProtocolVersion);
  out.set_host(greeting.host);
  out.set_host_id(greeting.host_id.data(), greeting.host_id.size());
  out.set_instance_id(greeting.instance_id);
  out.set_program(greeting.program);
  out.set_version(greeting.version);
  out.set_pid(greeting.pid);
  for (const std::string& feature : greeting.features) out.add_features(feature);
  if (greeting.clock) send_clock(greeting, *out.mutable_clock());
}

Error other_protocol_version(const std::string& who, std::uint32_t theirs,
                             const std::string& software) {
  return other_protocol_version({"network", kNetworkProtocolVersion}, who, theirs, software);
}

Result<Greeting> greeting_untrusted(const proto::Hello& message, const std::string& who) {
  const bool words_are_good =
      message.program().size() <= kMaxProgramBytes && !has_control(message.program()) &&
      message.version().size() <= kMaxProgramBytes && !has_control(message.version());
  if (message.protocol_version() != kNetworkProtocolVersion) {
    // A later version may use the other fields in another way: only what can be shown is shown.
    return other_protocol_version(who, message.protocol_version(),
                                  words_are_good ? message.version() : std::string());
  }
  Greeting greeting;
  if (!check_host_name(message.host())) {
    return bad(who, "a host name that is not 1 to 31 letters, digits and '-'");
  }
  if (message.host_id().size() != greeting.host_id.size()) {
    return bad(who,
               "a host id of " + std::to_string(message.host_id().size()) + " bytes; it takes 16");
  }
  if (!words_are_good) {
    return bad(who,
               "a program's name or version that is longer than 127 bytes or holds control "
               "characters");
  }
  if (static_cast<std::size_t>(message.features_size()) > kMaxFeatures) {
    return bad(who, "more than 32 features");
  }
  for (const std::string& feature : message.features()) {
    if (feature.empty() || feature.size() > kMaxFeatureBytes || has_control(feature)) {
      return bad(who, "a feature that is empty, longer than 63 bytes or holds control characters");
    }
    greeting.features.push_back(feature);
  }
  greeting.host = message.host();
  std::memcpy(greeting.host_id.data(), message.host_id().data(), greeting.host_id.size());
  greeting.instance_id = message.instance_id();
  greeting.program = message.program();
  greeting.version = message.version();
  greeting.pid = std::max(message.pid(), 0);
  if (message.has_clock()) {
    greeting.clock = report_of(message.clock());
  }
  return greeting;
}

Result<Greeting> server_greeting_untrusted(const net::Frame& frame, const std::string& who) {
  if (frame.has_failure()) return failure(frame.failure()).context("refused by " + who);
  if (!frame.has_hello()) {
    return Error{Errc::protocol, who + " does not begin with Hello; is it a dssmd?"};
  }
  return greeting_untrusted(frame.hello(), who);
}

std::uint64_t random_number() {
  std::uint64_t number = 0;
  while (number == 0) fill_randomly(&number, sizeof number);
  return number;
}

void send_clock(const Greeting& self, proto::ClockReport& out) {
  if (self.clock) to_message(self.clock->at(MonoClock::now()), out);
}

std::shared_ptr<const ClockReport> clock_report_untrusted(const net::Pong& pong) {
  return report_of(pong.clock());
}

}  // namespace dssm::wire
