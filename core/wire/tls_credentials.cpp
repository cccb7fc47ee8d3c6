// SPDX-License-Identifier: Apache-2.0
#include "core/wire/tls_credentials.hpp"

#include <fcntl.h>
#include <fmt/chrono.h>
#include <fmt/format.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <openssl/x509v3.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <ctime>
#include <string_view>
#include <utility>
#include <vector>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::wire {
namespace openssl {

template <auto function>
struct Free {
  template <class T>
  void operator()(T* object) const noexcept {
    function(object);
  }
};
inline void free_stack(STACK_OF(X509) * certificates) noexcept {
  sk_X509_pop_free(certificates, X509_free);
}
inline void free_names(GENERAL_NAMES* names) noexcept { GENERAL_NAMES_free(names); }

using Bio = std::unique_ptr<BIO, Free<BIO_free>>;
using Certificate = std::unique_ptr<X509, Free<X509_free>>;
using Stack = std::unique_ptr<STACK_OF(X509), Free<free_stack>>;
using Names = std::unique_ptr<GENERAL_NAMES, Free<free_names>>;
using List = std::unique_ptr<X509_CRL, Free<X509_CRL_free>>;

}  // namespace openssl

std::string subject_of(const X509* certificate) {
  std::array<char, 256> text{};
  X509_NAME_get_text_by_NID(X509_get_subject_name(certificate), NID_commonName, text.data(),
                            text.size());
  return printable(text.data());
}

namespace {

using openssl::Bio;
using openssl::Certificate;
using openssl::Free;
using openssl::Names;
using openssl::Stack;

constexpr std::size_t kMaxFileBytes = 1U << 20;
constexpr std::string_view kHostIdUri = "urn:dssm:host-id:", kProgramUri = "urn:dssm:program:";

// TLS 1.3's suites, the cheapest on PCs first.
constexpr const char* kSuites =
    "TLS_AES_128_GCM_SHA256:TLS_CHACHA20_POLY1305_SHA256:TLS_AES_256_GCM_SHA384";
// Key exchanges, each of less than a millisecond. OpenSSL's own list has finite fields of up to
// 8192 bits, which take 0.1 s, before the other side has shown who it is.
constexpr const char* kGroups = "X25519:P-256";
// Bytes that the kernel hands over in one call: four records.
constexpr std::size_t kReadBytes = 68U << 10;
constexpr long kMaxChainBytes = 16 << 10;  // of the other side's certificates
// Sessions are resumed for so long after the full handshake, which proves who has the private keys.
constexpr long kTicketSeconds = 24L * 60 * 60;

Error openssl_error(const std::string& what) {
  const unsigned long code = ERR_peek_last_error();
  const char* reason = code ? ERR_reason_error_string(code) : nullptr;
  ERR_clear_error();
  return {Errc::invalid_argument, what + ": " + (reason ? reason : "OpenSSL fails")};
}

// OpenSSL would ask at the terminal.
int no_pass_phrase(char*, int, int, void*) { return 0; }

// Whether reading a PEM file ended at its end, and not at a block that is damaged.
bool is_at_end() {
  const bool at_end = ERR_GET_REASON(ERR_peek_last_error()) == PEM_R_NO_START_LINE;
  if (at_end) ERR_clear_error();
  return at_end;
}

// Which files are in `folder`: another text when one was replaced, written, added or removed.
std::string files_in(const std::string& folder) {
  std::string files;
  for (const char* name : {"/ca.crt", "/own.crt", "/own.key", "/revoked.crl"}) {
    struct stat status {};
    if (::stat((folder + name).c_str(), &status) != 0) status = {};
    files += fmt::format("{}:{}:{}.{} ", status.st_dev, status.st_ino, status.st_mtim.tv_sec,
                         status.st_mtim.tv_nsec);
  }
  return files;
}

struct File {
  std::string path, text;
  mode_t mode = 0;
};

Result<File> read_file(const std::string& path) {
  File file{path, {}, 0};
  const UniqueFd fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  struct stat status {};
  if (!fd || ::fstat(fd.get(), &status) != 0) return os_error("read '" + path + "'");
  if (!S_ISREG(status.st_mode) || status.st_size > static_cast<off_t>(kMaxFileBytes)) {
    return Error{Errc::invalid_argument, "'" + path + "' is not a file of at most 1 MiB"};
  }
  file.mode = status.st_mode;
  file.text.resize(static_cast<std::size_t>(status.st_size));
  std::size_t read = 0;
  while (read < file.text.size()) {
    const ssize_t count = ::read(fd.get(), file.text.data() + read, file.text.size() - read);
    if (count < 0) return os_error("read '" + path + "'");
    if (count == 0) break;
    read += static_cast<std::size_t>(count);
  }
  file.text.resize(read);
  return file;
}

Bio reader(const File& file) {
  return Bio(BIO_new_mem_buf(file.text.data(), static_cast<int>(file.text.size())));
}

// All certificates of a PEM file, at least one.
Result<std::vector<Certificate>> certificates_of(const File& file) {
  std::vector<Certificate> found;
  const Bio bio = reader(file);
  while (X509* next = PEM_read_bio_X509(bio.get(), nullptr, nullptr, nullptr)) {
    found.emplace_back(next);
  }
  const bool is_whole = is_at_end();
  if (found.empty()) return openssl_error("'" + file.path + "' holds no certificate in PEM form");
  if (!is_whole) return openssl_error("a certificate in '" + file.path + "' is damaged");
  return found;
}

std::string_view text_of(const ASN1_STRING* string) {
  return {reinterpret_cast<const char*>(ASN1_STRING_get0_data(string)),
          static_cast<std::size_t>(ASN1_STRING_length(string))};
}

Result<HostId> parse_host_id(std::string_view digits) {
  HostId id{};
  const auto value = [](char c) {
    return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
  };
  bool is_good = digits.size() == 2 * id.size();
  for (std::size_t i = 0; is_good && i < id.size(); ++i) {
    const int high = value(digits[2 * i]), low = value(digits[2 * i + 1]);
    is_good = high >= 0 && low >= 0;
    id[i] = static_cast<HostId::value_type>(high * 16 + low);
  }
  if (is_good) return id;
  return Error{Errc::invalid_argument, "a host id has 32 digits 0-9, a-f"};
}

}  // namespace

Result<CertifiedPeer> named_by(X509* certificate) {
  const auto bad = [&](std::string_view what) {
    return Error{Errc::no_permission,
                 fmt::format("the certificate of '{}' {}; `dssmctl pki` makes such that are right "
                             "(docs/security.md)",
                             subject_of(certificate), what)};
  };
  CertifiedPeer peer;
  std::string host, host_id, program;
  const Names names(static_cast<GENERAL_NAMES*>(
      X509_get_ext_d2i(certificate, NID_subject_alt_name, nullptr, nullptr)));
  for (int i = 0; i < sk_GENERAL_NAME_num(names.get()); ++i) {
    const GENERAL_NAME* name = sk_GENERAL_NAME_value(names.get(), i);
    if (name->type == GEN_DNS && host.empty()) host = text_of(name->d.dNSName);
    if (name->type != GEN_URI) continue;
    const std::string_view uri = text_of(name->d.uniformResourceIdentifier);
    if (uri.starts_with(kHostIdUri)) host_id = uri.substr(kHostIdUri.size());
    if (uri.starts_with(kProgramUri)) program = uri.substr(kProgramUri.size());
  }
  if (!program.empty()) {
    if (!host_id.empty()) return bad("names a host and a program");
    if (program.size() > kMaxProgramBytes || has_control(program) || !is_utf8(program)) {
      return bad("names a program with more than 127 bytes, or with control characters");
    }
    peer.name = program;
    return peer;
  }
  if (host.empty() || host_id.empty()) {
    return bad(
        "names neither a host (DNS name and URI urn:dssm:host-id:ID) nor a program (URI "
        "urn:dssm:program:NAME)");
  }
  if (!check_host_name(host)) return bad("has a DNS name that is not a host's name of DSSM");
  const Result<HostId> id = parse_host_id(host_id);
  if (!id) return bad("has a host id that is not 32 digits 0-9, a-f");
  peer.kind = CertifiedPeer::Kind::host;
  peer.name = host;
  peer.host_id = *id;
  return peer;
}

namespace {

Time time_of(const ASN1_TIME* time) {
  std::tm parts{};
  if (ASN1_TIME_to_tm(time, &parts) != 1) return Time{};
  return time_from_ns(static_cast<std::int64_t>(::timegm(&parts)) * 1'000'000'000);
}

// From then on a list of each authority is needed.
Result<void> load_revoked(X509_STORE* store, const std::vector<Certificate>& authorities,
                          const std::string& path) {
  struct stat status {};
  if (::lstat(path.c_str(), &status) != 0 && errno == ENOENT) return {};
  const File file = DSSM_TRY(read_file(path));
  const Bio bio = reader(file);
  std::vector<openssl::List> lists;
  while (X509_CRL* next = PEM_read_bio_X509_CRL(bio.get(), nullptr, nullptr, nullptr)) {
    lists.emplace_back(next);
  }
  const bool is_whole = is_at_end();
  if (lists.empty()) return openssl_error("'" + path + "' holds no revocation list in PEM form");
  if (!is_whole) return openssl_error("a revocation list in '" + path + "' is damaged");
  for (const Certificate& authority : authorities) {
    // By its key, too: while one authority replaces another, both may have the same name.
    const auto count = std::count_if(lists.begin(), lists.end(), [&](const openssl::List& list) {
      return X509_NAME_cmp(X509_CRL_get_issuer(list.get()),
                           X509_get_subject_name(authority.get())) == 0 &&
             X509_CRL_verify(list.get(), X509_get0_pubkey(authority.get())) == 1;
    });
    ERR_clear_error();
    if (count == 1) continue;
    return Error{Errc::invalid_argument,
                 fmt::format("'{}' holds {} revocation lists of '{}'; of each authority in ca.crt "
                             "one is needed",
                             path, count, subject_of(authority.get()))};
  }
  for (const openssl::List& list : lists) X509_STORE_add_crl(store, list.get());
  X509_STORE_set_flags(store, X509_V_FLAG_CRL_CHECK | X509_V_FLAG_CRL_CHECK_ALL);
  return {};
}

}  // namespace

struct CertifiedPeer::Certificates {
  openssl::Certificate own;
  openssl::Stack others;
};

namespace {

// X509_V_OK, or why `certificates` are not believed.
//   use  "ssl_client", "ssl_server"; "default": any
int verify(SSL_CTX* context, const CertifiedPeer::Certificates& certificates, const char* use) {
  const std::unique_ptr<X509_STORE_CTX, Free<X509_STORE_CTX_free>> check(X509_STORE_CTX_new());
  if (!check || X509_STORE_CTX_init(check.get(), SSL_CTX_get_cert_store(context),
                                    certificates.own.get(), certificates.others.get()) != 1) {
    return X509_V_ERR_OUT_OF_MEM;
  }
  X509_STORE_CTX_set_default(check.get(), use);
  return X509_verify_cert(check.get()) == 1 ? X509_V_OK : X509_STORE_CTX_get_error(check.get());
}

bool is_temporary(int problem) noexcept {
  return problem == X509_V_ERR_CERT_HAS_EXPIRED || problem == X509_V_ERR_CERT_NOT_YET_VALID ||
         problem == X509_V_ERR_CERT_REVOKED || problem == X509_V_ERR_CRL_NOT_YET_VALID ||
         problem == X509_V_ERR_CRL_HAS_EXPIRED;
}

// --- tickets, which hold all that this side needs to resume a session; OpenSSL encrypts them with
// keys that the context made at random, and puts in only the first certificate of the other side

// Puts the others there, too: they are needed to verify the first one again.
int put_others(SSL* session, void*) {
  std::string der;
  STACK_OF(X509)* others = SSL_get_peer_cert_chain(session);
  for (int i = 0; i < sk_X509_num(others); ++i) {
    unsigned char* bytes = nullptr;
    const int count = i2d_X509(sk_X509_value(others, i), &bytes);
    if (count < 0) return 0;
    der.append(reinterpret_cast<const char*>(bytes), static_cast<std::size_t>(count));
    OPENSSL_free(bytes);
  }
  return SSL_SESSION_set1_ticket_appdata(SSL_get_session(session), der.data(), der.size());
}

Stack others_in(SSL_SESSION* session) {
  Stack others(sk_X509_new_null());
  void* der = nullptr;
  std::size_t count = 0;
  SSL_SESSION_get0_ticket_appdata(session, &der, &count);
  const auto* at = static_cast<const unsigned char*>(der);
  const auto* const end = at + count;
  while (at != end) {
    X509* const next = d2i_X509(nullptr, &at, end - at);
    if (!next) break;
    sk_X509_push(others.get(), next);
  }
  return others;
}

Result<CertifiedPeer> peer_with(Certificate certificate, Stack others) {
  CertifiedPeer peer = DSSM_TRY(named_by(certificate.get()));
  peer.certificates = std::make_shared<const CertifiedPeer::Certificates>(
      CertifiedPeer::Certificates{std::move(certificate), std::move(others)});
  return peer;
}

// Whether the session of a ticket is resumed: while these credentials accept the other side's
// certificate. Otherwise the handshake becomes a full one, which reports to both sides why not. No
// new ticket replaces the one that is used, so that kTicketSeconds count from the full handshake.
SSL_TICKET_RETURN on_ticket(SSL*, SSL_SESSION* session, const unsigned char*, std::size_t,
                            SSL_TICKET_STATUS status, void* credentials) {
  if (status != SSL_TICKET_SUCCESS && status != SSL_TICKET_SUCCESS_RENEW) {
    return SSL_TICKET_RETURN_IGNORE_RENEW;
  }
  X509* const certificate = SSL_SESSION_get0_peer(session);
  if (!certificate || X509_up_ref(certificate) != 1) return SSL_TICKET_RETURN_IGNORE_RENEW;
  const Result<CertifiedPeer> peer = peer_with(Certificate(certificate), others_in(session));
  const bool is_accepted = peer && static_cast<const TlsCredentials*>(credentials)->check(*peer);
  return is_accepted ? SSL_TICKET_RETURN_USE : SSL_TICKET_RETURN_IGNORE_RENEW;
}

}  // namespace

std::string CertifiedPeer::str() const {
  return fmt::format("{} '{}'", kind == Kind::host ? "host" : "program", name);
}

Result<void> check_certified(const Greeting& greeting, const CertifiedPeer& peer,
                             TransportEnd end) {
  const bool is_host = peer.kind == CertifiedPeer::Kind::host;
  if (is_host ? greeting.host == peer.name && greeting.host_id == peer.host_id
              : greeting.program != "dssmd" && end == TransportEnd::accepted) {
    return {};
  }
  return Error{Errc::no_permission,
               fmt::format("{} greets with the certificate of {}{}; issue one for it "
                           "(docs/security.md)",
                           greeting.str(), peer.str(),
                           is_host && greeting.host == peer.name ? " with another host id" : "")};
}

std::string refusal_text(const std::string& subject, int problem) {
  std::string text = fmt::format("the certificate of '{}' is not accepted: {}", subject,
                                 X509_verify_cert_error_string(problem));
  switch (problem) {
    case X509_V_ERR_CERT_NOT_YET_VALID:
    case X509_V_ERR_CERT_HAS_EXPIRED:
    case X509_V_ERR_CRL_NOT_YET_VALID:
    case X509_V_ERR_CRL_HAS_EXPIRED:
      return text + fmt::format(
                        "; this PC's clock says {:%Y-%m-%d %H:%M} UTC: is it right? "
                        "(`dssmctl pki renew` makes a new certificate)",
                        fmt::gmtime(std::time(nullptr)));
    case X509_V_ERR_UNABLE_TO_GET_ISSUER_CERT_LOCALLY:
    case X509_V_ERR_DEPTH_ZERO_SELF_SIGNED_CERT:
    case X509_V_ERR_SELF_SIGNED_CERT_IN_CHAIN:
    case X509_V_ERR_CERT_SIGNATURE_FAILURE:
    case X509_V_ERR_UNABLE_TO_VERIFY_LEAF_SIGNATURE:
      return text + "; it is of another vehicle's certificate authority than ca.crt";
    default:
      return text;
  }
}

std::shared_ptr<const TlsCredentials> credentials_of(const Greeting& self) {
  return self.credentials ? self.credentials->now : nullptr;
}

Result<CertifiedPeer> certified_peer(ssl_st* session) {
  Certificate certificate(SSL_get1_peer_certificate(session));
  if (!certificate) return Error{Errc::no_permission, "the other side shows no certificate"};
  STACK_OF(X509)* others = SSL_get_peer_cert_chain(session);
  return peer_with(std::move(certificate),
                   others ? Stack(X509_chain_up_ref(others)) : others_in(SSL_get_session(session)));
}

TlsCredentials::TlsCredentials(const std::string& folder)
    : folder_(folder), files_(files_in(folder)) {}

TlsCredentials::~TlsCredentials() { SSL_CTX_free(context_); }

Result<std::shared_ptr<const TlsCredentials>> TlsCredentials::load(const std::string& folder) {
  const std::string help = "; `dssmctl pki` makes these files (docs/security.md)";
  const auto with_help = [&](Error error) {
    error.message = "credentials: " + error.message + help;
    return error;
  };
  const std::shared_ptr<TlsCredentials> made(new TlsCredentials(folder));
  Result<void> loaded = made->read();
  if (!loaded) return with_help(std::move(loaded).error());
  return std::shared_ptr<const TlsCredentials>(made);
}

Result<std::shared_ptr<const TlsCredentials>> TlsCredentials::load_if_changed() const {
  if (files_in(folder_) == files_) return std::shared_ptr<const TlsCredentials>();
  return load(folder_);
}

Result<void> TlsCredentials::read() {
  ERR_clear_error();
  // A program may hold connections until after exit() has called OpenSSL's own clean-up.
  OPENSSL_init_ssl(OPENSSL_INIT_NO_ATEXIT, nullptr);
  context_ = SSL_CTX_new(TLS_method());
  if (!context_) return openssl_error("set up TLS");
  SSL_CTX_set_min_proto_version(context_, TLS1_3_VERSION);
  SSL_CTX_set_ciphersuites(context_, kSuites);
  if (SSL_CTX_set1_groups_list(context_, kGroups) != 1) return openssl_error("set up TLS");
  constexpr unsigned char kSessionsOf[] = "dssmd";
  SSL_CTX_set_session_id_context(context_, kSessionsOf, sizeof kSessionsOf);
  SSL_CTX_set_num_tickets(context_, 1);
  SSL_CTX_set_timeout(context_, kTicketSeconds);
  SSL_CTX_set_session_ticket_cb(context_, put_others, on_ticket, this);
  SSL_CTX_set_max_cert_list(context_, kMaxChainBytes);
  SSL_CTX_set_session_cache_mode(context_, SSL_SESS_CACHE_OFF);
  SSL_CTX_set_mode(context_, SSL_MODE_RELEASE_BUFFERS);
  SSL_CTX_set_read_ahead(context_, 1);
  SSL_CTX_set_default_read_buffer_len(context_, kReadBytes);

  const File ca = DSSM_TRY(read_file(folder_ + "/ca.crt"));
  X509_STORE* store = SSL_CTX_get_cert_store(context_);
  const std::vector<Certificate> authorities = DSSM_TRY(certificates_of(ca));
  for (const Certificate& one : authorities) {
    if (X509_STORE_add_cert(store, one.get()) != 1) return openssl_error("take '" + ca.path + "'");
  }
  DSSM_TRY(load_revoked(store, authorities, folder_ + "/revoked.crl"));

  const File own = DSSM_TRY(read_file(folder_ + "/own.crt"));
  std::vector<Certificate> chain = DSSM_TRY(certificates_of(own));
  if (SSL_CTX_use_certificate(context_, chain.front().get()) != 1) {
    return openssl_error("use '" + own.path + "'");
  }
  for (auto one = chain.begin() + 1; one != chain.end(); ++one) {
    if (SSL_CTX_add1_chain_cert(context_, one->get()) != 1) {
      return openssl_error("use '" + own.path + "'");
    }
  }
  const File key = DSSM_TRY(read_file(folder_ + "/own.key"));
  if (key.mode & S_IRWXO) {
    return Error{Errc::no_permission, fmt::format("every user can use '{}'; `chmod o= {}`, and "
                                                  "make a new one if others may have read it",
                                                  key.path, key.path)};
  }
  const std::unique_ptr<EVP_PKEY, Free<EVP_PKEY_free>> private_key(
      PEM_read_bio_PrivateKey(reader(key).get(), nullptr, no_pass_phrase, nullptr));
  if (!private_key) {
    return openssl_error("'" + key.path +
                         "' holds no private key in PEM form without a pass phrase");
  }
  if (SSL_CTX_use_PrivateKey(context_, private_key.get()) != 1) {
    ERR_clear_error();
    return Error{Errc::invalid_argument, "'" + key.path + "' is not the key of '" + own.path + "'"};
  }

  own_ = DSSM_TRY(named_by(chain.front().get()), "'" + own.path + "'");
  own_valid_until_ = time_of(X509_get0_notAfter(chain.front().get()));
  Stack others(sk_X509_new_null());
  for (auto one = chain.begin() + 1; one != chain.end(); ++one) {
    sk_X509_push(others.get(), one->release());
  }
  own_.certificates = std::make_shared<const CertifiedPeer::Certificates>(
      CertifiedPeer::Certificates{std::move(chain.front()), std::move(others)});
  for (const char* use : {"ssl_client", "ssl_server"}) {
    if (own_.kind == CertifiedPeer::Kind::program && std::string_view(use) == "ssl_server") break;
    const int problem = verify(context_, *own_.certificates, use);
    if (problem == X509_V_OK || is_temporary(problem)) continue;
    return Error{Errc::invalid_argument, "'" + own.path + "': " + refusal_text(own_.name, problem)};
  }
  return {};
}

std::string TlsCredentials::own_problem() const {
  const int problem = verify(context_, *own_.certificates, "default");
  return problem == X509_V_OK ? std::string() : refusal_text(own_.name, problem);
}

Result<void> TlsCredentials::check(const CertifiedPeer& peer) const {
  const int problem = verify(context_, *peer.certificates, "default");
  if (problem == X509_V_OK) return {};
  return Error{Errc::no_permission, refusal_text(peer.name, problem)};
}

}  // namespace dssm::wire
