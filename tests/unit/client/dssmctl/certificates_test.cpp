// SPDX-License-Identifier: Apache-2.0
//
// Requests, certificates and revocation lists, made and read again.
// tests/process/dssmctl/pki_test.cpp has them judged by the program openssl.
#include "client/dssmctl/certificates.hpp"

#include <gtest/gtest.h>
#include <openssl/evp.h>
#include <openssl/pem.h>

#include "client/dssmctl/openssl.hpp"

namespace dssm::ctl::pki {
namespace {

constexpr std::time_t kNow = 1'800'000'000;  // 2027
constexpr std::time_t kEnd = kNow + 730 * kSecondsPerDay;
const Identity kHost{Kind::host, "pc2", "00112233445566778899aabbccddeeff"};
const Identity kProgram{Kind::program, "viewer", {}};

struct Certificates : testing::Test {
  Certificate certificate_for(const Identity& identity, const Authority& authority) {
    return issue(authority, {identity, key_}, kEnd).value();
  }

  Authority ca_ = make_authority("truck", kNow).value();
  Authority other_ca_ = make_authority("truck", kNow).value();  // the same name, another key
  Key key_ = make_key().value();
};

// What the block of a PEM text holds, changed by `change` and signed again by `key` unless nullptr.
template <class Change>
std::string changed_request(const std::string& pem, const Key& key, Change change) {
  const Bio bio = reading_bio(pem);
  const Owned<X509_REQ, X509_REQ_free> csr(
      PEM_read_bio_X509_REQ(bio.get(), nullptr, nullptr, nullptr));
  change(csr.get());
  if (key) X509_REQ_sign(csr.get(), key.get(), EVP_sha256());
  const Bio out = writing_bio();
  PEM_write_bio_X509_REQ(out.get(), csr.get());
  return text_in(out);
}

void set_name(X509_REQ* csr, const std::string& name) {
  const Owned<X509_NAME, X509_NAME_free> subject(X509_NAME_new());
  X509_NAME_add_entry_by_NID(subject.get(), NID_commonName, MBSTRING_UTF8,
                             reinterpret_cast<const unsigned char*>(name.data()),
                             static_cast<int>(name.size()), -1, 0);
  X509_REQ_set_subject_name(csr, subject.get());
}

// A request for `name` whose alternative names are `names`, as openssl's configuration writes them.
std::string request_with(const Key& key, const std::string& name, const std::string& names) {
  const Owned<X509_REQ, X509_REQ_free> csr(X509_REQ_new());
  set_name(csr.get(), name);
  X509_REQ_set_pubkey(csr.get(), key.get());
  if (!names.empty()) {
    const Extensions extensions(sk_X509_EXTENSION_new_null());
    sk_X509_EXTENSION_push(
        extensions.get(),
        X509V3_EXT_nconf_nid(nullptr, nullptr, NID_subject_alt_name, names.c_str()));
    X509_REQ_add_extensions(csr.get(), extensions.get());
  }
  X509_REQ_sign(csr.get(), key.get(), EVP_sha256());
  const Bio out = writing_bio();
  PEM_write_bio_X509_REQ(out.get(), csr.get());
  return text_in(out);
}

std::string error_of_request(const std::string& pem) {
  const Result<Request> request = parse_request_untrusted(pem);
  EXPECT_FALSE(request);
  if (request) return {};
  EXPECT_EQ(request.error().code, Errc::protocol);
  EXPECT_EQ(ERR_peek_error(), 0U);
  return request.error().message;
}

bool contains(const std::string& text, std::string_view part) {
  return text.find(part) != std::string::npos;
}

TEST_F(Certificates, AreForTheHostOrProgramThatRequestedThem) {
  for (const Identity& wanted : {kHost, kProgram}) {
    const Request request = parse_request_untrusted(make_request(key_, wanted).value()).value();
    const Certificate made = issue(ca_, request, kEnd).value();
    const Bundle read = parse_bundle_untrusted(pem_of(made)).value();
    ASSERT_EQ(read.certificates.size(), 1U);
    const Certificate& certificate = read.certificates.front();
    const Identity identity = identity_of(certificate);
    EXPECT_EQ(identity.kind, wanted.kind);
    EXPECT_EQ(identity.name, wanted.name);
    EXPECT_EQ(identity.host_id, wanted.host_id);
    EXPECT_EQ(end_of(certificate), kEnd);
    EXPECT_TRUE(have_same_key(certificate, key_));
    EXPECT_FALSE(have_same_key(certificate, ca_.key));
    EXPECT_TRUE(check_signature(certificate, {}, {ca_.certificate}));
    EXPECT_FALSE(is_self_signed(certificate));
  }
}

TEST_F(Certificates, AreServersOnlyForHosts) {
  const auto usage = [&](const Identity& identity) {
    return X509_get_extended_key_usage(certificate_for(identity, ca_).get());
  };
  EXPECT_EQ(usage(kHost), std::uint32_t{XKU_SSL_SERVER | XKU_SSL_CLIENT});
  EXPECT_EQ(usage(kProgram), std::uint32_t{XKU_SSL_CLIENT});
}

TEST_F(Certificates, AreValidOnAPcWhoseClockIsDecadesBehind) {
  const Certificate host = certificate_for(kHost, ca_);
  const RevocationList list = make_list(ca_, nullptr, {}, kNow).value();
  for (const ASN1_TIME* beginning :
       {X509_get0_notBefore(ca_.certificate.get()), X509_get0_notBefore(host.get()),
        X509_CRL_get0_lastUpdate(list.get())}) {
    EXPECT_EQ(ASN1_TIME_cmp_time_t(beginning, 0), 0);
  }
  std::tm end{};
  ASN1_TIME_to_tm(X509_CRL_get0_nextUpdate(list.get()), &end);
  EXPECT_EQ(end.tm_year + 1900, 9999);
}

TEST_F(Certificates, HaveSerialNumbersOf16BytesThatNeverRepeat) {
  const std::string one = serial_of(certificate_for(kHost, ca_));
  const std::string other = serial_of(certificate_for(kHost, ca_));
  EXPECT_EQ(one.size(), 32U);
  EXPECT_LT(one[0], '8');  // positive
  EXPECT_NE(one, other);
}

TEST_F(Certificates, OfAnotherCaWithTheSameNameAreNotAccepted) {
  const Certificate certificate = certificate_for(kHost, ca_);
  const Result<void> checked = check_signature(certificate, {}, {other_ca_.certificate});
  ASSERT_FALSE(checked);
  EXPECT_EQ(checked.error().code, Errc::protocol);
  EXPECT_TRUE(check_signature(certificate, {}, {other_ca_.certificate, ca_.certificate}));
  EXPECT_FALSE(check_signature(certificate, {}, {}));
}

TEST_F(Certificates, OfAHostCannotSignOthers) {
  const Certificate host = certificate_for(kHost, ca_);
  const Certificate forged = certificate_for(kProgram, {key_, host});
  EXPECT_FALSE(check_signature(forged, {host}, {ca_.certificate}));
}

TEST_F(Certificates, KeysAreReadBackAndThoseOfOtherKindsAreRefused) {
  const std::string pem = pem_of(key_);
  EXPECT_TRUE(pem.starts_with("-----BEGIN PRIVATE KEY-----")) << "not PKCS#8";
  EXPECT_TRUE(have_same_key(certificate_for(kHost, ca_), parse_key(pem).value()));
  EXPECT_FALSE(parse_key("no key"));
  const Key other = owned<EVP_PKEY_free>(EVP_PKEY_Q_keygen(nullptr, nullptr, "EC", "P-384"));
  const Result<Key> refused = parse_key(pem_of(other));
  ASSERT_FALSE(refused);
  EXPECT_TRUE(contains(refused.error().message, "P-256")) << refused.error().message;
}

TEST_F(Certificates, RefuseARequestThatWasChangedOnItsWay) {
  const std::string pem = make_request(key_, kHost).value();
  const std::string changed =
      changed_request(pem, nullptr, [](X509_REQ* csr) { set_name(csr, "pc3"); });
  EXPECT_TRUE(contains(error_of_request(changed), "signature")) << error_of_request(changed);
}

TEST_F(Certificates, RefuseARequestForAKeyThatTheSenderDoesNotHave) {
  const Key other = make_key().value();
  const std::string pem = changed_request(make_request(key_, kHost).value(), other, [](X509_REQ*) {
  });  // the public key stays, the signature is another one's
  EXPECT_TRUE(contains(error_of_request(pem), "signature")) << error_of_request(pem);
}

TEST_F(Certificates, RefuseARequestWithAnotherKindOfKey) {
  const Key other = owned<EVP_PKEY_free>(EVP_PKEY_Q_keygen(nullptr, nullptr, "EC", "P-384"));
  EXPECT_TRUE(contains(error_of_request(make_request(other, kHost).value()), "P-256"));
}

TEST_F(Certificates, RefuseARequestWithBadNames) {
  const std::string id = "URI:urn:dssm:host-id:" + kHost.host_id;
  const struct {
    const char* what;
    std::string name, alternative_names;
    const char* error;
  } requests[] = {
      {"no names", "pc2", "", "neither for a host nor for a program"},
      {"only DNS", "pc2", "DNS:pc2", "neither for a host nor for a program"},
      {"a name that no host has", "pc_2", id, "other characters"},
      {"a name that is too long", std::string(32, 'a'), id, "32 bytes"},
      {"a zero byte", std::string("pc2\0x", 5), id, "other characters"},
      {"an id that is too short", "pc2", "URI:urn:dssm:host-id:0011", "host id"},
      {"an id in upper case", "pc2", "URI:urn:dssm:host-id:00112233445566778899AABBCCDDEEFF",
       "host id"},
      {"two hosts", "pc2", id + "," + id, "more than one"},
      {"host and program", "pc2", id + ",URI:urn:dssm:program:pc2", "more than one"},
      {"another program's name", "viewer", "URI:urn:dssm:program:mapper", "mapper"},
      {"a program's name with a slash", "a/b", "URI:urn:dssm:program:a/b", "is not a name"},
  };
  for (const auto& request : requests) {
    const std::string error =
        error_of_request(request_with(key_, request.name, request.alternative_names));
    EXPECT_TRUE(contains(error, request.error)) << request.what << ": " << error;
  }
  EXPECT_TRUE(contains(error_of_request("nonsense"), "not a request"));
  EXPECT_TRUE(contains(error_of_request(pem_of(ca_.certificate)), "not a request"));
}

TEST_F(Certificates, TakeNothingElseFromARequest) {
  const std::string pem = request_with(
      key_, "pc2", "URI:urn:dssm:host-id:" + kHost.host_id + ",DNS:pc3,email:root@pc3,IP:10.0.0.1");
  const Certificate certificate = issue(ca_, parse_request_untrusted(pem).value(), kEnd).value();
  const auto asked = certificate_for(kHost, ca_);
  const auto names = [](const Certificate& of) {
    const Bio bio = writing_bio();
    const int index = X509_get_ext_by_NID(of.get(), NID_subject_alt_name, -1);
    X509V3_EXT_print(bio.get(), X509_get_ext(of.get(), index), 0, 0);
    return text_in(bio);
  };
  EXPECT_EQ(names(certificate), "DNS:pc2, URI:urn:dssm:host-id:" + kHost.host_id);
  EXPECT_EQ(names(certificate), names(asked));
}

TEST_F(Certificates, NamesOfProgramsHave63CharactersAtMost) {
  for (const std::string& good : {std::string("a.b_c-D9"), std::string(63, 'a')}) {
    EXPECT_TRUE(check_identity({Kind::program, good, {}})) << good;
  }
  for (const std::string& bad : {std::string(), std::string(64, 'a'), std::string("a b"),
                                 std::string("a,URI:urn:x"), std::string("a\n")}) {
    EXPECT_FALSE(check_identity({Kind::program, bad, {}})) << bad;
    EXPECT_FALSE(make_request(key_, {Kind::program, bad, {}})) << bad;
  }
  EXPECT_FALSE(make_authority("a/b", kNow));
  EXPECT_TRUE(make_authority(std::string(kMaxVehicleBytes, 'a'), kNow));
}

using RevocationLists = Certificates;

TEST_F(RevocationLists, ContainWhatWasRevokedUnderRisingNumbers) {
  const Certificate one = certificate_for(kHost, ca_);
  const Certificate two = certificate_for(kProgram, ca_);
  const RevocationList first = make_list(ca_, nullptr, {}, kNow).value();
  const RevocationList second = make_list(ca_, first, {one}, kNow).value();
  const RevocationList third = make_list(ca_, second, {two}, kNow).value();
  EXPECT_EQ(number_of(first) + number_of(second) + number_of(third), "123");
  EXPECT_EQ(size_of(first), 0U);
  EXPECT_EQ(size_of(third), 2U);
  EXPECT_FALSE(is_revoked(one, {first}));
  EXPECT_TRUE(is_revoked(one, {second}));
  EXPECT_FALSE(is_revoked(two, {second}));
  EXPECT_TRUE(is_revoked(one, {third}) && is_revoked(two, {third}));
  EXPECT_TRUE(is_newer(third, second));
  EXPECT_FALSE(is_newer(second, second) || is_newer(second, third));
  const Bundle read = parse_bundle_untrusted(pem_of(third)).value();
  ASSERT_EQ(read.lists.size(), 1U);
  EXPECT_TRUE(is_revoked(one, read.lists));
  EXPECT_TRUE(is_signed_by(third, ca_.certificate));
  EXPECT_EQ(issuer_of(third), "DSSM CA of truck");
}

TEST_F(RevocationLists, CompareNumbersOfMoreThanOneDigit) {
  RevocationList list = make_list(ca_, nullptr, {}, kNow).value();
  const RevocationList second = make_list(ca_, list, {}, kNow).value();
  for (int i = 1; i < 300; ++i) list = make_list(ca_, list, {}, kNow).value();
  EXPECT_EQ(number_of(list), "300");
  EXPECT_TRUE(is_newer(list, second));
}

TEST_F(RevocationLists, CountOnlyWhenSignedAndTheNewestOfEachCa) {
  const RevocationList old = make_list(ca_, nullptr, {}, kNow).value();
  const RevocationList newer = make_list(ca_, old, {}, kNow).value();
  const RevocationList foreign = make_list(other_ca_, newer, {}, kNow).value();
  EXPECT_FALSE(is_signed_by(foreign, ca_.certificate));
  using Lists = std::vector<RevocationList>;
  const std::vector<Certificate> ours = {ca_.certificate};
  EXPECT_EQ(newest_lists(ours, {old, newer, foreign}), Lists{newer});
  EXPECT_EQ(newest_lists(ours, {newer, old}), Lists{newer});
  EXPECT_EQ(newest_lists(ours, {foreign}), Lists{});
  const std::vector<Certificate> both = {ca_.certificate, other_ca_.certificate};
  EXPECT_EQ(newest_lists(both, {foreign, old}), (Lists{old, foreign}));
}

TEST_F(Certificates, ADamagedBundleIsRefused) {
  const std::string pem = pem_of(certificate_for(kHost, ca_)) + pem_of(ca_.certificate);
  EXPECT_EQ(parse_bundle_untrusted(pem).value().certificates.size(), 2U);
  EXPECT_EQ(parse_bundle_untrusted("text\n" + pem + "more text\n").value().certificates.size(), 2U);
  EXPECT_FALSE(parse_bundle_untrusted(""));
  EXPECT_FALSE(parse_bundle_untrusted(pem_of(key_)));
  // Any place where it may be cut off, except after the first certificate's end.
  for (std::size_t size = 0; size + 2 < pem.size(); ++size) {
    const Result<Bundle> cut = parse_bundle_untrusted(pem.substr(0, size));
    EXPECT_TRUE(!cut || cut->certificates.size() == 1) << size;
  }
  std::string changed = pem;
  changed[40] = changed[40] == 'A' ? 'B' : 'A';
  EXPECT_FALSE(parse_bundle_untrusted(changed));
  EXPECT_EQ(ERR_peek_error(), 0U);
}

}  // namespace
}  // namespace dssm::ctl::pki
