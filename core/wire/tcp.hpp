// SPDX-License-Identifier: Apache-2.0
//
// TCP sockets as DSSM uses them: non-blocking, close-on-exec, without Nagle's delay. Keep-alive
// probes let the kernel detect a PC that no longer answers, so that idle channels need no heartbeat
// of their own. How soon depends on the end:
//
//   connected  3 s (keep-alive probes, and TCP_USER_TIMEOUT for sent bytes). The dialer of dssmd
//              sets 30 s as for the other end: heartbeats of the control connection detect a dead
//              host, and an owner that pauses a remote writer must not lose it.
//   accepted   30 s. Linux treats a receiver whose window stays closed like one that does not
//              answer. A program that reads its subscription every few seconds must not be
//              disconnected for that; one that reads nothing for 30 s is, and resumes at the next
//              read.
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <string>

#include "core/base/unique_fd.hpp"
#include "core/wire/address.hpp"
#include "core/wire/transport.hpp"

namespace dssm::wire {

// Listens at `address`; IPv6 sockets take IPv6 only, so that "0.0.0.0" and "::" do not conflict.
// Non-blocking; SO_REUSEADDR, so that a restarted dssmd gets its port back.
//   fails  with what to do: the port is taken (`ss -ltnp` shows by which process), no such address
Result<UniqueFd> listen_tcp(const SocketAddress& address);

// The address that a socket is bound to (after listening on port 0), or connected to.
Result<SocketAddress> local_address(int socket);
Result<SocketAddress> peer_address(int socket);  // IPv4 as such, also over a socket of IPv6

// Whether this listening socket of "::" also accepts connections over IPv4, as one that systemd
// made with its defaults does.
bool takes_ipv4_too(int socket) noexcept;

// The interface of this PC that packets to `address` take, if it has no carrier: a cable is not
// plugged in, Wi-Fi is not connected. A packet that is sent then is not only lost: the kernel asks
// for the other side's hardware address once a second (arp(7), retrans_time_ms), so for up to a
// second after the carrier is back nothing gets there. Empty: there is a carrier, or it is not
// known. Sends nothing.
std::string interface_without_carrier(const SocketAddress& address);

// Begins to connect; the socket becomes writable when that succeeded or failed: then call
// finish_connect(). Sets the options of the connected end.
Result<UniqueFd> start_connect(const SocketAddress& address);

// The result of connecting; the error names the address and the reason ("connect to
// '10.0.0.2:13776': Connection refused; is dssmd running there, and does it listen on that
// address?").
Result<void> finish_connect(int socket, const SocketAddress& address);

// Sets the options of the accepted end.
void set_channel_options(int socket) noexcept;

// When the socket is closed, what waits to be sent is given up. Else the kernel tries to send it
// for up to 30 s, and looks for a host that is not there.
void discard_output_at_close(int socket) noexcept;

// The transport over a connected or accepted socket, for both ends of a connection; for the
// accepted end it sets the socket's options.
std::unique_ptr<Transport> make_transport(UniqueFd socket, TransportEnd end);

}  // namespace dssm::wire
