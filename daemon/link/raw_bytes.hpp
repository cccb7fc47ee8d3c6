// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <memory>
#include <span>

namespace dssm::daemon {

// Bytes on the heap that are not filled with zeros first: for large ones the system need not even
// provide memory before it is written to. One owner; may be moved.
class RawBytes {
 public:
  RawBytes() = default;
  explicit RawBytes(std::size_t size)
      : bytes_(std::make_unique_for_overwrite<std::byte[]>(size)), size_(size) {}

  // A copy of `bytes`.
  static RawBytes copy_of(std::span<const std::byte> bytes) {
    RawBytes copy(bytes.size());
    std::copy(bytes.begin(), bytes.end(), copy.bytes_.get());
    return copy;
  }

  std::span<std::byte> span() noexcept { return {bytes_.get(), size_}; }
  std::span<const std::byte> span() const noexcept { return {bytes_.get(), size_}; }
  std::byte* data() noexcept { return bytes_.get(); }
  std::size_t size() const noexcept { return size_; }

 private:
  std::unique_ptr<std::byte[]> bytes_;
  std::size_t size_ = 0;
};

}  // namespace dssm::daemon
