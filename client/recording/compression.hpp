// SPDX-License-Identifier: Apache-2.0
//
// The compressions of MCAP's chunks: LZ4 frames and Zstandard.
#pragma once

#include <cstdint>
#include <dssm/recording.hpp>
#include <memory>
#include <span>
#include <string_view>

#include "client/recording/records.hpp"

struct ZSTD_CCtx_s;
struct LZ4F_cctx_s;

namespace dssm::recording {

// As a chunk's field has it: "", "lz4", "zstd".
std::string_view name_of(Compression compression) noexcept;

// Keeps its working memory from chunk to chunk. One thread at a time.
class Compressor {
 public:
  // zstd's 1 is nearly as fast as lz4, on data that does not compress faster.
  static constexpr int kZstdLevel = 1;

  explicit Compressor(Compression compression);
  Compressor(const Compressor&) = delete;
  Compressor& operator=(const Compressor&) = delete;
  ~Compressor();

  Compression compression() const noexcept { return compression_; }

  // Sets `out` to the compressed `bytes`. False when that would not be shorter: `out` is
  // unspecified then.
  bool compress(std::span<const std::byte> bytes, Buffer& out);

 private:
  Compression compression_;
  ZSTD_CCtx_s* zstd_ = nullptr;
  LZ4F_cctx_s* lz4_ = nullptr;
};

// Sets `out` to the original of `bytes`, which has `original_bytes`. Memory: original_bytes, plus a
// fixed amount.
//   fails  protocol, with the reason: another length, damaged, an unknown compression
Result<void> decompress(std::string_view compression, std::span<const std::byte> bytes,
                        std::uint64_t original_bytes, Buffer& out);

}  // namespace dssm::recording
