// SPDX-License-Identifier: Apache-2.0
//
// The X.509 certificates of a vehicle: keys, requests, certificates and revocation lists (CRL), in
// memory. docs/certificates.md describes what they contain; pki_files.hpp reads and writes the
// files.
//
// All that is issued here is valid from 1970 on, on purpose: a PC whose clock is years behind after
// a flat battery must still be able to join its vehicle, because that is how it gets the time. For
// the same reason a revocation list never becomes stale.
//
// Times are seconds since 1970, UTC. Objects are never changed after they were made, and copies of
// a Certificate, Key or RevocationList share one object.
#pragma once

#include <openssl/x509.h>

#include <cstdint>
#include <ctime>
#include <dssm/result.hpp>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::ctl::pki {

using Key = std::shared_ptr<EVP_PKEY>;  // a pair of keys, or a public one
using Certificate = std::shared_ptr<X509>;
using RevocationList = std::shared_ptr<X509_CRL>;

inline constexpr std::time_t kSecondsPerDay = 86'400;

// --- who a certificate is for

enum class Kind : std::uint8_t {
  ca,
  host,     // a dssmd: server and client
  program,  // a program on a PC without dssmd: client only
  other,    // not made by these rules
};
std::string_view name_of(Kind kind) noexcept;

struct Identity {
  Kind kind = Kind::other;
  std::string name;     // the common name
  std::string host_id;  // of hosts: 32 hexadecimal digits, lower case

  std::string str() const;  // "host 'pc2'"
};

// 1 to `max_bytes` letters, digits, '.', '_' and '-'.
//   fails  invalid_argument
inline constexpr std::size_t kMaxProgramBytes = 63;
inline constexpr std::size_t kMaxVehicleBytes = 53;  // a common name has 64, "DSSM CA of " takes 11
Result<void> check_name(std::string_view text, std::size_t max_bytes);

// Whether a host or program can have this identity.
//   fails  invalid_argument
Result<void> check_identity(const Identity& identity);

// --- keys: ECDSA P-256, as PEM of PKCS#8

Result<Key> make_key();
std::string pem_of(const Key& key);  // both keys of the pair
Result<Key> parse_key(std::string_view pem);

// --- requests (CSR), as PEM

Result<std::string> make_request(const Key& key, const Identity& identity);

struct Request {
  Identity identity;  // checked
  Key public_key;
};
// Takes only the name, the host id and the public key from a request; all else in it is ignored.
//   fails  protocol: it is not a request, it was not signed by its own key, its key is not on
//          P-256, or its names are not possible
Result<Request> parse_request_untrusted(std::string_view pem);

// --- what a CA makes

struct Authority {
  Key key;
  Certificate certificate;
};

inline constexpr std::time_t kCaSeconds = kSecondsPerDay * 365 * 20;
Result<Authority> make_authority(std::string_view vehicle, std::time_t now);

Result<Certificate> issue(const Authority& authority, const Request& request, std::time_t end);

// The list after `previous` (nullptr: the first one): what that contains, and `serials` as of now.
Result<RevocationList> make_list(const Authority& authority, const RevocationList& previous,
                                 const std::vector<Certificate>& revoked, std::time_t now);

// --- reading

// The certificates and revocation lists of a PEM file, in their order; other blocks are ignored.
struct Bundle {
  std::vector<Certificate> certificates;
  std::vector<RevocationList> lists;
};
//   fails  protocol: a block is damaged, or there is none
Result<Bundle> parse_bundle_untrusted(std::string_view pem);

std::string pem_of(const Certificate& certificate);
std::string pem_of(const RevocationList& list);

Identity identity_of(const Certificate& certificate);
std::string serial_of(const Certificate& certificate);  // hexadecimal digits, lower case
std::time_t end_of(const Certificate& certificate);     // valid until then
Key public_key_of(const Certificate& certificate);
bool is_self_signed(const Certificate& certificate);
bool have_same_key(const Certificate& certificate, const Key& key);

std::string issuer_of(const RevocationList& list);                       // the CA's common name
std::string number_of(const RevocationList& list);                       // decimal; "0" without one
std::size_t size_of(const RevocationList& list);                         // certificates in it
bool is_newer(const RevocationList& list, const RevocationList& other);  // by number
bool is_signed_by(const RevocationList& list, const Certificate& ca);

// Of the lists that each of `authorities` signed, the one with the highest number; the first one of
// equals. Lists that none of them signed are left out.
std::vector<RevocationList> newest_lists(const std::vector<Certificate>& authorities,
                                         const std::vector<RevocationList>& lists);

bool is_revoked(const Certificate& certificate, const std::vector<RevocationList>& lists);

// Whether one of the self-signed `roots` signed the certificate, or one of `intermediates` that is
// signed in this way did. Ends of validity and revocation lists are not checked.
//   fails  protocol
Result<void> check_signature(const Certificate& certificate,
                             const std::vector<Certificate>& intermediates,
                             const std::vector<Certificate>& roots);

}  // namespace dssm::ctl::pki
