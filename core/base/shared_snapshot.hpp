// SPDX-License-Identifier: Apache-2.0
//
// A value in shared memory that one writer replaces as a whole while any number of processes read
// it.
//
//   off            size       field
//     0               8       generation: how often the value was stored; 0: never
//     8       sizeof(T)       record 0, as 8-byte words
//     8 + sizeof(T)   sizeof(T)  record 1
//
// Record `generation % 2` holds the current value. The writer fills the other record and then
// raises the generation; readers copy the current record and check that the generation is still the
// same.
//
//   * Readers never see a mix of two values. Each word is stored with release and loaded with
//     acquire. A reader that loads a word of a later value therefore also sees the generation that
//     was current when that value was written, which is not the one that it began with, and it
//     tries again.
//   * Readers never wait. Only two complete stores during one copy make a reader try again, and it
//     tries kMaxTries times. An honest writer that stores some times a second never gets that far.
//   * A writer that is killed at any instruction leaves the previous value, or the new one. The
//     next writer continues from the generation that it finds; what the dead one left in the other
//     record is overwritten.
//   * Readers do not trust the writer. They copy each word once, from memory whose size is fixed,
//     and give up after kMaxTries. The values themselves can be anything: the user of T checks
//     them, and T has no member of which a bit pattern is invalid (no bool, no pointer;
//     enumerations have a fixed underlying type).
//
//   threads  one writer at a time: the caller sees to that, across processes too; any readers.
//            All functions are async-signal-safe.
//   memory   all zero is a snapshot in which nothing was stored. It is never constructed in place:
//            the memory is mapped.
#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

namespace dssm {

template <class T>
class SharedSnapshot {
  static_assert(std::is_trivially_copyable_v<T> && std::is_standard_layout_v<T>);
  static_assert(sizeof(T) % 8 == 0 && std::atomic<std::uint64_t>::is_always_lock_free);

 public:
  static constexpr int kMaxTries = 1000;

  // Whether a value was ever stored; one load.
  bool is_set() const noexcept { return generation_.load(std::memory_order_relaxed) != 0; }

  // Changes with each store; one load. Acquire: what load() copies after it is at least as new.
  std::uint64_t generation() const noexcept { return generation_.load(std::memory_order_acquire); }

  // Copies the current value, or only the first `bytes` of it.
  //   returns  its generation; 0: nothing was stored, or the writer stored again during each of
  //            kMaxTries copies. Then `out` is unchanged
  template <std::size_t bytes = sizeof(T)>
  std::uint64_t load(T& out) const noexcept {
    static_assert(bytes % 8 == 0 && bytes <= sizeof(T));
    constexpr std::make_index_sequence<bytes / 8> kWords;
    std::array<std::uint64_t, bytes / 8> copy;
    for (int i = 0; i < kMaxTries; ++i) {
      // Acquire: pairs with the release store of the generation in store(), so that the words of
      // this generation are visible.
      const std::uint64_t before = generation_.load(std::memory_order_acquire);
      if (before == 0) return 0;
      const auto& record = records_[before % 2];
      // Acquire: pairs with the release stores of the words in store(), so that the generation
      // below is not older than the newest word.
      for_each(kWords, [&](std::size_t word) {
        copy[word] = record[word].load(std::memory_order_acquire);
      });
      if (generation_.load(std::memory_order_relaxed) != before) continue;
      // Word by word, in registers: a processor takes long to load several words at once that were
      // just stored one by one.
      auto* const to = reinterpret_cast<std::byte*>(&out);
      for_each(kWords, [&](std::size_t word) { std::memcpy(to + 8 * word, &copy[word], 8); });
      return before;
    }
    return 0;
  }

  // Replaces the value. Only the writer.
  void store(const T& value) noexcept {
    std::array<std::uint64_t, sizeof(T) / 8> words;
    std::memcpy(words.data(), &value, sizeof value);
    const std::uint64_t next = generation_.load(std::memory_order_relaxed) + 1;
    auto& record = records_[next % 2];
    // Release: pairs with the acquire loads of the words in load().
    for (std::size_t word = 0; word < words.size(); ++word) {
      record[word].store(words[word], std::memory_order_release);
    }
    // Release: pairs with the first acquire load in load() and with generation().
    generation_.store(next, std::memory_order_release);
  }

 private:
  // Without a loop, so that `use` works in registers.
  template <std::size_t... word, class Use>
  static void for_each(std::index_sequence<word...>, Use use) noexcept {
    (use(word), ...);
  }

  std::atomic<std::uint64_t> generation_;
  std::atomic<std::uint64_t> records_[2][sizeof(T) / 8];
};

}  // namespace dssm
