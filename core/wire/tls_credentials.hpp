// SPDX-License-Identifier: Apache-2.0
//
// What one side of an encrypted connection proves itself with, and whom it believes: a folder of
// PEM files, as `dssmctl pki` makes them (docs/security.md).
//
//   ca.crt       the vehicle's certificate authority, or several
//   own.crt      the own certificate, then intermediate ones if there are any
//   own.key      its private key; nobody but the owner and the group may read it
//   revoked.crl  certificates that are not believed any more; may be missing
//
// A certificate names a host, by its DSSM name (DNS:pc2) and its id (URI:urn:dssm:host-id:...), or
// a program (URI:urn:dssm:program:viewer), each as a subject alternative name. Only hosts may be
// connected to (extended key usage serverAuth).
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <memory>
#include <string>

#include "core/wire/messages.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/transport.hpp"

// Of OpenSSL.
struct ssl_ctx_st;
struct ssl_session_st;
struct ssl_st;
struct x509_st;

namespace dssm::wire {

// Whom a verified certificate names. A value; copies share the certificate.
struct CertifiedPeer {
  enum class Kind : unsigned char { host, program };
  struct Certificates;  // as they were received, to be verified again

  Kind kind = Kind::program;
  std::string name;
  HostId host_id{};  // of a host
  std::shared_ptr<const Certificates> certificates;

  std::string str() const;  // "host 'pc2'", "program 'viewer'"
};

// Whether `greeting` is of whom the certificate names: a host greets with its name and id, a
// program not as dssmd. Only hosts are connected to.
//   end    this side's
//   fails  no_permission, naming both
Result<void> check_certified(const Greeting& greeting, const CertifiedPeer& peer, TransportEnd end);

// Never changes: a reload makes another one. Thread-safe.
class TlsCredentials {
 public:
  // Reads the files.
  //   fails  naming the file and what to do: missing, unreadable, readable by everybody, no PEM,
  //          the key or the certificate does not belong to the others
  static Result<std::shared_ptr<const TlsCredentials>> load(const std::string& folder);
  TlsCredentials(const TlsCredentials&) = delete;
  TlsCredentials& operator=(const TlsCredentials&) = delete;
  ~TlsCredentials();

  // The same folder again, when a file there was replaced, written, added or removed since.
  //   returns  nullptr: none was
  //   fails    as load()
  Result<std::shared_ptr<const TlsCredentials>> load_if_changed() const;

  // As what others know this side.
  const CertifiedPeer& own() const noexcept { return own_; }
  Time own_valid_until() const noexcept { return own_valid_until_; }
  // Why others may refuse the own certificate now (expired, revoked, ...). Empty: nothing is known.
  std::string own_problem() const;

  // Whether another side whose certificate was verified before would be believed now, by these.
  //   fails  no_permission, with the reason
  Result<void> check(const CertifiedPeer& peer) const;

 private:
  friend class TlsTransport;
  explicit TlsCredentials(const std::string& folder);
  Result<void> read();

  const std::string folder_;
  const std::string files_;  // which files there were before they were read
  ssl_ctx_st* context_ = nullptr;
  CertifiedPeer own_;
  Time own_valid_until_{};
};

// The credentials of this process as of now, for connections that begin.
struct OwnCredentials {
  std::shared_ptr<const TlsCredentials> now;
};
// Those of `self`; nullptr: its connections are not encrypted.
std::shared_ptr<const TlsCredentials> credentials_of(const Greeting& self);

// For TlsTransport: the other side's verified certificate, after the handshake, also of a session
// that was resumed.
//   fails  no_permission
Result<CertifiedPeer> certified_peer(ssl_st* session);
// Whom a certificate names, whoever issued it; without `certificates`.
//   fails  no_permission: it names neither a host nor a program
Result<CertifiedPeer> named_by(x509_st* certificate);
// The common name in a certificate; printable.
std::string subject_of(const x509_st* certificate);
// How a certificate was refused, with a hint at the reason. problem: X509_V_ERR_...
std::string refusal_text(const std::string& subject, int problem);

}  // namespace dssm::wire
