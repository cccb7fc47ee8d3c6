// SPDX-License-Identifier: Apache-2.0
//
// TCP sockets as DSSM uses them: non-blocking, close-on-exec, without Nagle's delay, and with a
// kernel that notices when the other PC is gone, so that idle channels need no heartbeats of their
// own. How soon depends on the end:
//
//   the end that connected  3 s (keep-alive probes, and TCP_USER_TIMEOUT for what was sent):
//                           mirrors and remote writers want to know, and begin anew.
//   the end that accepted   30 s. Linux counts a receiver whose window stays closed like one that
//                           is gone. A program that looks at its subscription every few seconds is
//                           not to be cut off for it; one that takes nothing for 30 s is, and
//                           resumes where it was when it looks again.
#pragma once

#include <dssm/result.hpp>
#include <memory>

#include "core/base/unique_fd.hpp"
#include "core/wire/address.hpp"
#include "core/wire/transport.hpp"

namespace dssm::wire {

// Listens at `address`; IPv6 sockets take IPv6 only, so that "0.0.0.0" and "::" go side by side.
// Non-blocking; SO_REUSEADDR, so that a restarted dssmd gets its port back.
//   fails  with what to do: the port is taken (by whom is for `ss -ltnp`), no such address here
Result<UniqueFd> listen_tcp(const SocketAddress& address);

// The address that a socket is bound to (after listening on port 0), or connected to.
Result<SocketAddress> local_address(int socket);
Result<SocketAddress> peer_address(int socket);  // IPv4 as such, also over a socket of IPv6

// Whether connections over IPv4 arrive at this listening socket of "::", too, as at one that
// systemd made with its defaults.
bool takes_ipv4_too(int socket) noexcept;

// Begins to connect; the socket becomes writable when it is done or failed, then ask
// finish_connect(). Sets the options of the end that connected.
Result<UniqueFd> start_connect(const SocketAddress& address);

// How connecting ended; the error says whom and why ("connect to '10.0.0.2:13776': Connection
// refused; is dssmd running there, and does it listen on that address?").
Result<void> finish_connect(int socket, const SocketAddress& address);

// Sets the options of the end that accepted.
void set_channel_options(int socket) noexcept;

// A transport over a connected socket; takes it over.
std::unique_ptr<Transport> make_tcp_transport(UniqueFd socket);

}  // namespace dssm::wire
