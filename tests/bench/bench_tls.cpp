// SPDX-License-Identifier: Apache-2.0
//
// Encrypted connections over loopback: images and small messages one way, and a message there and
// back, each beside bare OpenSSL with the same cipher on blocking sockets, and beside plain TCP.
// The three alternate, so that other load affects all of them.
#include <fcntl.h>
#include <openssl/ssl.h>
#include <poll.h>

#include <filesystem>
#include <memory>
#include <string>
#include <thread>

#include "core/wire/tcp.hpp"
#include "core/wire/tls.hpp"
#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/authority.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;

namespace {

constexpr std::size_t kImageBytes = 640 * 480 * 3;
constexpr std::size_t kHeadBytes = 30;  // of a sample's frame
constexpr int kImages = 100;            // of one round
constexpr int kTrips = 2000;
constexpr int kRounds = 15;

// One end of a connection, blocking.
class End {
 public:
  virtual ~End() = default;
  virtual void send(std::span<const iovec> parts) = 0;
  virtual void receive(std::byte* to, std::size_t bytes) = 0;
};

class BareEnd final : public End {
 public:
  BareEnd(SSL_CTX* context, int socket, bool accepts) : session_(SSL_new(context)) {
    SSL_set_fd(session_, socket);
    if ((accepts ? SSL_accept(session_) : SSL_connect(session_)) != 1) fail("handshake");
  }
  void send(std::span<const iovec> parts) override {
    for (const iovec& part : parts) {
      if (SSL_write(session_, part.iov_base, static_cast<int>(part.iov_len)) <= 0) fail("write");
    }
  }
  void receive(std::byte* to, std::size_t bytes) override {
    while (bytes > 0) {
      const int count = SSL_read(session_, to, static_cast<int>(bytes));
      if (count <= 0) fail("read");
      to += count;
      bytes -= static_cast<std::size_t>(count);
    }
  }

 private:
  SSL* session_;
};

class OurEnd final : public End {
 public:
  explicit OurEnd(std::unique_ptr<wire::Transport> transport) : transport_(std::move(transport)) {}
  void send(std::span<const iovec> parts) override {
    std::vector<iovec> left(parts.begin(), parts.end());
    for (auto next = left.begin(); next != left.end();) {
      const wire::IoResult sent = transport_->send(std::span(next, left.end())).value();
      if (sent.status == wire::IoStatus::would_block) wait(POLLOUT);
      for (std::size_t rest = sent.bytes; rest > 0;) {
        const std::size_t step = std::min(rest, next->iov_len);
        next->iov_base = static_cast<std::byte*>(next->iov_base) + step;
        next->iov_len -= step;
        rest -= step;
        if (next->iov_len == 0) ++next;
      }
    }
    while (transport_->has_unsent_output()) {
      if (transport_->flush().value() == wire::IoStatus::would_block) wait(POLLOUT);
    }
  }
  void receive(std::byte* to, std::size_t bytes) override {
    while (bytes > 0) {
      const iovec space{to, bytes};
      const wire::IoResult got = transport_->receive({&space, 1}).value();
      if (got.status == wire::IoStatus::would_block) wait(POLLIN);
      to += got.bytes;
      bytes -= got.bytes;
    }
  }

 private:
  void wait(short events) const {
    pollfd ready{transport_->fd(), events, 0};
    ::poll(&ready, 1, -1);
  }
  std::unique_ptr<wire::Transport> transport_;
};

struct Connection {
  std::unique_ptr<End> client, server;
};

std::pair<UniqueFd, UniqueFd> tcp_pair() {
  const UniqueFd listener =
      wire::listen_tcp(
          wire::resolve_number(wire::Address::parse("127.0.0.1:0", 0, true).value()).at(0))
          .value();
  const wire::SocketAddress address = wire::local_address(listener.get()).value();
  UniqueFd client = wire::start_connect(address).value();
  pollfd ready{listener.get(), POLLIN, 0};
  ::poll(&ready, 1, -1);
  UniqueFd server(::accept4(listener.get(), nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
  wire::set_channel_options(server.get());
  return {std::move(client), std::move(server)};
}

Connection plain() {
  auto [client, server] = tcp_pair();
  return {std::make_unique<OurEnd>(
              wire::make_transport(std::move(client), wire::TransportEnd::connected)),
          std::make_unique<OurEnd>(
              wire::make_transport(std::move(server), wire::TransportEnd::accepted))};
}

Connection ours(const std::shared_ptr<const wire::TlsCredentials>& credentials) {
  auto [client, server] = tcp_pair();
  const auto shake = [&](UniqueFd socket, wire::TransportEnd end) {
    wire::TlsHandshake handshake(credentials, wire::make_transport(std::move(socket), end), end);
    while (!handshake.go_on().value()) {
      pollfd ready{handshake.fd(), handshake.events(), 0};
      ::poll(&ready, 1, -1);
    }
    return std::make_unique<OurEnd>(handshake.take_transport());
  };
  Connection made;
  std::thread other([&, socket = &client] {
    made.client = shake(std::move(*socket), wire::TransportEnd::connected);
  });
  made.server = shake(std::move(server), wire::TransportEnd::accepted);
  other.join();
  return made;
}

// The descriptors stay open until the program ends.
Connection bare(SSL_CTX* context) {
  auto [client, server] = tcp_pair();
  for (const int socket : {client.get(), server.get()}) {
    if (::fcntl(socket, F_SETFL, 0)) fail("fcntl");
  }
  Connection made;
  std::thread other([&, socket = client.release()] {
    made.client = std::make_unique<BareEnd>(context, socket, false);
  });
  made.server = std::make_unique<BareEnd>(context, server.release(), true);
  other.join();
  return made;
}

SSL_CTX* bare_context(const std::string& folder) {
  SSL_CTX* context = SSL_CTX_new(TLS_method());
  SSL_CTX_set_min_proto_version(context, TLS1_3_VERSION);
  SSL_CTX_set_ciphersuites(context, "TLS_AES_128_GCM_SHA256");
  SSL_CTX_set_num_tickets(context, 0);
  SSL_CTX_set_read_ahead(context, 1);
  SSL_CTX_use_certificate_file(context, (folder + "/own.crt").c_str(), SSL_FILETYPE_PEM);
  SSL_CTX_use_PrivateKey_file(context, (folder + "/own.key").c_str(), SSL_FILETYPE_PEM);
  return context;
}

// The time of one image, from the first byte sent to the last received, over kImages.
double send_images(Connection& connection, std::size_t bytes, int count) {
  std::vector<std::byte> head(kHeadBytes), image(bytes), to(bytes + kHeadBytes);
  const std::int64_t start = now_ns();
  std::thread sender([&] {
    const iovec parts[] = {{head.data(), head.size()}, {image.data(), image.size()}};
    for (int i = 0; i < count; ++i) connection.client->send(parts);
  });
  for (int i = 0; i < count; ++i) connection.server->receive(to.data(), to.size());
  sender.join();
  return static_cast<double>(now_ns() - start) / count;
}

void there_and_back(Connection& connection, std::vector<double>& ns) {
  std::byte message[64] = {}, back[64];
  std::thread echo([&] {
    std::byte memory[64];
    for (int i = 0; i < kTrips; ++i) {
      connection.server->receive(memory, sizeof memory);
      const iovec part{memory, sizeof memory};
      connection.server->send({&part, 1});
    }
  });
  const iovec part{message, sizeof message};
  for (int i = 0; i < kTrips; ++i) {
    const std::int64_t start = now_ns();
    connection.client->send({&part, 1});
    connection.client->receive(back, sizeof back);
    ns.push_back(static_cast<double>(now_ns() - start));
  }
  echo.join();
}

template <class Measure>
void compare(const std::string& what, const std::string& target, Connection& tcp,
             Connection& openssl, Connection& tls, const Measure& measure) {
  std::vector<double> of_tcp, of_openssl, of_tls;
  for (int i = 0; i < kRounds; ++i) {
    measure(tcp, of_tcp);
    measure(openssl, of_openssl);
    measure(tls, of_tls);
  }
  const Figures ours = figures_of(of_tls);
  print_pair("plain TCP", what, {figures_of(of_tcp), ours}, "");
  print_pair("bare OpenSSL", what, {figures_of(of_openssl), ours}, target);
}

}  // namespace

int main() {
  const std::string dir = test::make_temp_dir();
  test::Authority authority;
  authority.issue(test::Authority::host("pc1"), dir);
  const auto credentials = wire::TlsCredentials::load(dir).value();
  SSL_CTX* context = bare_context(dir);
  test::remove_tree(dir);
  Connection tcp = plain(), openssl = bare(context), tls = ours(credentials);
  print_head();
  compare("images of 900 KiB", "<= 1.18", tcp, openssl, tls,
          [](Connection& connection, std::vector<double>& ns) {
            ns.push_back(send_images(connection, kImageBytes, kImages));
          });
  compare("messages of 16 KiB", "<= 1.18", tcp, openssl, tls,
          [](Connection& connection, std::vector<double>& ns) {
            ns.push_back(send_images(connection, 16 << 10, 20 * kImages));
          });
  compare("64 B there and back", "", tcp, openssl, tls, there_and_back);
}
