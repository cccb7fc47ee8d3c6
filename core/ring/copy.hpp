// SPDX-License-Identifier: Apache-2.0
//
// Copies payloads into and out of a slot that the other side may access at the same time, with the
// fences around such a copy. There are three forms (docs/ring-layout.md "Copying a payload" proves
// them):
//
//   plain            memcpy between fences; data that was overwritten meanwhile is discarded after
//                    the check of the sequence. Sound on x86-64 and AArch64.
//   large            from kLargeBytes on, memcpy may use non-temporal stores and string
//                    instructions, which x86's usual ordering of stores does not cover: the writer
//                    adds store fences before and after.
//   ThreadSanitizer  words as atomics, release stores and acquire loads: it cannot see fences, and
//                    reports no race for these.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__SANITIZE_THREAD__)
#define DSSM_TSAN 1
#elif defined(__has_feature)
#if __has_feature(thread_sanitizer)
#define DSSM_TSAN 1
#endif
#endif

namespace dssm::ring {

// Below this size no known memcpy uses anything but ordinary loads and stores (glibc's
// x86_rep_movsb_threshold starts at 2048, its non-temporal threshold is far above).
inline constexpr std::size_t kLargeBytes = 2048;

#if defined(DSSM_TSAN)

namespace detail {
template <class Word>
void store_words(std::byte*& to, const std::byte*& from, std::size_t& bytes) noexcept {
  for (; bytes >= sizeof(Word); bytes -= sizeof(Word), to += sizeof(Word), from += sizeof(Word)) {
    Word word;
    std::memcpy(&word, from, sizeof word);
    std::atomic_ref<Word>(*reinterpret_cast<Word*>(to)).store(word, std::memory_order_release);
  }
}
template <class Word>
void load_words(std::byte*& to, const std::byte*& from, std::size_t& bytes) noexcept {
  for (; bytes >= sizeof(Word); bytes -= sizeof(Word), to += sizeof(Word), from += sizeof(Word)) {
    auto& slot_word = *reinterpret_cast<Word*>(const_cast<std::byte*>(from));
    const Word word = std::atomic_ref<Word>(slot_word).load(std::memory_order_acquire);
    std::memcpy(to, &word, sizeof word);
  }
}
}  // namespace detail

inline void fence_before_filling(bool) noexcept {}
inline void fence_after_filling(bool) noexcept {}
inline void fence_after_copying_out() noexcept {}

inline constexpr std::memory_order kProbe = std::memory_order_acquire;
inline void fence_after_probing() noexcept {}

// Each store is a release: a reader that sees a word also sees the odd sequence stored before it.
inline void copy_in(std::byte* slot, const std::byte* from, std::size_t bytes) noexcept {
  detail::store_words<std::uint64_t>(slot, from, bytes);
  detail::store_words<std::uint8_t>(slot, from, bytes);
}

// Each load is an acquire: the sequence is loaded after all of them; pairs with copy_in().
inline void copy_out(std::byte* to, const std::byte* slot, std::size_t bytes) noexcept {
  detail::load_words<std::uint64_t>(to, slot, bytes);
  detail::load_words<std::uint8_t>(to, slot, bytes);
}

#else

// Orders all stores before it before all stores after it, including non-temporal ones.
inline void store_fence() noexcept {
#if defined(__x86_64__)
  __builtin_ia32_sfence();
#else
  std::atomic_thread_fence(std::memory_order_release);
#endif
}

// After the odd sequence, before the first byte of the payload: no reader sees new bytes under the
// old even sequence. Pairs with fence_after_copying_out().
inline void fence_before_filling(bool large) noexcept {
  std::atomic_thread_fence(std::memory_order_release);
  if (large) store_fence();
}

// After the last byte, before the even sequence. The release store of the sequence orders ordinary
// stores; a large copy may have used others.
inline void fence_after_filling(bool large) noexcept {
  if (large) store_fence();
}

// After the last byte was read, before the sequence is loaded again.
inline void fence_after_copying_out() noexcept {
  std::atomic_thread_fence(std::memory_order_acquire);
}

// A search loads many entries of the time index, then passes one fence before it loads `top` again.
// Pairs with the release store to the index in SlotWriter::store().
inline constexpr std::memory_order kProbe = std::memory_order_relaxed;
inline void fence_after_probing() noexcept { std::atomic_thread_fence(std::memory_order_acquire); }

inline void copy_in(std::byte* slot, const std::byte* from, std::size_t bytes) noexcept {
  std::memcpy(slot, from, bytes);
}
inline void copy_out(std::byte* to, const std::byte* slot, std::size_t bytes) noexcept {
  std::memcpy(to, slot, bytes);
}

#endif

}  // namespace dssm::ring
