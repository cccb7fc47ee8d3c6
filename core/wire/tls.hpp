// SPDX-License-Identifier: Apache-2.0
//
// TLS 1.3 over another transport, both sides with certificates. First a TlsHandshake; when it is
// done it gives the transport, whose peer() is known. Frames begin after that, so nothing of an
// unknown peer reaches them.
//
// The connecting end may resume the TLS session of an earlier connection (TlsTicket): then neither
// side uses its private key, and no certificate is sent.
//
// send() encrypts straight from the caller's memory, a ring's slot for example, and what it has
// encrypted counts as sent: what the network does not take, at most 64 KiB, waits here
// (has_unsent_output()). receive() fills the spaces as long as there is input, at most 1 MiB; when
// it stops before, it may hold more than fd() shows (has_buffered_input()).
//
// The end of the connection without TLS's closing message is `end` all the same: processes are
// killed and cables are cut, and frames have lengths.
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <optional>

#include "core/wire/tls_credentials.hpp"
#include "core/wire/transport.hpp"

namespace dssm::wire {

class TlsTransport;

// What a TLS client sends first. No frame begins like that: its second byte would be a field 0.
inline constexpr unsigned char kTlsFirstBytes[] = {0x16, 0x03};

// What the connecting end keeps of its last connection to a host, to resume the session: the
// ticket, in which the other side has encrypted all that it needs for that, and who the other side
// is. Empty until a connection ended. It is used only with the credentials that it was received
// with, and while they accept the other side's certificate; the other side does the same. It needs
// a few KiB; TLS limits a ticket to 64 KiB.
//
// A resource with one owner; one thread. Transports write to it until they are destroyed.
class TlsTicket {
 public:
  TlsTicket() = default;
  TlsTicket(const TlsTicket&) = delete;
  TlsTicket& operator=(const TlsTicket&) = delete;
  ~TlsTicket();

 private:
  friend class TlsTransport;
  std::weak_ptr<const TlsCredentials> credentials_;
  ssl_session_st* session_ = nullptr;
  std::optional<CertifiedPeer> peer_;
};

// A resource with one owner; one thread. It never waits, and has no time limit of its own.
class TlsHandshake {
 public:
  // ticket: of the connecting end; outlives the transport. nullptr: no session is resumed.
  TlsHandshake(std::shared_ptr<const TlsCredentials> credentials, std::unique_ptr<Transport> lower,
               TransportEnd end, TlsTicket* ticket = nullptr);
  TlsHandshake(TlsHandshake&&) noexcept;
  TlsHandshake& operator=(TlsHandshake&&) noexcept;
  ~TlsHandshake();

  // Goes on as far as possible without waiting. True: it is done; false: when fd() is ready for
  // events().
  //   fails  no_permission: one side does not accept the other's certificate; protocol: the other
  //          side speaks no TLS; unavailable: it closed the connection
  Result<bool> go_on();
  short events() const noexcept;  // POLLIN, POLLOUT
  int fd() const noexcept;

  // Once, when it is done.
  std::unique_ptr<Transport> take_transport();

 private:
  std::unique_ptr<TlsTransport> transport_;
};

}  // namespace dssm::wire
