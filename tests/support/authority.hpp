// SPDX-License-Identifier: Apache-2.0
//
// A certificate authority for tests: folders of credentials, right ones and such that must be
// refused.
#pragma once

#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/x509v3.h>
#include <sys/stat.h>

#include <chrono>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <string>
#include <string_view>

#include "core/base/text.hpp"
#include "core/wire/host_id.hpp"

namespace dssm::test {

class Authority {
 public:
  using Hours = std::chrono::hours;

  // What a certificate says. Times count from now.
  struct Subject {
    std::string name;
    std::string alternative_names;  // as openssl.cnf(5) writes them: "DNS:pc2,URI:..."
    std::string extended_usage = "serverAuth,clientAuth";
    std::chrono::seconds valid_from = Hours(-1), valid_until = Hours(24);
  };

  static Subject host(const std::string& name) {
    return {name, "DNS:" + name + ",URI:urn:dssm:host-id:" + hex(wire::host_id_for(name))};
  }
  static Subject program(const std::string& name) {
    return {name, "URI:urn:dssm:program:" + name, "clientAuth"};
  }

  // above: the one that issued this one's certificate, which outlives it; nullptr: itself.
  explicit Authority(const std::string& name = "vehicle", Authority* above = nullptr)
      : key_(make_key()), above_(above) {
    certificate_ = make(name, key_.get(), Hours(-1000), Hours(1000));
    add(certificate_.get(), NID_basic_constraints, "critical,CA:TRUE");
    add(certificate_.get(), NID_key_usage, "critical,keyCertSign,cRLSign");
    add(certificate_.get(), NID_subject_key_identifier, "hash");
    const Authority& by = above ? *above : *this;
    X509_set_issuer_name(certificate_.get(), X509_get_subject_name(by.certificate_.get()));
    X509_sign(certificate_.get(), by.key_.get(), EVP_sha256());
  }

  // Writes ca.crt, own.crt and own.key into `folder`, which is made.
  //   returns  the serial number
  long issue(const Subject& subject, const std::filesystem::path& folder) {
    std::filesystem::create_directories(folder);
    const Key key = make_key();
    const Certificate made = make(subject.name, key.get(), subject.valid_from, subject.valid_until);
    add(made.get(), NID_basic_constraints, "critical,CA:FALSE");
    add(made.get(), NID_ext_key_usage, subject.extended_usage);
    add(made.get(), NID_subject_alt_name, subject.alternative_names);
    add(made.get(), NID_authority_key_identifier, "keyid:always");
    X509_set_issuer_name(made.get(), X509_get_subject_name(certificate_.get()));
    X509_sign(made.get(), key_.get(), EVP_sha256());
    write(folder / "own.crt", [&](FILE* file) {
      PEM_write_X509(file, made.get());
      if (above_) PEM_write_X509(file, certificate_.get());
    });
    write(folder / "own.key", [&](FILE* file) {
      PEM_write_PrivateKey(file, key.get(), nullptr, nullptr, 0, nullptr, nullptr);
    });
    ::chmod((folder / "own.key").c_str(), 0600);
    const Certificate& root = above_ ? above_->certificate_ : certificate_;
    write(folder / "ca.crt", [&](FILE* file) { PEM_write_X509(file, root.get()); });
    return serial_;
  }

  // Writes revoked.crl with that one certificate into `folder`.
  void write_revoked(long serial, const std::filesystem::path& folder) {
    const std::unique_ptr<X509_CRL, decltype(&X509_CRL_free)> list(X509_CRL_new(), X509_CRL_free);
    X509_CRL_set_version(list.get(), X509_CRL_VERSION_2);
    X509_CRL_set_issuer_name(list.get(), X509_get_subject_name(certificate_.get()));
    ASN1_TIME* time = X509_gmtime_adj(nullptr, -3600);
    X509_CRL_set1_lastUpdate(list.get(), time);
    X509_gmtime_adj(time, 1'000'000);
    X509_CRL_set1_nextUpdate(list.get(), time);
    X509_REVOKED* revoked = X509_REVOKED_new();
    ASN1_INTEGER* number = ASN1_INTEGER_new();
    ASN1_INTEGER_set(number, serial);
    X509_REVOKED_set_serialNumber(revoked, number);
    X509_REVOKED_set_revocationDate(revoked, time);
    X509_CRL_add0_revoked(list.get(), revoked);
    ASN1_INTEGER_free(number);
    ASN1_TIME_free(time);
    X509V3_CTX context{};
    X509V3_set_ctx(&context, certificate_.get(), nullptr, nullptr, list.get(), 0);
    X509_EXTENSION* id =
        X509V3_EXT_conf_nid(nullptr, &context, NID_authority_key_identifier, "keyid:always");
    X509_CRL_add_ext(list.get(), id, -1);
    X509_EXTENSION_free(id);
    X509_CRL_sign(list.get(), key_.get(), EVP_sha256());
    write(folder / "revoked.crl", [&](FILE* file) { PEM_write_X509_CRL(file, list.get()); });
  }

 private:
  using Key = std::unique_ptr<EVP_PKEY, decltype(&EVP_PKEY_free)>;
  using Certificate = std::unique_ptr<X509, decltype(&X509_free)>;

  static Key make_key() { return {EVP_EC_gen("P-256"), EVP_PKEY_free}; }

  Certificate make(const std::string& name, EVP_PKEY* key, std::chrono::seconds from,
                   std::chrono::seconds until) {
    Certificate made{X509_new(), X509_free};
    X509_set_version(made.get(), X509_VERSION_3);
    ASN1_INTEGER_set(X509_get_serialNumber(made.get()), ++serial_);
    X509_time_adj_ex(X509_getm_notBefore(made.get()), 0, from.count(), nullptr);
    X509_time_adj_ex(X509_getm_notAfter(made.get()), 0, until.count(), nullptr);
    X509_NAME* subject = X509_get_subject_name(made.get());
    X509_NAME_add_entry_by_NID(subject, NID_commonName, MBSTRING_UTF8,
                               reinterpret_cast<const unsigned char*>(name.c_str()), -1, -1, 0);
    X509_set_issuer_name(made.get(), subject);
    X509_set_pubkey(made.get(), key);
    return made;
  }

  void add(X509* certificate, int extension, const std::string& value) const {
    if (value.empty()) return;
    X509V3_CTX context{};
    X509V3_set_ctx(&context, certificate_.get(), certificate, nullptr, nullptr, 0);
    X509_EXTENSION* made = X509V3_EXT_conf_nid(nullptr, &context, extension, value.c_str());
    X509_add_ext(certificate, made, -1);
    X509_EXTENSION_free(made);
  }

  template <class Write>
  static void write(const std::filesystem::path& path, const Write& write) {
    FILE* file = std::fopen(path.c_str(), "we");
    write(file);
    std::fclose(file);
  }

  Key key_;
  Authority* above_;
  Certificate certificate_{nullptr, X509_free};
  long serial_ = 0;
};

}  // namespace dssm::test
