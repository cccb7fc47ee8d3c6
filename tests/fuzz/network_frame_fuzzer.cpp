// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes from a peer, through the decoder of the network protocol. Its output must not
// depend on how the bytes are split or on a sink that pauses it, and must equal protobuf's output.
// An input's first two bytes choose the payload size, how the bytes are split, and when the sink
// pauses.
#include <cstdlib>
#include <optional>

#include "core/wire/network_protocol.hpp"
#include "core/wire/varint.hpp"
#include "tests/fuzz/fuzzer.hpp"
#include "tests/unit/core/wire/recorder.hpp"

namespace dssm::wire {
namespace {

constexpr std::size_t kMaxFrame = 1 << 16;
constexpr std::size_t kPayloadSizes[] = {24, 0, 1, 33'000};  // the last one is received in place

struct Outcome {
  std::vector<std::string> log;
  bool refused = false;
};

// hold_every: the sink pauses at every hold_every-th callback; 0: never.
Outcome decode(std::string_view bytes, std::size_t payload_bytes, std::size_t at_most,
               unsigned hold_every) {
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  recorder.decoder = &decoder;
  decoder.set_payload_bytes(payload_bytes);
  unsigned calls = 0;
  bool held = false;
  recorder.holds = [&] { return held = hold_every > 0 && ++calls % hold_every == 0; };
  const Result<void> fed =
      feed(decoder, bytes, at_most, [&] { return std::exchange(held, false); });
  return {recorder.log, !fed};
}

// The entry of Recorder's log for one frame, decoded by protobuf; nullopt: not a message.
std::optional<std::string> entry_of(const std::byte* bytes, std::size_t size) {
  net::Frame frame;
  if (!frame.ParseFromArray(bytes, static_cast<int>(size))) return std::nullopt;
  if (!frame.has_sample() && frame.payload().empty()) return "frame " + frame.SerializeAsString();
  const net::Sample& sample = frame.sample();
  return "sample " + std::to_string(frame.serial()) + "/" + std::to_string(sample.tid()) + "/" +
         std::to_string(sample.time_ns()) + "/" + std::to_string(sample.clock_error_ns()) +
         (frame.torn() ? " torn " : " ") + frame.payload();
}

std::vector<std::string> log_of_protobuf(std::string_view input) {
  std::vector<std::string> log;
  const auto* at = reinterpret_cast<const std::byte*>(input.data());
  const std::byte* const end = at + input.size();
  std::uint64_t length = 0;
  while (read_varint(at, end, kMaxLengthBytes, length) == VarintStatus::ok &&
         length <= static_cast<std::uint64_t>(end - at)) {
    const std::optional<std::string> entry = entry_of(at, static_cast<std::size_t>(length));
    if (!entry) break;
    log.push_back(*entry);
    at += length;
  }
  return log;
}

void run(std::string_view input) {
  if (input.size() < 2) return;
  const auto choice = static_cast<unsigned char>(input[0]);
  const std::size_t cut = 1 + static_cast<unsigned char>(input[1]);
  const std::size_t payload_bytes = kPayloadSizes[choice % 4];
  input.remove_prefix(2);

  const Outcome whole = decode(input, payload_bytes, SIZE_MAX, 0);
  const unsigned every = choice / 4 % 8;  // a sink that always pauses makes no progress
  const Outcome in_pieces = decode(input, payload_bytes, cut, every == 1 ? 0 : every);
  if (whole.log != in_pieces.log || whole.refused != in_pieces.refused) std::abort();

  const std::vector<std::string> log = log_of_protobuf(input);
  if (whole.log.size() > log.size()) std::abort();
  if (!std::equal(whole.log.begin(), whole.log.end(), log.begin())) std::abort();
  if (!whole.refused && whole.log.size() != log.size()) std::abort();
}

}  // namespace
}  // namespace dssm::wire

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) {
  dssm::wire::run({reinterpret_cast<const char*>(input.data()), input.size()});
}
