// SPDX-License-Identifier: Apache-2.0
//
// Signing: keys, requests, and what a CA makes. Names come from callers that have checked them, so
// they hold no character that means something in the texts of which OpenSSL makes extensions.
#include <fmt/format.h>
#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/x509v3.h>

#include "client/dssmctl/certificates.hpp"
#include "client/dssmctl/openssl.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl::pki {
namespace {

// Of everything that is issued; see certificates.hpp.
constexpr std::time_t kBeginning = 0;
constexpr const char* kNoExpiry = "99991231235959Z";  // RFC 5280 4.1.2.5: no end

// 127 bits, the first one set: always 16 bytes, positive, and 126 of the bits are random.
constexpr int kSerialBits = 127;

struct ExtensionText {
  int nid;
  std::string value;  // as in openssl's x509v3_config(5)
};

std::string alternative_names(const Identity& identity) {
  if (identity.kind == Kind::program) return fmt::format("URI:{}{}", kProgramUri, identity.name);
  return fmt::format("DNS:{},URI:{}{}", identity.name, kHostIdUri, identity.host_id);
}

Extension make_extension(X509V3_CTX* context, const ExtensionText& text) {
  return Extension(X509V3_EXT_nconf_nid(nullptr, context, text.nid, text.value.c_str()));
}

bool set_common_name(X509_NAME* name, const std::string& text) {
  return X509_NAME_add_entry_by_NID(name, NID_commonName, MBSTRING_UTF8,
                                    reinterpret_cast<const unsigned char*>(text.data()),
                                    static_cast<int>(text.size()), -1, 0) == 1;
}

Integer random_serial() {
  const Number number(BN_new());
  if (!number || BN_rand(number.get(), kSerialBits, BN_RAND_TOP_ONE, BN_RAND_BOTTOM_ANY) != 1) {
    return nullptr;
  }
  return Integer(BN_to_ASN1_INTEGER(number.get(), nullptr));
}

// Signs a certificate for `name`. `issuer`: nullptr for a CA, which signs itself.
Result<Certificate> make_certificate(const std::string& name, const Key& public_key,
                                     std::time_t end, const std::vector<ExtensionText>& extensions,
                                     const Certificate& issuer, const Key& issuer_key) {
  Certificate made = owned<X509_free>(X509_new());
  const Integer serial = random_serial();
  X509* x509 = made.get();
  X509* signer = issuer ? issuer.get() : x509;
  const bool filled = made && serial && X509_set_version(x509, X509_VERSION_3) == 1 &&
                      X509_set_serialNumber(x509, serial.get()) == 1 &&
                      ASN1_TIME_set(X509_getm_notBefore(x509), kBeginning) &&
                      ASN1_TIME_set(X509_getm_notAfter(x509), end) &&
                      X509_set_pubkey(x509, public_key.get()) == 1 &&
                      set_common_name(X509_get_subject_name(x509), name) &&
                      X509_set_issuer_name(x509, X509_get_subject_name(signer)) == 1;
  if (!filled) return openssl_error("make a certificate");
  X509V3_CTX context{};
  X509V3_set_ctx(&context, signer, x509, nullptr, nullptr, 0);
  for (const ExtensionText& text : extensions) {
    const Extension extension = make_extension(&context, text);
    if (!extension || X509_add_ext(x509, extension.get(), -1) != 1) {
      return openssl_error("make an extension of a certificate");
    }
  }
  if (X509_sign(x509, issuer_key.get(), EVP_sha256()) <= 0) {
    return openssl_error("sign a certificate");
  }
  return made;
}

// Adds an entry, and copies nothing else from the certificate.
bool add_entry(X509_CRL* list, const Certificate& certificate, std::time_t now) {
  Owned<X509_REVOKED, X509_REVOKED_free> entry(X509_REVOKED_new());
  const Owned<ASN1_TIME, ASN1_TIME_free> time(ASN1_TIME_set(nullptr, now));
  return entry && time &&
         X509_REVOKED_set_serialNumber(entry.get(), X509_get_serialNumber(certificate.get())) ==
             1 &&
         X509_REVOKED_set_revocationDate(entry.get(), time.get()) == 1 &&
         X509_CRL_add0_revoked(list, entry.get()) == 1 && entry.release();
}

bool copy_entries(X509_CRL* list, const RevocationList& previous) {
  if (!previous) return true;
  const STACK_OF(X509_REVOKED)* entries = X509_CRL_get_REVOKED(previous.get());
  for (int i = 0; i < sk_X509_REVOKED_num(entries); ++i) {
    Owned<X509_REVOKED, X509_REVOKED_free> entry(
        X509_REVOKED_dup(sk_X509_REVOKED_value(entries, i)));
    if (!entry || X509_CRL_add0_revoked(list, entry.get()) != 1) return false;
    static_cast<void>(entry.release());  // the list owns it
  }
  return true;
}

// One more than that of `previous`.
Integer next_number(const RevocationList& previous) {
  const Integer last = previous ? list_number(previous) : Integer(ASN1_INTEGER_new());
  const Number number(ASN1_INTEGER_to_BN(last.get(), nullptr));
  if (!number || BN_add_word(number.get(), 1) != 1) return nullptr;
  return Integer(BN_to_ASN1_INTEGER(number.get(), nullptr));
}

}  // namespace

Result<Key> make_key() {
  Key key = owned<EVP_PKEY_free>(EVP_PKEY_Q_keygen(nullptr, nullptr, "EC", "P-256"));
  if (!key) return openssl_error("make a key");
  return key;
}

Result<std::string> make_request(const Key& key, const Identity& identity) {
  DSSM_TRY(check_identity(identity));
  const Owned<X509_REQ, X509_REQ_free> csr(X509_REQ_new());
  X509V3_CTX context{};
  X509V3_set_ctx(&context, nullptr, nullptr, csr.get(), nullptr, 0);
  Extension extension =
      make_extension(&context, {NID_subject_alt_name, alternative_names(identity)});
  const Extensions extensions(sk_X509_EXTENSION_new_null());
  if (!csr || !extension || !extensions ||
      sk_X509_EXTENSION_push(extensions.get(), extension.get()) <= 0) {
    return openssl_error("make a request");
  }
  static_cast<void>(extension.release());  // the stack owns it
  const bool signed_by_key = X509_REQ_set_version(csr.get(), X509_REQ_VERSION_1) == 1 &&
                             set_common_name(X509_REQ_get_subject_name(csr.get()), identity.name) &&
                             X509_REQ_set_pubkey(csr.get(), key.get()) == 1 &&
                             X509_REQ_add_extensions(csr.get(), extensions.get()) == 1 &&
                             X509_REQ_sign(csr.get(), key.get(), EVP_sha256()) > 0;
  if (!signed_by_key) return openssl_error("make a request");
  const Bio bio = writing_bio();
  PEM_write_bio_X509_REQ(bio.get(), csr.get());
  return text_in(bio);
}

Result<Authority> make_authority(std::string_view vehicle, std::time_t now) {
  DSSM_TRY(check_name(vehicle, kMaxVehicleBytes));
  const Key key = DSSM_TRY(make_key());
  const std::vector<ExtensionText> extensions = {
      {NID_basic_constraints, "critical,CA:TRUE,pathlen:0"},
      {NID_key_usage, "critical,keyCertSign,cRLSign"},
      {NID_subject_key_identifier, "hash"}};
  const Certificate certificate = DSSM_TRY(make_certificate(
      fmt::format("DSSM CA of {}", vehicle), key, now + kCaSeconds, extensions, nullptr, key));
  return Authority{key, certificate};
}

Result<Certificate> issue(const Authority& authority, const Request& request, std::time_t end) {
  const Identity& identity = request.identity;
  DSSM_TRY(check_identity(identity));
  const std::vector<ExtensionText> extensions = {
      {NID_basic_constraints, "critical,CA:FALSE"},
      {NID_key_usage, "critical,digitalSignature"},
      {NID_ext_key_usage, identity.kind == Kind::host ? "serverAuth,clientAuth" : "clientAuth"},
      {NID_subject_alt_name, alternative_names(identity)},
      {NID_subject_key_identifier, "hash"},
      {NID_authority_key_identifier, "keyid:always"}};
  return make_certificate(identity.name, request.public_key, end, extensions, authority.certificate,
                          authority.key);
}

Result<RevocationList> make_list(const Authority& authority, const RevocationList& previous,
                                 const std::vector<Certificate>& revoked, std::time_t now) {
  RevocationList list = owned<X509_CRL_free>(X509_CRL_new());
  const Owned<ASN1_TIME, ASN1_TIME_free> beginning(ASN1_TIME_set(nullptr, kBeginning));
  const Owned<ASN1_TIME, ASN1_TIME_free> never(ASN1_TIME_new());
  const Integer number = next_number(previous);
  X509_CRL* crl = list.get();
  const X509* ca = authority.certificate.get();
  bool done = list && beginning && never && number &&
              ASN1_TIME_set_string(never.get(), kNoExpiry) == 1 &&
              X509_CRL_set_version(crl, X509_CRL_VERSION_2) == 1 &&
              X509_CRL_set_issuer_name(crl, X509_get_subject_name(ca)) == 1 &&
              X509_CRL_set1_lastUpdate(crl, beginning.get()) == 1 &&
              X509_CRL_set1_nextUpdate(crl, never.get()) == 1 &&
              X509_CRL_add1_ext_i2d(crl, NID_crl_number, number.get(), 0, 0) == 1 &&
              copy_entries(crl, previous);
  for (const Certificate& certificate : revoked) done = done && add_entry(crl, certificate, now);
  X509V3_CTX context{};
  X509V3_set_ctx(&context, authority.certificate.get(), nullptr, nullptr, crl, 0);
  const Extension key_id = make_extension(&context, {NID_authority_key_identifier, "keyid:always"});
  done = done && key_id && X509_CRL_add_ext(crl, key_id.get(), -1) == 1 &&
         X509_CRL_sort(crl) == 1 && X509_CRL_sign(crl, authority.key.get(), EVP_sha256()) > 0;
  if (!done) return openssl_error("make a revocation list");
  return list;
}

}  // namespace dssm::ctl::pki
