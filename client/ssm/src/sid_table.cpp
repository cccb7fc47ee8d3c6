// SPDX-License-Identifier: Apache-2.0
#include "sid_table.hpp"

#include "process.hpp"

namespace dssm::ssm {

static_assert(sizeof(SSM_sid) == 8, "a sid holds a place and a generation: 46 bits");

std::uint64_t SidTable::generation(SSM_sid sid) noexcept {
  return reinterpret_cast<std::uintptr_t>(sid) >> kIndexBits;
}

SidPlace* SidTable::place(SSM_sid sid) const noexcept {
  const std::uint64_t number = reinterpret_cast<std::uintptr_t>(sid);
  if (number >> (kIndexBits + kGenerationBits)) return nullptr;  // not one of ours
  const std::uint64_t index = number & ((1ULL << kIndexBits) - 1);
  SidPlace* const chunk = chunks_[index / kChunk].load(std::memory_order_acquire);
  return chunk ? &chunk[index % kChunk] : nullptr;
}

SSM_sid SidTable::add(std::unique_ptr<Stream> stream, std::uint64_t process_generation) {
  if (!free_) {
    if (used_ == std::uint64_t{1} << kIndexBits) return nullptr;
    SidPlace* const chunk = new SidPlace[kChunk];
    for (std::uint64_t i = kChunk; i-- > 0;) {
      chunk[i].index = used_ + i;
      chunk[i].next_free = std::exchange(free_, &chunk[i]);
    }
    chunks_[used_ / kChunk].store(chunk, std::memory_order_release);
    used_ += kChunk;
  }
  SidPlace& place = *free_;
  free_ = place.next_free;
  place.stream = stream.release();
  place.made_in = process_generation;
  std::uint64_t next = (place.state.load() >> 1) + 1;
  if (next >> kGenerationBits) next = 1;
  place.state.store(next << 1 | 1);
  // NOLINTNEXTLINE(performance-no-int-to-ptr): a number in the type of SSM's API
  return reinterpret_cast<SSM_sid>(next << kIndexBits | place.index);
}

void SidTable::close(SSM_sid sid) noexcept {
  SidPlace* const found = place(sid);
  if (!found) return;
  std::uint64_t open = generation(sid) << 1 | 1;
  if (found->state.compare_exchange_strong(open, open & ~std::uint64_t{1})) ::sem_post(&wake_);
}

template <class Visit>
void SidTable::for_each(Visit visit) noexcept {
  for (std::uint64_t i = 0; i < used_; ++i) {
    visit(chunks_[i / kChunk].load(std::memory_order_relaxed)[i % kChunk]);
  }
}

void SidTable::reap(std::uint64_t process_generation) {
  for_each([&](SidPlace& place) {
    if (!place.stream || (place.state.load() & 1) || place.users.load() > 0) return;
    Stream* const stream = std::exchange(place.stream, nullptr);
    if (place.made_in == process_generation) {
      delete stream;
    } else {
      stream->next_abandoned = std::exchange(abandoned_, stream);
    }
    place.next_free = std::exchange(free_, &place);
  });
}

void SidTable::reset_after_fork() noexcept {
  for_each([](SidPlace& place) {
    if (place.stream) place.stream->reset_after_fork();
  });
}

void SidTable::leave(SidPlace& place) noexcept {
  if (place.users.fetch_sub(1) == 1 && (place.state.load() & 1) == 0) ::sem_post(&wake_);
}

SidUse::SidUse(SSM_sid sid) noexcept : table_(process().sids()), place_(table_.place(sid)) {
  if (!place_) return;
  place_->users.fetch_add(1);
  if (place_->state.load() == (SidTable::generation(sid) << 1 | 1)) return;
  table_.leave(*place_);
  place_ = nullptr;
}

SidUse::~SidUse() {
  if (place_) table_.leave(*place_);
}

}  // namespace dssm::ssm
