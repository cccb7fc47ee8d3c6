// SPDX-License-Identifier: Apache-2.0
//
// TLS 1.3 over another transport, both sides with certificates. First a TlsHandshake; when it is
// done it gives the transport, whose peer() is known. Frames begin after that, so nothing of an
// unknown peer reaches them.
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

#include "core/wire/tls_credentials.hpp"
#include "core/wire/transport.hpp"

namespace dssm::wire {

class TlsTransport;

// What a TLS client sends first. No frame begins like that: its second byte would be a field 0.
inline constexpr unsigned char kTlsFirstBytes[] = {0x16, 0x03};

// A resource with one owner; one thread. It never waits, and has no time limit of its own.
class TlsHandshake {
 public:
  TlsHandshake(std::shared_ptr<const TlsCredentials> credentials, std::unique_ptr<Transport> lower,
               TransportEnd end);
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
