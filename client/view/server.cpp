// SPDX-License-Identifier: Apache-2.0
#include "client/view/server.hpp"

#include <arpa/inet.h>
#include <fmt/format.h>
#include <libwebsockets.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <openssl/err.h>
#include <openssl/ssl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <map>
#include <memory>
#include <string>
#include <system_error>
#include <tuple>
#include <utility>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

constexpr std::size_t kMaxRequestBytes = 64U << 10;  // of a WebSocket's message to this server
constexpr std::size_t kTurnBytes = 256U << 10;  // sent to one client before others have their turn
constexpr Duration kCredentialsPeriod = std::chrono::seconds(5);
constexpr unsigned kMaxDescriptors = 256;  // of connections and files at once
constexpr std::size_t kMaxReported = 100;  // different reasons for refusals, each once

// The value of a request's header; empty: it has none.
std::string header(lws* connection, lws_token_indexes which) {
  const int length = lws_hdr_total_length(connection, which);
  if (length <= 0) return {};
  std::string value(static_cast<std::size_t>(length) + 1, '\0');
  const int copied = lws_hdr_copy(connection, value.data(), length + 1, which);
  value.resize(copied > 0 ? static_cast<std::size_t>(copied) : 0);
  return value;
}

// "pc1:8765", "[::1]:8765" or "pc1" without the port.
std::string_view without_port(std::string_view host) {
  if (host.starts_with('[')) {
    const std::size_t end = host.find(']');
    return end == std::string_view::npos ? host : host.substr(1, end - 1);
  }
  return host.substr(0, host.find(':'));
}

std::string lower_case(std::string text) {
  for (char& c : text) {
    if (c >= 'A' && c <= 'Z') c = static_cast<char>(c - 'A' + 'a');
  }
  return text;
}

std::string this_pc() {
  std::array<char, 256> name{};
  return ::gethostname(name.data(), name.size() - 1) == 0 ? lower_case(name.data()) : "";
}

// Whether this process listens at that port, and at no other address than that: libwebsockets
// listens at all addresses when it does not find the one that is wanted.
bool listens_only_at(const std::string& address, int port) {
  in6_addr wanted_v6{};
  in_addr wanted_v4{};
  const bool is_v4 = ::inet_pton(AF_INET, address.c_str(), &wanted_v4) == 1;
  if (!is_v4) ::inet_pton(AF_INET6, address.c_str(), &wanted_v6);
  bool is_there = false;
  for (int fd = 0; fd < static_cast<int>(kMaxDescriptors); ++fd) {
    int listens = 0;
    socklen_t bytes = sizeof listens;
    if (::getsockopt(fd, SOL_SOCKET, SO_ACCEPTCONN, &listens, &bytes) != 0 || listens == 0)
      continue;
    sockaddr_storage bound{};
    bytes = sizeof bound;
    if (::getsockname(fd, reinterpret_cast<sockaddr*>(&bound), &bytes) != 0) continue;
    const auto& v4 = reinterpret_cast<const sockaddr_in&>(bound);
    const auto& v6 = reinterpret_cast<const sockaddr_in6&>(bound);
    const bool is_it = bound.ss_family == AF_INET ? is_v4 && v4.sin_addr.s_addr == wanted_v4.s_addr
                                                  : !is_v4 && std::memcmp(&v6.sin6_addr, &wanted_v6,
                                                                          sizeof wanted_v6) == 0;
    if ((bound.ss_family == AF_INET ? v4.sin_port : v6.sin6_port) !=
        htons(static_cast<std::uint16_t>(port))) {
      continue;
    }
    if (!is_it) return false;
    is_there = true;
  }
  return is_there;
}

}  // namespace

bool is_address(const std::string& text) {
  std::array<unsigned char, sizeof(in6_addr)> ignored{};
  return ::inet_pton(AF_INET, text.c_str(), ignored.data()) == 1 ||
         ::inet_pton(AF_INET6, text.c_str(), ignored.data()) == 1;
}

// --- messages and peers

Message::Message(std::size_t bytes, bool is_text)
    : buffer_(std::make_shared<std::vector<unsigned char>>(LWS_PRE + bytes)), is_text_(is_text) {}

Message Message::text(std::string_view text) {
  Message message(text.size(), true);
  std::ranges::copy(text, message.buffer_->data() + LWS_PRE);
  return message;
}

Message Message::binary(const std::vector<std::span<const std::byte>>& parts) {
  std::size_t bytes = 0;
  for (const auto part : parts) bytes += part.size();
  Message message(bytes, false);
  unsigned char* to = message.buffer_->data() + LWS_PRE;
  for (const auto part : parts) {
    if (!part.empty()) std::memcpy(to, part.data(), part.size());
    to += part.size();
  }
  return message;
}

std::size_t Message::bytes() const { return buffer_->size() - LWS_PRE; }

void Peer::send(Message message) {
  if (is_closing_) return;
  waiting_bytes_ += message.bytes();
  if (waiting_.empty()) lws_callback_on_writable(connection_);
  waiting_.push_back(std::move(message));
}

void Peer::close(std::string_view reason) {
  if (std::exchange(is_closing_, true)) return;
  waiting_.clear();
  waiting_bytes_ = 0;
  std::string text(reason);
  lws_close_reason(connection_, LWS_CLOSE_STATUS_POLICY_VIOLATION,
                   reinterpret_cast<unsigned char*>(text.data()), text.size());
  lws_callback_on_writable(connection_);
}

// --- the server

struct Server::Library {
  std::vector<lws_protocols> protocols;
  std::string root = "/", pages, address, certificate, key, authority;
  std::vector<lws_http_mount> mounts;                     // the last one has the pages
  std::vector<lws_protocol_vhost_options> content_types;  // of folders
  std::array<lws_protocol_vhost_options, 5> headers{};
};

// The files of TLS, and what is made of them.
class Server::Credentials {
 public:
  explicit Credentials(const ServerOptions& options) : options_(options) {}

  // Reads the files and checks them together. If all are right, `tls` uses them, if there is one,
  // for the handshakes from then on.
  Result<void> load() {
    is_loaded_ = false;
    stamps_ = stamps();
    const std::unique_ptr<SSL_CTX, Free<SSL_CTX_free>> files(SSL_CTX_new(TLS_server_method()));
    if (SSL_CTX_use_certificate_chain_file(files.get(), options_.certificate.c_str()) != 1) {
      return failed(options_.certificate, "holds no certificate in PEM form");
    }
    if (SSL_CTX_use_PrivateKey_file(files.get(), options_.key.c_str(), SSL_FILETYPE_PEM) != 1 ||
        SSL_CTX_check_private_key(files.get()) != 1) {
      return failed(options_.key, "holds no private key in PEM form, or not that of --certificate");
    }
    std::unique_ptr<X509_STORE, Free<X509_STORE_free>> store(X509_STORE_new());
    if (!options_.authority.empty() &&
        X509_STORE_load_file(store.get(), options_.authority.c_str()) != 1) {
      return failed(options_.authority, "holds no certificate in PEM form");
    }
    if (!options_.revoked.empty()) DSSM_TRY(load_revoked(store.get()));
    if (tls) DSSM_TRY(use(files.get()));
    if (tls) SSL_CTX_set_cert_store(tls, store.release());
    is_loaded_ = true;
    ++generation_;
    return {};
  }
  // Also after a failure, whose reason may pass without a change of the files.
  bool is_to_load() const { return !is_loaded_ || stamps() != stamps_; }

  // A connection whose handshake was with earlier files may not go on.
  void begin(lws* connection) { connections_[connection] = generation_; }
  void end(lws* connection) { connections_.erase(connection); }
  bool is_outdated(lws* connection) const {
    const auto found = connections_.find(connection);
    return found != connections_.end() && found->second != generation_;
  }

  SSL_CTX* tls = nullptr;        // libwebsockets'
  std::string reported_failure;  // the last one, since files were loaded

 private:
  template <auto function>
  struct Free {
    template <class T>
    void operator()(T* object) const {
      function(object);
    }
  };
  using Stamp = std::tuple<ino_t, std::int64_t, std::int64_t>;

  std::vector<Stamp> stamps() const {
    const auto ns_of = [](const timespec& time) {
      return time.tv_sec * 1'000'000'000 + time.tv_nsec;
    };
    std::vector<Stamp> stamps;
    for (const std::filesystem::path& file :
         {options_.certificate, options_.key, options_.authority, options_.revoked}) {
      struct stat status {};
      ::stat(file.c_str(), &status);
      stamps.emplace_back(status.st_ino, ns_of(status.st_mtim), ns_of(status.st_ctim));
    }
    return stamps;
  }

  static Error failed(const std::filesystem::path& file, std::string_view what) {
    ERR_clear_error();
    if (::access(file.c_str(), R_OK) != 0) {
      return {Errc::system,
              fmt::format("read '{}': {}", file.string(), std::generic_category().message(errno))};
    }
    return {Errc::invalid_argument, fmt::format("'{}' {}", file.string(), what)};
  }

  // Of each CA in `store` a list is needed: without one OpenSSL refuses all its certificates.
  Result<void> load_revoked(X509_STORE* store) const {
    X509_LOOKUP* const lookup = X509_STORE_add_lookup(store, X509_LOOKUP_file());
    if (X509_load_crl_file(lookup, options_.revoked.c_str(), X509_FILETYPE_PEM) <= 0) {
      return failed(options_.revoked, "holds no revocation list in PEM form");
    }
    X509_STORE_set_flags(store, X509_V_FLAG_CRL_CHECK | X509_V_FLAG_CRL_CHECK_ALL);
    std::vector<const X509_NAME*> authorities, issuers;
    STACK_OF(X509_OBJECT)* const objects = X509_STORE_get0_objects(store);
    for (int i = 0; i < sk_X509_OBJECT_num(objects); ++i) {
      X509_OBJECT* const object = sk_X509_OBJECT_value(objects, i);
      if (const X509* const authority = X509_OBJECT_get0_X509(object)) {
        authorities.push_back(X509_get_subject_name(authority));
      } else if (X509_OBJECT_get_type(object) == X509_LU_CRL) {
        issuers.push_back(X509_CRL_get_issuer(X509_OBJECT_get0_X509_CRL(object)));
      }
    }
    const bool has_all = std::ranges::all_of(authorities, [&](const X509_NAME* authority) {
      return std::ranges::any_of(
          issuers, [&](const X509_NAME* issuer) { return X509_NAME_cmp(issuer, authority) == 0; });
    });
    if (has_all) return {};
    return failed(options_.revoked, "has no list of one of the CAs in --authority; each needs one");
  }

  // The certificate and key of `files`, in place of those of `tls`.
  Result<void> use(SSL_CTX* files) const {
    EVP_PKEY* const key = SSL_CTX_get0_privatekey(files);
    const EVP_PKEY* const used = SSL_CTX_get0_privatekey(tls);
    // OpenSSL would keep the one of another kind beside it.
    if (used && EVP_PKEY_get_base_id(key) != EVP_PKEY_get_base_id(used)) {
      return failed(options_.key, "is of another kind than before (RSA, EC): restart dssm-view");
    }
    STACK_OF(X509)* chain = nullptr;
    SSL_CTX_get0_chain_certs(files, &chain);
    if (SSL_CTX_use_cert_and_key(tls, SSL_CTX_get0_certificate(files), key, chain, 1) != 1) {
      return failed(options_.certificate, "cannot be used");
    }
    return {};
  }

  const ServerOptions& options_;
  std::vector<Stamp> stamps_;  // of the files when they were read
  bool is_loaded_ = false;
  std::uint64_t generation_ = 0;
  std::map<lws*, std::uint64_t> connections_;
};

struct Server::Timer {
  lws_sorted_usec_list_t entry{};  // the first: libwebsockets gives its address to run()
  Server* server = nullptr;
  Duration period{};
  std::function<void()> call;

  void schedule() {
    lws_sul_schedule(server->context_, 0, &entry, &Timer::run,
                     std::chrono::duration_cast<std::chrono::microseconds>(period).count());
  }
  static void run(lws_sorted_usec_list_t* entry) {
    auto& timer = *reinterpret_cast<Timer*>(entry);
    timer.call();
    timer.schedule();
  }
};

struct Server::WebSocket {
  Peer peer;
  std::unique_ptr<Connection> connection;
  std::string received;  // of a message that is not complete
};

Server::Server(ServerOptions options)
    : options_(std::move(options)), library_(std::make_unique<Library>()) {}

Server::~Server() {
  if (context_) end();
}

// Connections end here, while what they use is there still.
void Server::end() {
  {
    const std::lock_guard lock(mutex_);
    is_running_ = false;
  }
  for (const auto& timer : timers_) lws_sul_cancel(&timer->entry);
  lws_context_destroy(std::exchange(context_, nullptr));
}

Result<std::uint16_t> Server::listen() {
  if (!is_address(options_.address)) {
    return Error{Errc::invalid_argument,
                 fmt::format("listen on '{}': that is not an address, as 127.0.0.1 or [::1]",
                             options_.address)};
  }
  lws_set_log_level(LLL_ERR, [](int, const char* line) {
    std::fputs(fmt::format("dssm-view: {}", line).c_str(), stderr);
  });
  Library& library = *library_;
  library.pages = options_.pages.string();
  library.address = options_.address;
  const auto mount_at = [](const std::string& path, lws_mount_protocols origin) {
    lws_http_mount mount{};
    mount.mountpoint = path.c_str();
    mount.mountpoint_len = static_cast<unsigned char>(path.size());
    mount.origin_protocol = static_cast<unsigned char>(origin);
    return mount;
  };
  for (const auto& [path, text] : texts_) {
    library.mounts.push_back(mount_at(path, LWSMPRO_CALLBACK));
    library.mounts.back().protocol = "http";
  }
  library.content_types.reserve(folders_.size());
  for (const Folder& folder : folders_) {
    library.content_types.push_back(
        {nullptr, nullptr, folder.suffix.c_str(), folder.content_type.c_str()});
    library.mounts.push_back(mount_at(folder.path, LWSMPRO_FILE));
    library.mounts.back().origin = folder.folder.c_str();
    library.mounts.back().extra_mimetypes = &library.content_types.back();
  }
  library.mounts.push_back(mount_at(library.root, LWSMPRO_FILE));
  library.mounts.back().origin = library.pages.c_str();
  library.mounts.back().def = "index.html";
  for (std::size_t i = 1; i < library.mounts.size(); ++i) {
    library.mounts[i - 1].mount_next = &library.mounts[i];
  }

  // Also against what the page itself may be made to do by a name that it shows.
  auto add_header = [&, n = 0U](const char* name, const char* value) mutable {
    library.headers[n] = {n > 0 ? &library.headers[n - 1] : nullptr, nullptr, name, value};
    ++n;
  };
  add_header("content-security-policy:",
             "default-src 'none'; script-src 'self'; style-src 'self'; "
             "img-src 'self' blob: data:; connect-src 'self' ws: wss:; "
             "frame-ancestors 'none'; base-uri 'none'; form-action 'none'");
  add_header("x-content-type-options:", "nosniff");
  add_header("x-frame-options:", "deny");
  add_header("referrer-policy:", "no-referrer");
  add_header("cross-origin-resource-policy:", "same-origin");

  const auto callback = [](lws* connection, lws_callback_reasons reason, void* user, void* in,
                           std::size_t length) {
    return Server::on_event(connection, reason, user, in, length);
  };
  library.protocols.push_back({"http", callback, sizeof(std::uint64_t), 0, 0, nullptr, 0});
  for (const auto& [name, connect] : endpoints_) {
    constexpr std::size_t kPointerBytes = sizeof(void*);  // of a WebSocket
    library.protocols.push_back({name.c_str(), callback, kPointerBytes, 4096, 0, nullptr, 0});
  }
  library.protocols.push_back({});

  lws_context_creation_info info{};
  info.port = options_.port;
  const bool is_any = library.address == "0.0.0.0" || library.address == "::";
  info.iface = is_any ? nullptr : library.address.c_str();
  info.protocols = library.protocols.data();
  info.mounts = library.mounts.data();
  info.headers = &library.headers.back();
  info.user = this;
  info.options = LWS_SERVER_OPTION_FAIL_UPON_UNABLE_TO_BIND | LWS_SERVER_OPTION_VALIDATE_UTF8;
  // With IPv6 it does not find addresses of IPv4.
  if (library.address.find(':') == std::string::npos)
    info.options |= LWS_SERVER_OPTION_DISABLE_IPV6;
  info.keepalive_timeout = 60;
  info.fd_limit_per_thread = kMaxDescriptors;
  if (!options_.certificate.empty()) {
    credentials_ = std::make_unique<Credentials>(options_);
    DSSM_TRY(credentials_->load());
    repeat(kCredentialsPeriod, [this] { follow_credentials(); });
    library.certificate = options_.certificate.string();
    library.key = options_.key.string();
    info.options |= LWS_SERVER_OPTION_DO_SSL_GLOBAL_INIT;
    info.ssl_options_set = SSL_OP_NO_TLSv1 | SSL_OP_NO_TLSv1_1 | SSL_OP_NO_TLSv1_2;
    info.alpn = "http/1.1";  // HTTP/2 would bring nothing here
    info.ssl_cert_filepath = library.certificate.c_str();
    info.ssl_private_key_filepath = library.key.c_str();
    if (!options_.authority.empty()) {
      library.authority = options_.authority.string();
      info.ssl_ca_filepath = library.authority.c_str();
      info.options |= LWS_SERVER_OPTION_REQUIRE_VALID_OPENSSL_CLIENT_CERT;
    }
  }
  context_ = lws_create_context(&info);
  if (!context_) {
    return Error{
        Errc::system,
        fmt::format("listen on {}:{}: {}; is another dssm-view running, or is that not an "
                    "address of this PC?",
                    options_.address, options_.port, std::generic_category().message(errno))};
  }
  if (credentials_) DSSM_TRY(credentials_->load());
  const int port = lws_get_vhost_listen_port(lws_get_vhost_by_name(context_, "default"));
  if (!listens_only_at(options_.address, port)) {
    return Error{Errc::system,
                 fmt::format("listen on {} only: the addresses of this PC's interfaces are not "
                             "known; may this process use AF_NETLINK?",
                             options_.address)};
  }
  for (const auto& timer : timers_) timer->schedule();
  is_running_ = true;
  return static_cast<std::uint16_t>(port);
}

void Server::serve_text(const std::string& path, std::string content_type,
                        std::function<void(Answer)> make) {
  texts_[path] = {std::move(content_type), std::move(make)};
}

void Server::repeat(Duration period, std::function<void()> call) {
  timers_.push_back(std::make_unique<Timer>());
  Timer& timer = *timers_.back();
  timer.server = this;
  timer.period = period;
  timer.call = std::move(call);
}

void Server::post(std::function<void()> call) {
  const std::lock_guard lock(mutex_);
  posted_.push_back(std::move(call));
  if (is_running_) lws_cancel_service(context_);
}

void Server::call_posted() {
  std::vector<std::function<void()>> calls;
  {
    const std::lock_guard lock(mutex_);
    calls.swap(posted_);
  }
  for (const auto& call : calls) call();
}

void Server::run() {
  while (!is_stopped_ && lws_service(context_, 0) >= 0) {
  }
  end();
}

void Server::stop() noexcept {
  if (!is_stopped_.exchange(true)) lws_cancel_service(context_);  // a second time it may be gone
}

std::string Server::refusal(lws* connection) const {
  if (credentials_ && credentials_->is_outdated(connection)) {
    return "the certificates were read again; connect again";
  }
  const std::string host = header(connection, WSI_TOKEN_HOST);
  const std::string name = lower_case(std::string(without_port(host)));
  const std::string own = this_pc(), short_own = own.substr(0, own.find('.'));
  if (!is_address(name) && name != "localhost" && name != own && name != short_own &&
      name != short_own + ".local" &&
      std::ranges::none_of(options_.hosts,
                           [&](const std::string& other) { return lower_case(other) == name; })) {
    return fmt::format("this PC is not known as '{}'; --host allows the name", name);
  }
  const std::string origin = header(connection, WSI_TOKEN_ORIGIN);
  const std::string_view scheme = options_.certificate.empty() ? "http" : "https";
  if (!origin.empty() && origin != fmt::format("{}://{}", scheme, host) &&
      std::ranges::find(options_.origins, origin) == options_.origins.end()) {
    return fmt::format("pages of '{}' may not connect; --origin allows them", origin);
  }
  return {};
}

int Server::on_event(lws* connection, int reason, void* user, void* in, std::size_t length) {
  // `length`: whether OpenSSL accepts the certificate, which counts for nothing else.
  if (reason == LWS_CALLBACK_OPENSSL_PERFORM_CLIENT_CERT_VERIFICATION) return length != 0 ? 0 : 1;
  auto& server = *static_cast<Server*>(lws_context_user(lws_get_context(connection)));
  if (reason == LWS_CALLBACK_OPENSSL_LOAD_EXTRA_SERVER_VERIFY_CERTS) {
    SSL_CTX* const tls = server.credentials_->tls = static_cast<SSL_CTX*>(user);
    // A resumed session would not be compared with a new list of revoked certificates.
    SSL_CTX_set_num_tickets(tls, 0);
    SSL_CTX_set_session_cache_mode(tls, SSL_SESS_CACHE_OFF);
    return 0;
  }
  if (server.credentials_ && reason == LWS_CALLBACK_SERVER_NEW_CLIENT_INSTANTIATED) {
    server.credentials_->begin(connection);
  }
  if (server.credentials_ && reason == LWS_CALLBACK_WSI_DESTROY) {
    server.credentials_->end(connection);
  }
  const lws_protocols* protocol = lws_get_protocol(connection);
  if (reason == LWS_CALLBACK_EVENT_WAIT_CANCELLED) {  // comes once for each protocol
    if (protocol == lws_vhost_name_to_protocol(lws_get_vhost(connection), "http")) {
      server.call_posted();
    }
    return 0;
  }
  if (reason == LWS_CALLBACK_FILTER_HTTP_CONNECTION ||
      reason == LWS_CALLBACK_FILTER_PROTOCOL_CONNECTION) {
    const std::string text = server.refusal(connection);
    if (text.empty()) return 0;
    if (server.reported_.size() < kMaxReported && server.reported_.insert(text).second) {
      std::fputs(
          fmt::format("dssm-view: refused a request: {}\n", ctl::escaped_message(text)).c_str(),
          stderr);
    }
    lws_return_http_status(connection, HTTP_STATUS_FORBIDDEN, text.c_str());
    return -1;
  }
  if (!user || !protocol) return 0;
  const bool is_http = std::strcmp(protocol->name, "http") == 0;
  const bool goes_on =
      is_http
          ? server.on_http(connection, reason, *static_cast<std::uint64_t*>(user))
          : server.on_websocket(connection, reason, *static_cast<WebSocket**>(user), in, length);
  return goes_on ? 0 : -1;
}

void Server::follow_credentials() {
  if (!credentials_->is_to_load()) return;
  if (const Result<void> loaded = credentials_->load(); !loaded) {
    if (std::exchange(credentials_->reported_failure, loaded.error().message) ==
        loaded.error().message) {
      return;
    }
    std::fputs(fmt::format("dssm-view: the certificates are used as they were: {}\n",
                           ctl::escaped_message(loaded.error().message))
                   .c_str(),
               stderr);
    return;
  }
  credentials_->reported_failure.clear();
  std::fputs("dssm-view: the certificates were read again\n", stderr);
  // Who is there still may be revoked; the others connect again.
  for (WebSocket* socket : websockets_) socket->peer.close("the certificates were read again");
}

// --- texts

bool Server::on_http(lws* connection, int reason, std::uint64_t& request) {
  switch (reason) {
    case LWS_CALLBACK_HTTP:
      return begin_text(connection, request, header(connection, WSI_TOKEN_GET_URI));
    case LWS_CALLBACK_HTTP_WRITEABLE: {
      const auto found = requests_.find(request);
      if (found == requests_.end() || !found->second.is_made) return true;
      const bool goes_on = write_text(connection, found->second);
      requests_.erase(found);
      return goes_on;
    }
    case LWS_CALLBACK_HTTP_FILE_COMPLETION:  // the connection's next request may be read
      return lws_http_transaction_completed(connection) == 0;
    case LWS_CALLBACK_CLOSED_HTTP:
      requests_.erase(request);
      return true;
    default:
      return true;
  }
}

bool Server::begin_text(lws* connection, std::uint64_t& request, const std::string& path) {
  const auto text = texts_.find(path);
  if (text == texts_.end()) {
    request = ++last_request_;
    requests_.emplace(request, Request{connection, path, true, nothing_at(path)});
    lws_callback_on_writable(connection);
    return true;
  }
  lws_set_timeout(connection, NO_PENDING_TIMEOUT, 0);  // dssmd may need longer than lws waits
  // One that is being made is for all who wait.
  const bool is_begun = std::ranges::any_of(requests_, [&](const auto& numbered) {
    return numbered.second.path == path && !numbered.second.is_made;
  });
  request = ++last_request_;
  requests_.emplace(request, Request{connection, path});
  if (is_begun) return true;
  text->second.make([this, path](const Result<std::string>& made) {
    post([this, path, made] {
      for (auto& [number, waiting] : requests_) {
        if (waiting.path != path || std::exchange(waiting.is_made, true)) continue;
        waiting.text = made;
        lws_callback_on_writable(waiting.connection);
      }
    });
  });
  return true;
}

Error Server::nothing_at(const std::string& path) const {
  std::string others;
  for (const auto& [other, text] : texts_) others += fmt::format(", and {}", other);
  return {Errc::not_found,
          fmt::format("there is nothing at {}; the page is at /{}\n", ctl::escaped(path), others)};
}

bool Server::write_text(lws* connection, Request& request) {
  const bool is_made = request.text.has_value();
  const std::string& text = is_made ? *request.text : request.text.error().message;
  const unsigned status = is_made                         ? HTTP_STATUS_OK
                          : texts_.contains(request.path) ? HTTP_STATUS_SERVICE_UNAVAILABLE
                                                          : HTTP_STATUS_NOT_FOUND;
  std::array<unsigned char, LWS_PRE + 2048> head{};
  unsigned char* at = head.data() + LWS_PRE;
  unsigned char* const end = head.data() + head.size() - 1;
  if (lws_add_http_common_headers(
          connection, status,
          is_made ? texts_.at(request.path).content_type.c_str() : "text/plain; charset=utf-8",
          text.size(), &at, end) != 0 ||
      lws_finalize_write_http_header(connection, head.data() + LWS_PRE, &at, end) != 0) {
    return false;
  }
  Message body = Message::text(text);
  const int written =
      lws_write(connection, body.buffer_->data() + LWS_PRE, body.bytes(), LWS_WRITE_HTTP_FINAL);
  if (written < static_cast<int>(body.bytes())) return false;
  return lws_http_transaction_completed(connection) == 0;
}

// --- WebSockets

bool Server::on_websocket(lws* connection, int reason, WebSocket*& socket, void* in,
                          std::size_t length) {
  if (reason == LWS_CALLBACK_ESTABLISHED) {
    socket = new WebSocket{Peer(connection, header(connection, WSI_TOKEN_GET_URI)), nullptr, {}};
    websockets_.insert(socket);
    socket->connection = endpoints_.at(lws_get_protocol(connection)->name)(socket->peer);
    return true;
  }
  if (!socket) return true;
  switch (reason) {
    case LWS_CALLBACK_CLOSED:
      websockets_.erase(socket);
      delete std::exchange(socket, nullptr);
      return true;
    case LWS_CALLBACK_RECEIVE:
      if (socket->peer.is_closing_) return true;
      socket->received.append(static_cast<const char*>(in), length);
      if (socket->received.size() > kMaxRequestBytes) {
        socket->peer.close("a message is larger than 64 KiB");
      } else if (lws_is_final_fragment(connection) &&
                 lws_remaining_packet_payload(connection) == 0) {
        const std::string message = std::exchange(socket->received, {});
        if (lws_frame_is_binary(connection)) {
          socket->connection->on_binary(message);
        } else {
          socket->connection->on_text(message);
        }
      }
      return true;
    case LWS_CALLBACK_SERVER_WRITEABLE:
      return write_message(*socket);
    default:
      return true;
  }
}

bool Server::write_message(WebSocket& socket) {
  Peer& peer = socket.peer;
  if (peer.is_closing_) return false;
  // Small messages together: a packet for each would take most of this process's time.
  const int is_corked = 1, is_sent = 0, fd = lws_get_socket_fd(peer.connection_);
  ::setsockopt(fd, IPPROTO_TCP, TCP_CORK, &is_corked, sizeof is_corked);
  // Until the network takes no more, or the others have waited long enough.
  for (std::size_t bytes = 0; !peer.waiting_.empty() && bytes < kTurnBytes &&
                              lws_partial_buffered(peer.connection_) == 0;) {
    const Message message = std::move(peer.waiting_.front());
    peer.waiting_.pop_front();
    peer.waiting_bytes_ -= message.bytes();
    bytes += message.bytes();
    const int written =
        lws_write(peer.connection_, message.buffer_->data() + LWS_PRE, message.bytes(),
                  message.is_text_ ? LWS_WRITE_TEXT : LWS_WRITE_BINARY);
    if (written < static_cast<int>(message.bytes())) return false;
  }
  ::setsockopt(fd, IPPROTO_TCP, TCP_CORK, &is_sent, sizeof is_sent);
  if (!peer.waiting_.empty()) lws_callback_on_writable(peer.connection_);
  return true;
}

}  // namespace dssm::view
