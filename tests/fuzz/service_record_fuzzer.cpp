// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary TXT records of a service: accepted, or refused with a message. An accepted record is
// within the limits, and encoding it again gives the same record. The input is a record in network
// format: strings, each after a byte with its length.
#include <algorithm>
#include <cstdlib>

#include "core/base/text.hpp"
#include "daemon/fleet/service_record.hpp"
#include "tests/fuzz/fuzzer.hpp"

namespace dssm::daemon {
namespace {

void require(bool holds) {
  if (!holds) std::abort();
}

// No mDNS message is longer (RFC 6762 section 17). Of more, this itself would take much memory: 64
// bytes and more for each empty string.
constexpr std::size_t kMaxMessageBytes = 9000;

TxtRecord txt_from(std::string_view bytes) {
  bytes = bytes.substr(0, kMaxMessageBytes);
  TxtRecord txt;
  while (!bytes.empty()) {
    const std::size_t length = static_cast<unsigned char>(bytes.front());
    bytes.remove_prefix(1);
    const std::string_view string = bytes.substr(0, length);
    bytes.remove_prefix(string.size());
    const std::size_t equals = std::min(string.find('='), string.size());
    txt.emplace_back(string.substr(0, equals), string.substr(std::min(equals + 1, string.size())));
  }
  return txt;
}

void run(std::string_view bytes) {
  const Result<ServiceRecord> record = service_record_untrusted(txt_from(bytes));
  if (!record) {
    require(record.error().code == Errc::protocol && is_utf8(record.error().message));
    return;
  }
  require(record->instance().size() <= kMaxInstanceBytes);
  // A byte takes at most four characters ("\195"), and a label has at most 32 bytes.
  require(record->subtype().size() <= 4 * 32 + std::string_view("._sub._dssm._tcp").size());
  std::size_t txt_bytes = 0;
  for (const auto& [key, value] : record->txt()) {
    require(key.size() + 1 + value.size() <= 255);
    txt_bytes += 2 + key.size() + value.size();
  }
  require(txt_bytes <= 400);
  const Result<ServiceRecord> again = service_record_untrusted(record->txt());
  require(again && *again == *record);
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) {
  dssm::daemon::run({reinterpret_cast<const char*>(input.data()), input.size()});
}
