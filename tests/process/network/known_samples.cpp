// SPDX-License-Identifier: Apache-2.0
#include "tests/process/network/known_samples.hpp"

#include <cstring>

namespace dssm::test {
namespace {

constexpr std::int64_t kFirstTimeNs = 1'000'000'000'000;

// A pseudo-random number computed from `number` (splitmix64).
constexpr std::uint64_t mix(std::uint64_t number) {
  number += 0x9e3779b97f4a7c15;
  number = (number ^ (number >> 30)) * 0xbf58476d1ce4e5b9;
  number = (number ^ (number >> 27)) * 0x94d049bb133111eb;
  return number ^ (number >> 31);
}

constexpr std::uint64_t kStep = 0x9e3779b97f4a7c15;  // from word to word; odd

std::uint64_t word_of(std::span<const std::byte> payload, std::size_t index) {
  std::uint64_t word = 0;
  std::memcpy(&word, payload.data() + 8 * index, 8);
  return word;
}

}  // namespace

SampleInfo KnownStream::info(Tid tid) const {
  const std::uint64_t random = mix(number * 1'000'003 + static_cast<std::uint64_t>(tid));
  const std::int64_t wander_ns =
      jitter.count() > 0
          ? static_cast<std::int64_t>(random % (2 * static_cast<std::uint64_t>(jitter.count()))) -
                jitter.count()
          : 0;
  return {tid, time_from_ns(kFirstTimeNs + tid * cycle.count() + wander_ns),
          Duration(static_cast<std::int64_t>(random >> 40))};
}

void KnownStream::fill(std::span<std::byte> payload, std::uint64_t life, Tid tid) const {
  std::memcpy(payload.data(), &life, 8);
  std::uint64_t word = mix(mix(number ^ (life << 20)) ^ static_cast<std::uint64_t>(tid));
  for (std::size_t at = 8; at + 8 <= payload.size(); at += 8) {
    std::memcpy(payload.data() + at, &word, 8);
    word += kStep;
  }
}

std::uint64_t KnownStream::life(std::span<const std::byte> payload) { return word_of(payload, 0); }

std::string KnownStream::fault(std::span<const std::byte> payload, const SampleInfo& info,
                               std::uint64_t life) const {
  const auto sample = [&] { return "'" + id.str() + "' tid " + std::to_string(info.tid) + ": "; };
  const Tid tid =
      is_played ? (to_ns(info.time) - kFirstTimeNs + cycle.count() / 2) / cycle.count() : info.tid;
  const SampleInfo right = this->info(tid);
  if (info.time != right.time) {
    return sample() + "time " + std::to_string(to_ns(info.time)) + " instead of " +
           std::to_string(to_ns(right.time));
  }
  if (info.clock_error != right.clock_error) {
    return sample() + "clock_error " + std::to_string(to_ns(info.clock_error)) + " instead of " +
           std::to_string(to_ns(right.clock_error));
  }
  if (KnownStream::life(payload) != life) {
    return sample() + "of life " + std::to_string(KnownStream::life(payload)) + " instead of " +
           std::to_string(life);
  }
  std::uint64_t word = mix(mix(number ^ (life << 20)) ^ static_cast<std::uint64_t>(tid));
  for (std::size_t index = 1; index < payload.size() / 8; ++index, word += kStep) {
    if (word_of(payload, index) != word) {
      return sample() + "word " + std::to_string(index) + " is " +
             std::to_string(word_of(payload, index)) + " instead of " + std::to_string(word);
    }
  }
  return {};
}

}  // namespace dssm::test
