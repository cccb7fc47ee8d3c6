// SPDX-License-Identifier: Apache-2.0
//
// Shared by both ends of the local socket: version, limits, and sending and receiving bytes with
// file descriptors. docs/architecture.md; the messages are in proto/local.proto.
#pragma once

#include <cstddef>
#include <dssm/result.hpp>
#include <span>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/messages.hpp"
#include "core/wire/request_size.hpp"
#include "core/wire/transport.hpp"
#include "local.pb.h"

namespace dssm::wire {

inline constexpr std::uint32_t kLocalProtocolVersion = 1;
inline constexpr std::size_t kMaxLocalRequestBytes = kMaxPropertyBytes + kMaxRequestBytes;
inline constexpr std::size_t kMaxLocalFrameBytes = 17U << 20;  // a list of all streams
inline constexpr const char* kDefaultSocketPath = "/run/dssm/dssmd.sock";

// More descriptors in one message are a protocol error of the sender. We never send more than 4.
inline constexpr std::size_t kMaxFdsPerMessage = 16;

// Sends as much of `bytes` as the socket takes, with `fds` attached to the first byte (when at
// least one byte was sent, they were sent). SIGPIPE is suppressed; a closed connection is `end`.
Result<IoResult> send_some(int socket, std::span<const std::byte> bytes, std::span<const int> fds);

// Receives up to space.size() bytes; descriptors that came along are appended to `fds`,
// close-on-exec. Fails with `protocol` when the kernel dropped some of them.
//   flags  MSG_PEEK: bytes and descriptors stay in the socket as well
Result<IoResult> recv_some(int socket, std::span<std::byte> space, std::vector<UniqueFd>& fds,
                           int flags = 0);

// Creates a Unix stream socket connected to `path`, close-on-exec and blocking.
//   fails  no_daemon (no such socket, or no process listens), no_permission, invalid_argument (path
//          is longer than the 107 bytes that an address takes)
Result<UniqueFd> connect_unix(const std::string& path);

}  // namespace dssm::wire
