// SPDX-License-Identifier: Apache-2.0
#include "client/recording/compression.hpp"

#include <fmt/format.h>
#include <lz4frame.h>
#include <zstd.h>

namespace dssm::recording {
namespace {

Error damaged(std::string_view what) {
  return {Errc::protocol, fmt::format("decompress a chunk: {}", what)};
}

struct FreeLz4 {
  void operator()(LZ4F_dctx* context) const noexcept { LZ4F_freeDecompressionContext(context); }
};

}  // namespace

std::string_view name_of(Compression compression) noexcept {
  switch (compression) {
    case Compression::lz4:
      return "lz4";
    case Compression::zstd:
      return "zstd";
    case Compression::none:
      break;
  }
  return "";
}

Compressor::Compressor(Compression compression) : compression_(compression) {
  if (compression == Compression::zstd) zstd_ = ZSTD_createCCtx();
  if (compression == Compression::lz4) {
    (void)LZ4F_createCompressionContext(&lz4_, LZ4F_VERSION);  // null on failure
  }
}

Compressor::~Compressor() {
  ZSTD_freeCCtx(zstd_);
  LZ4F_freeCompressionContext(lz4_);
}

bool Compressor::compress(std::span<const std::byte> bytes, Buffer& out) {
  if (bytes.empty()) return false;
  if (zstd_ != nullptr) {
    out.resize(bytes.size() - 1);  // what does not fit is not shorter
    const std::size_t length =
        ZSTD_compressCCtx(zstd_, out.data(), out.size(), bytes.data(), bytes.size(), kZstdLevel);
    if (ZSTD_isError(length) != 0) return false;
    out.resize(length);
    return true;
  }
  if (lz4_ != nullptr) {
    LZ4F_preferences_t preferences{};
    // The least one that is enough: a reader's memory is twice the size of a block.
    preferences.frameInfo.blockSizeID = bytes.size() <= 64U << 10    ? LZ4F_max64KB
                                        : bytes.size() <= 256U << 10 ? LZ4F_max256KB
                                        : bytes.size() <= 1U << 20   ? LZ4F_max1MB
                                                                     : LZ4F_max4MB;
    preferences.frameInfo.contentSize = bytes.size();
    preferences.autoFlush = 1;
    out.resize(LZ4F_compressFrameBound(bytes.size(), &preferences));
    std::size_t length = 0;
    const auto add = [&](std::size_t result) {
      if (LZ4F_isError(result) != 0) return false;
      length += result;
      return true;
    };
    const auto end = [&] { return std::pair(out.data() + length, out.size() - length); };
    if (!add(LZ4F_compressBegin(lz4_, end().first, end().second, &preferences)) ||
        !add(LZ4F_compressUpdate(lz4_, end().first, end().second, bytes.data(), bytes.size(),
                                 nullptr)) ||
        !add(LZ4F_compressEnd(lz4_, end().first, end().second, nullptr)) ||
        length >= bytes.size()) {
      return false;
    }
    out.resize(length);
    return true;
  }
  return false;
}

Result<void> decompress(std::string_view compression, std::span<const std::byte> bytes,
                        std::uint64_t original_bytes, Buffer& out) {
  // What a compression can make of a byte at most: a block of LZ4 lengthens a match by 255 with
  // each, one of Zstandard has 4 bytes for 128 KiB. A chunk that claims more gets no memory.
  const std::uint64_t most = compression == "zstd" ? 32768 : compression == "lz4" ? 255 : 1;
  if (original_bytes / most > bytes.size()) return damaged("it claims to have too many bytes");
  out.clear();
  out.resize(original_bytes);
  std::size_t length = 0;
  if (compression.empty()) {
    if (bytes.size() != original_bytes) return damaged("its two lengths differ");
    if (!bytes.empty()) std::memcpy(out.data(), bytes.data(), bytes.size());
    return {};
  }
  if (compression == "zstd") {
    length = ZSTD_decompress(out.data(), out.size(), bytes.data(), bytes.size());
    if (ZSTD_isError(length) != 0) return damaged(ZSTD_getErrorName(length));
  } else if (compression == "lz4") {
    LZ4F_dctx* raw = nullptr;
    if (LZ4F_isError(LZ4F_createDecompressionContext(&raw, LZ4F_VERSION)) != 0) {
      return Error{Errc::no_memory, "decompress a chunk: no memory"};
    }
    const std::unique_ptr<LZ4F_dctx, FreeLz4> context(raw);
    std::size_t taken = 0;
    for (std::size_t wanted = 1; wanted != 0;) {  // 0: the frame is complete
      std::size_t room = out.size() - length, given = bytes.size() - taken;
      wanted = LZ4F_decompress(context.get(), out.data() + length, &room, bytes.data() + taken,
                               &given, nullptr);
      if (LZ4F_isError(wanted) != 0) return damaged(LZ4F_getErrorName(wanted));
      length += room;
      taken += given;
      if (wanted != 0 && room == 0 && given == 0) return damaged("its end is missing");
    }
    if (taken != bytes.size()) return damaged("more bytes follow its end");
  } else {
    return Error{Errc::protocol,
                 fmt::format("the compression '{}' is not known here", compression)};
  }
  if (length != original_bytes) return damaged("it is shorter than it should be");
  return {};
}

}  // namespace dssm::recording
