// SPDX-License-Identifier: Apache-2.0
//
// What certificates.cpp and authority.cpp share: owners for objects of OpenSSL, and its errors.
#pragma once

#include <fmt/format.h>
#include <openssl/asn1.h>
#include <openssl/bio.h>
#include <openssl/bn.h>
#include <openssl/err.h>
#include <openssl/x509v3.h>

#include <dssm/result.hpp>
#include <memory>
#include <string>
#include <string_view>

#include "client/dssmctl/certificates.hpp"

namespace dssm::ctl::pki {

inline constexpr std::string_view kHostIdUri = "urn:dssm:host-id:";
inline constexpr std::string_view kProgramUri = "urn:dssm:program:";

template <auto free>
struct Free {
  template <class T>
  void operator()(T* object) const {
    free(object);
  }
};
template <class T, auto free>
using Owned = std::unique_ptr<T, Free<free>>;

// A new object that copies of the pointer share.
template <auto free, class T>
std::shared_ptr<T> owned(T* object) {
  return Owned<T, free>(object);
}

inline void free_stack(STACK_OF(X509) * stack) { sk_X509_free(stack); }
inline void free_extensions(STACK_OF(X509_EXTENSION) * stack) {
  sk_X509_EXTENSION_pop_free(stack, X509_EXTENSION_free);
}

using Bio = Owned<BIO, BIO_free_all>;
using Integer = Owned<ASN1_INTEGER, ASN1_INTEGER_free>;
using Number = Owned<BIGNUM, BN_free>;
using Extension = Owned<X509_EXTENSION, X509_EXTENSION_free>;
using Extensions = Owned<STACK_OF(X509_EXTENSION), free_extensions>;

// "`tried`: " and OpenSSL's reason; its queue of errors is empty afterwards.
inline Error openssl_error(std::string_view tried) {
  const char* reason = ERR_reason_error_string(ERR_peek_last_error());
  ERR_clear_error();
  return Error{Errc::system, fmt::format("{}: {}", tried, reason ? reason : "OpenSSL failed")};
}

inline Bio reading_bio(std::string_view text) {
  return Bio(BIO_new_mem_buf(text.data(), static_cast<int>(text.size())));
}
inline Bio writing_bio() { return Bio(BIO_new(BIO_s_mem())); }

inline std::string text_in(const Bio& bio) {
  std::string text(BIO_ctrl_pending(bio.get()), '\0');
  const int size = BIO_read(bio.get(), text.data(), static_cast<int>(text.size()));
  text.resize(size > 0 ? static_cast<std::size_t>(size) : 0);
  return text;
}

// The CRL number; 0 without one.
inline Integer list_number(const RevocationList& list) {
  Integer number(static_cast<ASN1_INTEGER*>(
      X509_CRL_get_ext_d2i(list.get(), NID_crl_number, nullptr, nullptr)));
  return number ? std::move(number) : Integer(ASN1_INTEGER_new());
}

}  // namespace dssm::ctl::pki
