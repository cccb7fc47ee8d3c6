// SPDX-License-Identifier: Apache-2.0
//
// Reading: what a certificate, a list or a request contains, and whether its signatures are right.
// The part that signs is in authority.cpp.
#include "client/dssmctl/certificates.hpp"

#include <fmt/format.h>
#include <openssl/ec.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/x509v3.h>

#include <algorithm>
#include <array>

#include "client/dssmctl/openssl.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl::pki {
namespace {

Error bad_content(std::string reason) { return Error{Errc::protocol, std::move(reason)}; }

// A key that has a password is not for programs that start by themselves: no password is asked for.
int refuse_password(char*, int, int, void*) { return -1; }

std::string text_of(const ASN1_STRING* string) {
  unsigned char* utf8 = nullptr;
  const int size = ASN1_STRING_to_UTF8(&utf8, string);
  if (size < 0) return {};
  std::string text(reinterpret_cast<const char*>(utf8), static_cast<std::size_t>(size));
  OPENSSL_free(utf8);
  return text;
}

// The common name; empty unless there is exactly one.
std::string common_name(const X509_NAME* name) {
  const int index = X509_NAME_get_index_by_NID(name, NID_commonName, -1);
  if (index < 0 || X509_NAME_get_index_by_NID(name, NID_commonName, index) >= 0) return {};
  return text_of(X509_NAME_ENTRY_get_data(X509_NAME_get_entry(name, index)));
}

// Who is meant by these names. A certificate is for one host or one program; other names in it,
// such as an e-mail address, do not matter.
Result<Identity> identity_from(const X509_NAME* subject, const GENERAL_NAMES* names) {
  Identity identity{Kind::other, common_name(subject), {}};
  int found = 0;
  for (int i = 0; i < sk_GENERAL_NAME_num(names); ++i) {
    const GENERAL_NAME* name = sk_GENERAL_NAME_value(names, i);
    if (name->type != GEN_URI) continue;
    const std::string uri = text_of(name->d.uniformResourceIdentifier);
    if (uri.starts_with(kHostIdUri)) {
      identity.kind = Kind::host;
      identity.host_id = uri.substr(kHostIdUri.size());
      ++found;
    } else if (uri.starts_with(kProgramUri)) {
      identity.kind = Kind::program;
      if (uri.substr(kProgramUri.size()) != identity.name) {
        return bad_content(
            fmt::format("its name is '{}', but it has '{}'", escaped(identity.name), escaped(uri)));
      }
      ++found;
    }
  }
  if (found == 0) return bad_content("it is neither for a host nor for a program of DSSM");
  if (found > 1) return bad_content("it is for more than one host or program");
  if (Result<void> checked = check_identity(identity); !checked) {
    return bad_content(std::move(checked).error().message);
  }
  return identity;
}

using GeneralNames = Owned<GENERAL_NAMES, GENERAL_NAMES_free>;

bool is_on_p256(const EVP_PKEY* key) {
  std::array<char, 64> group{};
  return EVP_PKEY_is_a(key, "EC") == 1 &&
         EVP_PKEY_get_group_name(key, group.data(), group.size(), nullptr) == 1 &&
         std::string_view(group.data()) == SN_X9_62_prime256v1;
}

// An object from the bytes of a PEM block; nullptr unless it is all of them.
template <auto decode>
auto from_der(const unsigned char* bytes, long size) {
  const unsigned char* at = bytes;
  auto* object = decode(nullptr, &at, size);
  return at == bytes + size ? object : nullptr;
}

Result<void> take_block(Bundle& bundle, std::string_view type, const unsigned char* bytes,
                        long size) {
  if (type == PEM_STRING_X509 || type == PEM_STRING_X509_OLD) {
    Certificate certificate = owned<X509_free>(from_der<d2i_X509>(bytes, size));
    // The flags of a certificate whose extensions cannot be understood are not to be relied on.
    if (!certificate || (X509_get_extension_flags(certificate.get()) & EXFLAG_INVALID)) {
      return bad_content("a certificate in it is damaged");
    }
    bundle.certificates.push_back(std::move(certificate));
  } else if (type == PEM_STRING_X509_CRL) {
    RevocationList list = owned<X509_CRL_free>(from_der<d2i_X509_CRL>(bytes, size));
    if (!list) return bad_content("a revocation list in it is damaged");
    bundle.lists.push_back(std::move(list));
  }
  return {};
}

}  // namespace

std::string_view name_of(Kind kind) noexcept {
  switch (kind) {
    case Kind::ca:
      return "CA";
    case Kind::host:
      return "host";
    case Kind::program:
      return "program";
    case Kind::other:
      return "other";
  }
  return "";
}

std::string Identity::str() const { return fmt::format("{} '{}'", name_of(kind), escaped(name)); }

Result<void> check_name(std::string_view text, std::size_t max_bytes) {
  const bool possible = std::all_of(text.begin(), text.end(), [](char c) {
    return is_letter_or_digit(c) || c == '.' || c == '_' || c == '-';
  });
  if (possible && !text.empty() && text.size() <= max_bytes) return {};
  return Error{Errc::invalid_argument,
               fmt::format("'{}' is not a name of 1 to {} letters, digits, '.', '_' and '-'",
                           escaped(text), max_bytes)};
}

Result<void> check_identity(const Identity& identity) {
  if (identity.kind == Kind::program) return check_name(identity.name, kMaxProgramBytes);
  DSSM_TRY(check_host_name(identity.name));
  if (identity.host_id.size() == 32 &&
      identity.host_id.find_first_not_of("0123456789abcdef") == std::string::npos) {
    return {};
  }
  return Error{Errc::invalid_argument,
               fmt::format("'{}' is not a host id of 32 hexadecimal digits, lower case",
                           escaped(identity.host_id))};
}

Result<Key> parse_key(std::string_view pem) {
  const Bio bio = reading_bio(pem);
  Key key = owned<EVP_PKEY_free>(PEM_read_bio_PrivateKey(bio.get(), nullptr, refuse_password, {}));
  if (!key) return openssl_error("read the private key");
  if (!is_on_p256(key.get())) return bad_content("the private key is not an ECDSA key on P-256");
  return key;
}

std::string pem_of(const Key& key) {
  const Bio bio = writing_bio();
  PEM_write_bio_PKCS8PrivateKey(bio.get(), key.get(), nullptr, nullptr, 0, nullptr, nullptr);
  return text_in(bio);
}

std::string pem_of(const Certificate& certificate) {
  const Bio bio = writing_bio();
  PEM_write_bio_X509(bio.get(), certificate.get());
  return text_in(bio);
}

std::string pem_of(const RevocationList& list) {
  const Bio bio = writing_bio();
  PEM_write_bio_X509_CRL(bio.get(), list.get());
  return text_in(bio);
}

Result<Request> parse_request_untrusted(std::string_view pem) {
  const Bio bio = reading_bio(pem);
  const Owned<X509_REQ, X509_REQ_free> csr(
      PEM_read_bio_X509_REQ(bio.get(), nullptr, refuse_password, nullptr));
  if (!csr) {
    ERR_clear_error();
    return bad_content("it is not a request; 'dssmctl pki request' makes one");
  }
  Request request;
  request.public_key = owned<EVP_PKEY_free>(X509_REQ_get_pubkey(csr.get()));
  if (!request.public_key || !is_on_p256(request.public_key.get())) {
    ERR_clear_error();
    return bad_content("its key is not an ECDSA key on P-256");
  }
  // It shows that the sender has the private key, and that nobody changed the names on the way.
  if (X509_REQ_verify(csr.get(), request.public_key.get()) != 1) {
    ERR_clear_error();
    return bad_content("its signature is wrong: it was damaged or changed; make it again");
  }
  const Extensions extensions(X509_REQ_get_extensions(csr.get()));
  const GeneralNames names(static_cast<GENERAL_NAMES*>(
      X509V3_get_d2i(extensions.get(), NID_subject_alt_name, nullptr, nullptr)));
  request.identity = DSSM_TRY(identity_from(X509_REQ_get_subject_name(csr.get()), names.get()));
  return request;
}

Result<Bundle> parse_bundle_untrusted(std::string_view pem) {
  const Bio bio = reading_bio(pem);
  Bundle bundle;
  char* type = nullptr;
  char* header = nullptr;
  unsigned char* bytes = nullptr;
  long size = 0;
  Result<void> taken;
  bool has_request = false;
  while (taken && PEM_read_bio(bio.get(), &type, &header, &bytes, &size) == 1) {
    if (std::string_view(type) == PEM_STRING_X509_REQ) has_request = true;
    taken = take_block(bundle, type, bytes, size);
    OPENSSL_free(type);
    OPENSSL_free(header);
    OPENSSL_clear_free(bytes, static_cast<std::size_t>(size));  // it may be a private key
  }
  const int reason = ERR_GET_REASON(ERR_peek_last_error());
  ERR_clear_error();
  if (!taken) return std::move(taken).error();
  if (reason != PEM_R_NO_START_LINE) return bad_content("it is not whole, or not PEM");
  if (bundle.certificates.empty() && bundle.lists.empty()) {
    return bad_content(has_request
                           ? "it is a request; `dssmctl pki issue` makes a certificate of it"
                           : "it contains neither a certificate nor a revocation list");
  }
  return bundle;
}

Identity identity_of(const Certificate& certificate) {
  const X509_NAME* subject = X509_get_subject_name(certificate.get());
  if (X509_check_ca(certificate.get()) > 0) return {Kind::ca, common_name(subject), {}};
  const GeneralNames names(static_cast<GENERAL_NAMES*>(
      X509_get_ext_d2i(certificate.get(), NID_subject_alt_name, nullptr, nullptr)));
  Result<Identity> identity = identity_from(subject, names.get());
  return identity ? *std::move(identity) : Identity{Kind::other, common_name(subject), {}};
}

std::string serial_of(const Certificate& certificate) {
  const Number number(ASN1_INTEGER_to_BN(X509_get0_serialNumber(certificate.get()), nullptr));
  char* digits = number ? BN_bn2hex(number.get()) : nullptr;
  std::string text = digits ? digits : "";
  OPENSSL_free(digits);
  std::transform(text.begin(), text.end(), text.begin(),
                 [](char c) { return c >= 'A' && c <= 'F' ? static_cast<char>(c + 32) : c; });
  return text;
}

std::time_t end_of(const Certificate& certificate) {
  std::tm end{};
  if (ASN1_TIME_to_tm(X509_get0_notAfter(certificate.get()), &end) != 1) return 0;
  return ::timegm(&end);
}

Key public_key_of(const Certificate& certificate) {
  return owned<EVP_PKEY_free>(X509_get_pubkey(certificate.get()));
}

bool is_self_signed(const Certificate& certificate) {
  const bool is = X509_self_signed(certificate.get(), 1) == 1;
  ERR_clear_error();
  return is;
}

bool have_same_key(const Certificate& certificate, const Key& key) {
  return EVP_PKEY_eq(X509_get0_pubkey(certificate.get()), key.get()) == 1;
}

std::string issuer_of(const RevocationList& list) {
  return common_name(X509_CRL_get_issuer(list.get()));
}

std::string number_of(const RevocationList& list) {
  const Number number(ASN1_INTEGER_to_BN(list_number(list).get(), nullptr));
  char* digits = number ? BN_bn2dec(number.get()) : nullptr;
  std::string text = digits ? digits : "";
  OPENSSL_free(digits);
  return text;
}

std::size_t size_of(const RevocationList& list) {
  const int size = sk_X509_REVOKED_num(X509_CRL_get_REVOKED(list.get()));
  return size > 0 ? static_cast<std::size_t>(size) : 0;  // -1: there is no table
}

bool is_newer(const RevocationList& list, const RevocationList& other) {
  return ASN1_INTEGER_cmp(list_number(list).get(), list_number(other).get()) > 0;
}

bool is_signed_by(const RevocationList& list, const Certificate& ca) {
  const bool is = X509_CRL_verify(list.get(), X509_get0_pubkey(ca.get())) == 1;
  ERR_clear_error();
  return is;
}

std::vector<RevocationList> newest_lists(const std::vector<Certificate>& authorities,
                                         const std::vector<RevocationList>& lists) {
  std::vector<RevocationList> newest;
  for (const Certificate& authority : authorities) {
    RevocationList best;
    for (const RevocationList& list : lists) {
      if (!is_signed_by(list, authority)) continue;
      if (!best || is_newer(list, best)) best = list;
    }
    if (best && std::find(newest.begin(), newest.end(), best) == newest.end()) {
      newest.push_back(best);
    }
  }
  return newest;
}

bool is_revoked(const Certificate& certificate, const std::vector<RevocationList>& lists) {
  return std::any_of(lists.begin(), lists.end(), [&](const RevocationList& list) {
    X509_REVOKED* entry = nullptr;
    return X509_CRL_get0_by_cert(list.get(), &entry, certificate.get()) == 1;
  });
}

Result<void> check_signature(const Certificate& certificate,
                             const std::vector<Certificate>& intermediates,
                             const std::vector<Certificate>& roots) {
  const Owned<X509_STORE, X509_STORE_free> store(X509_STORE_new());
  const Owned<X509_STORE_CTX, X509_STORE_CTX_free> context(X509_STORE_CTX_new());
  const Owned<STACK_OF(X509), free_stack> others(sk_X509_new_null());
  if (!store || !context || !others) return openssl_error("check a signature");
  for (const Certificate& root : roots) X509_STORE_add_cert(store.get(), root.get());
  for (const Certificate& other : intermediates) sk_X509_push(others.get(), other.get());
  if (X509_STORE_CTX_init(context.get(), store.get(), certificate.get(), others.get()) != 1) {
    return openssl_error("check a signature");
  }
  X509_STORE_CTX_set_flags(context.get(), X509_V_FLAG_NO_CHECK_TIME);
  if (X509_verify_cert(context.get()) == 1) return {};
  const int reason = X509_STORE_CTX_get_error(context.get());
  ERR_clear_error();
  return bad_content(X509_verify_cert_error_string(reason));
}

}  // namespace dssm::ctl::pki
