// SPDX-License-Identifier: Apache-2.0
//
// TLS between two ends of a socket pair, with authorities of its own. The other implementation of
// TLS that it could be compared with is OpenSSL as well: what is tested here is what this project
// adds, and that OpenSSL is asked to check what has to be checked.
#include "core/wire/tls.hpp"

#include <gtest/gtest.h>
#include <openssl/err.h>
#include <openssl/ssl.h>
#include <poll.h>
#include <sys/socket.h>

#include <array>
#include <cstring>
#include <fstream>
#include <numeric>
#include <random>
#include <sstream>
#include <vector>

#include "core/wire/tcp.hpp"
#include "tests/support/authority.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::wire {
namespace {

using test::Authority;
using Credentials = std::shared_ptr<const TlsCredentials>;
using Hours = std::chrono::hours;

iovec part_of(std::vector<std::byte>& bytes, std::size_t from, std::size_t count) {
  return {bytes.data() + from, count};
}

std::vector<std::byte> random_bytes(std::size_t count) {
  std::mt19937 random(7);
  std::vector<std::byte> bytes(count);
  for (std::byte& byte : bytes) byte = static_cast<std::byte>(random());
  return bytes;
}

class Tls : public testing::Test {
 protected:
  const std::filesystem::path dir = test::make_temp_dir();
  Authority authority;
  TlsTicket ticket;
  std::unique_ptr<Transport> client, server;
  std::optional<Error> client_error, server_error;

  ~Tls() override { std::filesystem::remove_all(dir); }

  std::string folder(const std::string& name) const { return dir / name; }
  Credentials make(const Authority::Subject& subject) { return make(subject, authority); }
  Credentials make(const Authority::Subject& subject, Authority& by) {
    by.issue(subject, folder(subject.name));
    Result<Credentials> loaded = TlsCredentials::load(folder(subject.name));
    EXPECT_TRUE(loaded) << loaded.error().message;
    return *loaded;
  }

  // One end of the handshake, and what became of it.
  static bool step(TlsHandshake& end, std::unique_ptr<Transport>& made,
                   std::optional<Error>& error) {
    if (made || error) return true;
    const Result<bool> done = end.go_on();
    if (!done) {
      error = done.error();
    } else if (*done) {
      made = end.take_transport();
    }
    return made || error;
  }

  // As far as the two ends get. In TLS 1.3 the client is done before the server has looked at its
  // certificate.
  void connect(const Credentials& of_client, const Credentials& of_server, int buffer = 0) {
    int ends[2];
    ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    if (buffer > 0) {
      for (const int end : ends) ::setsockopt(end, SOL_SOCKET, SO_SNDBUF, &buffer, sizeof buffer);
    }
    auto over = [](int fd, TransportEnd end) { return make_transport(UniqueFd(fd), end); };
    TlsHandshake from(of_client, over(ends[0], TransportEnd::connected), TransportEnd::connected,
                      &ticket);
    TlsHandshake to(of_server, over(ends[1], TransportEnd::accepted), TransportEnd::accepted);
    for (bool both = false; !both;) {
      const bool one = step(from, client, client_error);
      both = step(to, server, server_error) && one;
    }
    // What refuses a client reaches it with its first receive.
    if (client && server_error) client_error = receive_error(*client);
  }

  // A new connection after a cut. Whether it resumed the session: then the client knows the very
  // certificate that the server showed before.
  bool resumes(const Credentials& of_client, const Credentials& of_server) {
    EXPECT_FALSE(receive_error(*client)) << "receives the ticket";
    const auto before = client->peer()->certificates;
    client.reset();
    server.reset();
    connect(of_client, of_server);
    return client && client->peer()->certificates == before;
  }

  static std::optional<Error> receive_error(Transport& end) {
    std::byte byte{};
    const iovec space{&byte, 1};
    const Result<IoResult> received = end.receive({&space, 1});
    if (received) return std::nullopt;
    return received.error();
  }

  // The connecting end by OpenSSL itself, with the certificate in that folder.
  using BareSession = std::unique_ptr<SSL, decltype(&SSL_free)>;
  BareSession bare_client(const std::string& name, int socket) const {
    SSL_CTX* const context = SSL_CTX_new(TLS_method());
    SSL_CTX_use_certificate_file(context, (folder(name) + "/own.crt").c_str(), SSL_FILETYPE_PEM);
    SSL_CTX_use_PrivateKey_file(context, (folder(name) + "/own.key").c_str(), SSL_FILETYPE_PEM);
    BareSession session(SSL_new(context), SSL_free);
    SSL_CTX_free(context);  // the session has it
    SSL_set_fd(session.get(), socket);
    SSL_set_connect_state(session.get());
    return session;
  }

  // A certificate that names neither a host nor a program, in the folder of that name.
  void issue_nameless(const std::string& name) {
    Authority::Subject nameless = Authority::host(name);
    nameless.alternative_names = "DNS:" + name;
    authority.issue(nameless, folder(name));
  }

  void expect_refused(const std::string& by_server, const std::string& to_client) {
    ASSERT_TRUE(server_error);
    EXPECT_EQ(server_error->code, Errc::no_permission);
    EXPECT_NE(server_error->message.find(by_server), std::string::npos) << server_error->message;
    ASSERT_TRUE(client_error);
    EXPECT_EQ(client_error->code, Errc::no_permission);
    EXPECT_NE(client_error->message.find(to_client), std::string::npos) << client_error->message;
  }
};

TEST_F(Tls, KnowsBothSides) {
  connect(make(Authority::program("viewer")), make(Authority::host("pc2")));
  ASSERT_TRUE(client && server);
  EXPECT_EQ(server->peer()->str(), "program 'viewer'");
  EXPECT_EQ(client->peer()->str(), "host 'pc2'");
  EXPECT_EQ(client->peer()->host_id, host_id_for("pc2"));
}

// Any sizes of parts, spaces and socket buffers; the sender overwrites what it has sent at once.
TEST_F(Tls, CarriesBytesAndNeedsTheirMemoryNoMore) {
  connect(make(Authority::host("pc1")), make(Authority::host("pc2")), 20'000);
  ASSERT_TRUE(client && server);
  const std::vector<std::byte> all = random_bytes(3'000'000);
  std::vector<std::byte> memory = all, received(all.size());
  std::mt19937 random(1);
  std::size_t sent = 0, got = 0;
  bool was_held_back = false;
  while (got < all.size()) {
    if (sent < all.size()) {
      const std::size_t lengths[] = {random() % 100, random() % 70'000, 0, random() % 20'000};
      std::vector<iovec> parts;
      for (std::size_t at = sent; const std::size_t length : lengths) {
        const std::size_t count = std::min(length, all.size() - at);
        parts.push_back(part_of(memory, at, count));
        at += count;
      }
      const Result<IoResult> result = client->send(parts);
      ASSERT_TRUE(result);
      std::fill_n(memory.begin() + static_cast<std::ptrdiff_t>(sent), result->bytes, std::byte{});
      sent += result->bytes;
    } else {
      ASSERT_TRUE(client->flush());
    }
    was_held_back = was_held_back || client->has_unsent_output();
    do {
      const std::size_t first = std::min<std::size_t>(1 + random() % 5'000, all.size() - got),
                        second = std::min<std::size_t>(random() % 40'000, all.size() - got - first);
      const iovec spaces[] = {part_of(received, got, first),
                              part_of(received, got + first, second)};
      const Result<IoResult> result = server->receive(spaces);
      ASSERT_TRUE(result);
      if (result->status == IoStatus::would_block) break;
      ASSERT_EQ(result->status, IoStatus::ok);
      got += result->bytes;
    } while (got < all.size() && (random() % 2 == 0 || server->has_buffered_input()));
  }
  EXPECT_TRUE(received == all);
  EXPECT_TRUE(was_held_back) << "the socket took everything: nothing was tested";
  EXPECT_FALSE(client->has_unsent_output());
}

// What the kernel does not show any more.
TEST_F(Tls, SaysThatItHoldsInput) {
  connect(make(Authority::host("pc1")), make(Authority::host("pc2")));
  std::string text = "0123456789", got;
  const iovec part{text.data(), text.size()};
  ASSERT_TRUE(client->send({&part, 1}));
  for (bool first = true; first || server->has_buffered_input(); first = false) {
    char byte = 0;
    const iovec space{&byte, 1};
    const Result<IoResult> received = server->receive({&space, 1});
    ASSERT_TRUE(received);
    got.append(&byte, received->bytes);
  }
  EXPECT_EQ(got, text);
}

// Each costs as much as one with 16 KiB, and others wait for their turn.
TEST_F(Tls, TakesABreakWithinManyShortRecords) {
  connect(make(Authority::host("pc1")), make(Authority::host("pc2")));
  constexpr std::size_t kCount = 200;
  char byte = 'x';
  const iovec part{&byte, 1};
  for (std::size_t i = 0; i < kCount; ++i) ASSERT_EQ(client->send({&part, 1})->bytes, 1u);
  std::array<char, 1000> memory{};
  const iovec space{memory.data(), memory.size()};
  std::size_t got = 0;
  int calls = 0;
  for (bool first = true; first || server->has_buffered_input(); first = false) {
    got += server->receive({&space, 1})->bytes;
    ++calls;
  }
  EXPECT_EQ(got, kCount);
  EXPECT_GE(calls, 4);
}

// By OpenSSL itself, which sends what our transport does not.
class TlsOfBareClient : public Tls {
 protected:
  // Connected, with `groups` for the key exchange, as OpenSSL names them; nullptr: all it has.
  void connect_bare(const char* groups = nullptr) {
    make(Authority::host("pc1"));
    int ends[2];
    ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    socket = UniqueFd(ends[0]);
    session = bare_client("pc1", socket.get());
    if (groups) SSL_set1_groups_list(session.get(), groups);
    TlsHandshake to(make(Authority::host("pc2")),
                    make_transport(UniqueFd(ends[1]), TransportEnd::accepted),
                    TransportEnd::accepted);
    for (bool both = false; !both && !server_error;) {
      const bool one = SSL_do_handshake(session.get()) == 1;
      both = step(to, server, server_error) && one;
    }
  }
  void change_keys(int times, int and_ask) const {
    for (int i = 0; i < times; ++i) {
      ASSERT_EQ(SSL_key_update(session.get(), and_ask), 1);
      ASSERT_EQ(SSL_do_handshake(session.get()), 1);
    }
  }
  std::optional<Error> next_error() {
    std::optional<Error> error;
    for (int i = 0; i < 100 && !error; ++i) error = receive_error(*server);
    return error;
  }

  UniqueFd socket;
  BareSession session{nullptr, SSL_free};
};

TEST_F(TlsOfBareClient, EndsAConnectionThatChangesItsKeysAllTheTime) {
  connect_bare();
  ASSERT_TRUE(server);
  change_keys(20, SSL_KEY_UPDATE_NOT_REQUESTED);
  EXPECT_FALSE(receive_error(*server)) << "some are allowed";
  for (int i = 0; i < 20; ++i) {
    ASSERT_EQ(SSL_write(session.get(), "data", 4), 4);
    change_keys(1, SSL_KEY_UPDATE_NOT_REQUESTED);
  }
  const std::optional<Error> error = next_error();
  ASSERT_TRUE(error);
  EXPECT_EQ(error->message, "the other side changes its keys all the time");
}

TEST_F(TlsOfBareClient, AnswersOnlySomeOfManyChangesOfKeysThatComeAtOnce) {
  connect_bare();
  ASSERT_TRUE(server);
  change_keys(200, SSL_KEY_UPDATE_REQUESTED);
  const std::optional<Error> error = next_error();
  ASSERT_TRUE(error);
  EXPECT_EQ(error->message, "the other side changes its keys all the time");
  std::array<char, 100'000> answers{};
  const ssize_t got = ::recv(socket.get(), answers.data(), answers.size(), MSG_DONTWAIT);
  constexpr ssize_t kAnswerBytes = 27, kTicketBytes = 4000;
  EXPECT_LT(got, 40 * kAnswerBytes + kTicketBytes);
}

TEST_F(TlsOfBareClient, RefusesKeyExchangesThatTakeLong) {
  connect_bare("ffdhe8192");
  ASSERT_TRUE(server_error);
  EXPECT_EQ(server_error->code, Errc::protocol) << server_error->message;
  server_error.reset();
  connect_bare("P-256");
  EXPECT_TRUE(server);
}

TEST_F(Tls, NoticesTheEnd) {
  connect(make(Authority::host("pc1")), make(Authority::host("pc2")));
  client.reset();
  std::byte byte{};
  const iovec space{&byte, 1};
  EXPECT_EQ(server->receive({&space, 1})->status, IoStatus::end);
}

TEST_F(Tls, RefusesAnExpiredCertificateOnBothSides) {
  Authority::Subject old = Authority::host("pc1");
  old.valid_from = Hours(-48), old.valid_until = Hours(-24);
  connect(make(old), make(Authority::host("pc2")));
  expect_refused("'pc1' is not accepted: certificate has expired", "certificate expired");
  EXPECT_NE(server_error->message.find("this PC's clock says"), std::string::npos);
}

TEST_F(Tls, RefusesACertificateOfTheFuture) {
  Authority::Subject coming = Authority::host("pc1");
  coming.valid_from = Hours(24), coming.valid_until = Hours(48);
  connect(make(coming), make(Authority::host("pc2")));
  expect_refused("'pc1' is not accepted: certificate is not yet valid", "compare the clocks");
}

TEST_F(Tls, RefusesAnotherAuthority) {
  Authority other;
  connect(make(Authority::host("pc1"), other), make(Authority::host("pc2")));
  // Here the client is the first to look.
  ASSERT_TRUE(client_error && server_error);
  EXPECT_NE(client_error->message.find("'pc2' is not accepted"), std::string::npos)
      << client_error->message;
  EXPECT_NE(client_error->message.find("another vehicle"), std::string::npos);
  EXPECT_NE(server_error->message.find("one authority"), std::string::npos)
      << server_error->message;
}

TEST_F(Tls, RefusesARevokedCertificate) {
  const long serial = authority.issue(Authority::host("pc1"), folder("pc1"));
  authority.issue(Authority::host("pc2"), folder("pc2"));
  authority.write_revoked(serial, folder("pc2"));
  connect(TlsCredentials::load(folder("pc1")).value(), TlsCredentials::load(folder("pc2")).value());
  expect_refused("'pc1' is not accepted: certificate revoked", "certificate revoked");
}

// While one replaces the other.
TEST_F(Tls, TakesTwoAuthoritiesOfOneNameAndTheListsOfBoth) {
  Authority other;
  const long serial = authority.issue(Authority::host("pc1"), folder("pc1"));
  ASSERT_EQ(other.issue(Authority::host("pc2"), folder("pc2")), serial);
  const auto of_both = [this](const char* file) {
    std::stringstream text;
    for (const char* name : {"pc1", "pc2"}) text << std::ifstream(folder(name) + file).rdbuf();
    return text.str();
  };
  const auto write = [this](const char* file, const std::string& text) {
    for (const char* name : {"pc1", "pc2"}) std::ofstream(folder(name) + file) << text;
  };
  write("/ca.crt", of_both("/ca.crt"));
  for (const bool is_revoked : {false, true}) {
    authority.write_revoked(99, folder("pc1"));
    other.write_revoked(is_revoked ? serial : 99, folder("pc2"));
    write("/revoked.crl", of_both("/revoked.crl"));
    for (const std::string name : {"pc1", "pc2"}) {
      const Result<Credentials> loaded = TlsCredentials::load(folder(name));
      ASSERT_TRUE(loaded) << loaded.error().message;
      const std::string problem = (*loaded)->own_problem();
      const bool is_refused = problem.find("certificate revoked") != std::string::npos;
      EXPECT_EQ(is_refused, is_revoked && name == "pc2") << problem;
      EXPECT_EQ(is_refused, !problem.empty()) << problem;
    }
  }
  authority.write_revoked(99, folder("pc1"));
  const Result<Credentials> incomplete = TlsCredentials::load(folder("pc1"));
  ASSERT_FALSE(incomplete);
  EXPECT_NE(incomplete.error().message.find("holds 0 revocation lists of 'vehicle'"),
            std::string::npos)
      << incomplete.error().message;
}

TEST_F(Tls, RefusesAProgramThatPlaysAHost) {
  connect(make(Authority::host("pc1")), make(Authority::program("viewer")));
  ASSERT_TRUE(client_error);
  EXPECT_NE(client_error->message.find("'viewer' is not accepted: unsuitable certificate purpose"),
            std::string::npos)
      << client_error->message;
}

TEST_F(Tls, RefusesANamelessCertificate) {
  issue_nameless("pc1");
  const Result<Credentials> loaded = TlsCredentials::load(folder("pc1"));
  ASSERT_FALSE(loaded);
  EXPECT_NE(loaded.error().message.find("names neither a host"), std::string::npos)
      << loaded.error().message;
}

// As the certificate of another vehicle's software, by the same authority.
TEST_F(Tls, NotifiesTheOtherSideThatItsCertificateIsNameless) {
  issue_nameless("pc1");
  int ends[2];
  ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
  const UniqueFd socket(ends[0]);
  const BareSession session = bare_client("pc1", socket.get());
  TlsHandshake to(make(Authority::host("pc2")),
                  make_transport(UniqueFd(ends[1]), TransportEnd::accepted),
                  TransportEnd::accepted);
  while (!step(to, server, server_error)) SSL_do_handshake(session.get());
  ASSERT_TRUE(server_error);
  EXPECT_EQ(server_error->code, Errc::no_permission);
  EXPECT_NE(server_error->message.find("'pc1' names neither a host"), std::string::npos)
      << server_error->message;
  ERR_clear_error();  // of the other side
  char byte = 0;
  EXPECT_LE(SSL_read(session.get(), &byte, 1), 0);
  EXPECT_EQ(ERR_GET_REASON(ERR_get_error()), SSL_R_SSLV3_ALERT_UNSUPPORTED_CERTIFICATE);
}

// A host that cannot be connected to would not notice it.
TEST_F(Tls, RefusesAnOwnCertificateThatIsGoodForOneDirectionOnly) {
  Authority::Subject half = Authority::host("pc1");
  half.extended_usage = "clientAuth";
  authority.issue(half, folder("pc1"));
  const Result<Credentials> loaded = TlsCredentials::load(folder("pc1"));
  ASSERT_FALSE(loaded);
  EXPECT_NE(loaded.error().message.find("unsuitable certificate purpose"), std::string::npos)
      << loaded.error().message;
}

TEST_F(Tls, SaysThatTheOtherSideSpeaksNoTls) {
  int ends[2];
  ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
  TlsHandshake from(make(Authority::host("pc1")),
                    make_transport(UniqueFd(ends[0]), TransportEnd::connected),
                    TransportEnd::connected);
  const UniqueFd other(ends[1]);
  ASSERT_FALSE(from.go_on().value());
  ASSERT_EQ(::send(other.get(), "what is this?", 13, 0), 13);
  const Result<bool> done = from.go_on();
  ASSERT_FALSE(done);
  EXPECT_EQ(done.error().code, Errc::protocol);
  EXPECT_NE(done.error().message.find("does not speak TLS"), std::string::npos)
      << done.error().message;
}

// A reload, with connections that go on.
TEST_F(Tls, ChecksAKnownPeerAgain) {
  const long serial = authority.issue(Authority::host("pc1"), folder("pc1"));
  connect(TlsCredentials::load(folder("pc1")).value(), make(Authority::host("pc2")));
  ASSERT_TRUE(server);
  EXPECT_TRUE(TlsCredentials::load(folder("pc2")).value()->check(*server->peer()));
  authority.write_revoked(serial, folder("pc2"));
  const Result<void> checked = TlsCredentials::load(folder("pc2")).value()->check(*server->peer());
  ASSERT_FALSE(checked);
  EXPECT_NE(checked.error().message.find("revoked"), std::string::npos) << checked.error().message;
}

TEST_F(Tls, ResumesTheSessionAfterACutAndKnowsBothSides) {
  const Credentials viewer = make(Authority::program("viewer")), pc2 = make(Authority::host("pc2"));
  connect(viewer, pc2);
  for (int cut = 0; cut < 5; ++cut) {
    ASSERT_TRUE(resumes(viewer, pc2)) << cut;
    ASSERT_TRUE(server);
    EXPECT_EQ(server->peer()->str(), "program 'viewer'");
    EXPECT_EQ(client->peer()->str(), "host 'pc2'");
    EXPECT_EQ(client->peer()->host_id, host_id_for("pc2"));
    EXPECT_TRUE(pc2->check(*server->peer()));
  }
}

TEST_F(Tls, ResumesASessionWithIntermediateAuthorities) {
  Authority robots("robots", &authority);
  const Credentials pc1 = make(Authority::host("pc1"), robots),
                    pc2 = make(Authority::host("pc2"), robots);
  connect(pc1, pc2);
  ASSERT_TRUE(resumes(pc1, pc2));
  EXPECT_EQ(server->peer()->str(), "host 'pc1'");
  EXPECT_TRUE(pc2->check(*server->peer())) << "with all certificates that it needs";
}

TEST_F(Tls, ResumesNoSessionAfterAReload) {
  const Credentials pc1 = make(Authority::host("pc1")), pc2 = make(Authority::host("pc2"));
  connect(pc1, pc2);
  const Credentials pc1_again = TlsCredentials::load(folder("pc1")).value(),
                    pc2_again = TlsCredentials::load(folder("pc2")).value();
  EXPECT_FALSE(resumes(pc1, pc2_again));
  ASSERT_TRUE(client && server) << "but connects";
  EXPECT_TRUE(resumes(pc1, pc2_again));
  EXPECT_FALSE(resumes(pc1_again, pc2_again));
  ASSERT_TRUE(client && server);
  EXPECT_TRUE(resumes(pc1_again, pc2_again));
}

TEST_F(Tls, RefusesACertificateThatWasRevokedSinceTheSessionBegan) {
  const long serial = authority.issue(Authority::host("pc1"), folder("pc1"));
  const Credentials pc1 = TlsCredentials::load(folder("pc1")).value();
  connect(pc1, make(Authority::host("pc2")));
  authority.write_revoked(serial, folder("pc2"));
  EXPECT_FALSE(resumes(pc1, TlsCredentials::load(folder("pc2")).value()));
  expect_refused("'pc1' is not accepted: certificate revoked", "certificate revoked");
}

// With the same credentials, so that only the check of a ticket can notice it.
TEST_F(Tls, RefusesACertificateThatEndsAfterTheSessionBegan) {
  const Credentials pc2 = make(Authority::host("pc2"));
  for (const bool of_client : {true, false}) {
    Authority::Subject brief = Authority::host("pc1");
    brief.valid_until = std::chrono::seconds(3);
    const Credentials pc1 = make(brief);
    const auto resumes_brief = [&] { return of_client ? resumes(pc1, pc2) : resumes(pc2, pc1); };
    of_client ? connect(pc1, pc2) : connect(pc2, pc1);
    ASSERT_TRUE(client && server);
    ASSERT_TRUE(resumes_brief());
    while (!server_error) EXPECT_TRUE(resumes_brief() || server_error);
    if (of_client) {
      expect_refused("'pc1' is not accepted: certificate has expired", "certificate expired");
    } else {
      ASSERT_TRUE(client_error);
      EXPECT_NE(client_error->message.find("'pc1' is not accepted: certificate has expired"),
                std::string::npos)
          << client_error->message;
    }
    client.reset();
    client_error.reset();
    server_error.reset();
  }
}

TEST_F(Tls, NoticesThatFilesHaveChanged) {
  const Credentials first = make(Authority::host("pc1"));
  EXPECT_EQ(first->load_if_changed().value(), nullptr);
  authority.write_revoked(99, folder("pc1"));
  const Credentials second = first->load_if_changed().value();
  ASSERT_TRUE(second) << "a file was added";
  authority.issue(Authority::host("pc1"), folder("new"));
  std::filesystem::rename(folder("new") + "/own.crt", folder("pc1") + "/own.crt");
  EXPECT_FALSE(second->load_if_changed()) << "with the key of the other certificate";
  std::filesystem::rename(folder("new") + "/own.key", folder("pc1") + "/own.key");
  const Credentials third = second->load_if_changed().value();
  ASSERT_TRUE(third);
  EXPECT_EQ(third->load_if_changed().value(), nullptr);
}

TEST_F(Tls, ChecksWhoGreets) {
  connect(make(Authority::program("viewer")), make(Authority::host("pc2")));
  Greeting host;
  host.host = "pc2", host.host_id = host_id_for("pc2"), host.program = "dssmd";
  const auto is_believed = [](const Greeting& greeting, const Transport& transport,
                              TransportEnd end) {
    return check_certified(greeting, *transport.peer(), end).has_value();
  };
  EXPECT_TRUE(is_believed(host, *client, TransportEnd::connected));
  Greeting other = host;
  other.host = "pc3";
  EXPECT_FALSE(is_believed(other, *client, TransportEnd::connected)) << "another name";
  other = host;
  other.host_id[3] ^= 1;
  EXPECT_FALSE(is_believed(other, *client, TransportEnd::connected)) << "another machine";
  EXPECT_FALSE(is_believed(host, *server, TransportEnd::accepted)) << "a program as dssmd";
  host.program = "viewer";
  EXPECT_TRUE(is_believed(host, *server, TransportEnd::accepted));
  EXPECT_FALSE(is_believed(host, *server, TransportEnd::connected)) << "a program that listens";
}

TEST_F(Tls, NamesTheFileThatIsWrong) {
  const std::string at = folder("pc1");
  const auto error = [&] {
    const Result<Credentials> loaded = TlsCredentials::load(at);
    return loaded ? std::string() : loaded.error().message;
  };
  EXPECT_NE(error().find("'" + at + "/ca.crt': No such file"), std::string::npos) << error();
  authority.issue(Authority::host("pc1"), at);
  EXPECT_EQ(error(), "");
  ::chmod((at + "/own.key").c_str(), 0644);
  EXPECT_NE(error().find("every user can use '" + at + "/own.key'"), std::string::npos) << error();
  ::chmod((at + "/own.key").c_str(), 0600);
  authority.issue(Authority::host("pc3"), folder("pc3"));
  std::filesystem::copy_file(folder("pc3") + "/own.key", at + "/own.key",
                             std::filesystem::copy_options::overwrite_existing);
  EXPECT_NE(error().find("is not the key of '" + at + "/own.crt'"), std::string::npos) << error();
  std::ofstream(at + "/own.key") << "no key";
  EXPECT_NE(error().find("holds no private key"), std::string::npos) << error();
  authority.issue(Authority::host("pc1"), at);
  Authority("other").issue(Authority::host("pc4"), folder("pc4"));
  std::filesystem::copy_file(folder("pc4") + "/ca.crt", at + "/ca.crt",
                             std::filesystem::copy_options::overwrite_existing);
  EXPECT_NE(error().find("another vehicle"), std::string::npos) << error();
  authority.issue(Authority::host("pc1"), at);
  Authority("another").write_revoked(1, at);
  EXPECT_NE(error().find("holds 0 revocation lists of 'vehicle'"), std::string::npos) << error();
  authority.write_revoked(99, at);
  EXPECT_EQ(error(), "");
  std::ofstream(at + "/revoked.crl", std::ios::app) << "-----BEGIN X509 CRL-----\nAAAA\n";
  EXPECT_NE(error().find("is damaged"), std::string::npos) << error();
  std::ofstream(at + "/revoked.crl") << "nothing";
  EXPECT_NE(error().find("no revocation list"), std::string::npos) << error();
}

}  // namespace
}  // namespace dssm::wire
