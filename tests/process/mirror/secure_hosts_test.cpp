// SPDX-License-Identifier: Apache-2.0
//
// Two dssmd with credentials, whose files change while they run, and programs that connect to them.
#include <poll.h>

#include <array>
#include <dssm/pconnector.hpp>
#include <filesystem>
#include <fstream>

#include "tests/process/fleet/fleet_tools.hpp"
#include "tests/support/samples.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

class SecureHosts : public testing::Test {
 protected:
  // A dssmd that can be reloaded.
  struct Host {
    explicit Host(const std::string& name, const std::string& peer = {})
        : credentials(make_temp_dir()), dssmd(configure(name, peer), name) {}
    ~Host() {
      remove_tree(credentials);
      remove_tree(dir);
    }

    std::vector<std::string> configure(const std::string& name, const std::string& peer) {
      // Copies, so that a test can change them.
      std::filesystem::copy(credentials_for(name), credentials);
      const std::string path = dir + "/dssmd.conf";
      std::ofstream file(path);
      file << "listen = [\"127.0.0.1:0\"]\ncredentials = \"" << credentials << "\"\n";
      if (!peer.empty()) file << "peers = [\"" << peer << "\"]\n";
      return {"--config", path};
    }
    void reload() const { ::kill(dssmd.pid(), SIGHUP); }
    // One more line of the configuration, the last one.
    // In place of the line with that key, if there is one.
    void configure_also(const std::string& line) const {
      const std::string path = dir + "/dssmd.conf", key = line.substr(0, line.find('='));
      std::string all, other;
      for (std::ifstream file(path); std::getline(file, other);) {
        if (!other.starts_with(key)) all += other + "\n";
      }
      std::ofstream(path) << all << line << "\n";
      reload();
    }
    // Puts what `dssmctl pki` made into the credentials.
    void install(const std::vector<std::string>& words) const {
      std::vector<std::string> all = words;
      all.insert(all.end(), {"--ca", authority_folder(), "--out", dir + "/new.pem"});
      pki(std::move(all));
      pki({"install", dir + "/new.pem", "--credentials", credentials});
      reload();
    }

    const std::string dir = make_temp_dir();
    const std::string credentials;
    DaemonProcess dssmd;
  };

  static bool is_refused(Session& session, const std::string& why) {
    const std::vector<HostInfo> hosts = session.list_hosts().value();
    return hosts.size() > 1 && hosts[1].state == HostState::refused &&
           hosts[1].error.find(why) != std::string::npos;
  }

  Host pc1{"pc1"};
  Session here = connect(pc1.dssmd);
};

TEST_F(SecureHosts, LoseNoSampleWhenTheirCertificatesAreRenewed) {
  const Host pc2("pc2", pc1.dssmd.address());
  Session there = connect(pc2.dssmd);
  await_up(there, "pc1");
  EXPECT_FALSE(peer_at(there, pc1.dssmd.address()).insecure);
  auto writer = here.create<Numbered>("odometry", History{4096, 1ms}).value();
  writer.write(numbered(0), time_from_ns(0), 0ns);
  auto reader = open_filled<Numbered>(there, "odometry");
  Tid tid = 0;
  for (int renewal = 1; renewal <= 3; ++renewal) {
    const int days = 1000 + renewal;
    pc1.install({"renew", "pc1", "--days", std::to_string(days)});
    pc2.install({"renew", "pc2", "--days", std::to_string(days)});
    const auto is_renewed = [&](Session& session) {
      const Time until = session.daemon_info().value().credentials.value().valid_until;
      return until > WallClock::now() + (days * 24h - 1h);
    };
    await([&] {
      ++tid;
      writer.write(numbered(tid), time_from_ns(tid), 0ns);
      return is_renewed(here) && is_renewed(there);
    });
  }
  await([&] { return reader.newest_tid() == tid; });
  Numbered sample{};
  SampleInfo info;
  for (Tid next = 0; next <= tid; ++next) {
    EXPECT_EQ(reader.read_tid(next, sample, info), ReadStatus::ok) << next;
  }
  const MirrorInfo mirror = there.stream_info({"odometry", 0, "pc1"}).value().mirror.value();
  EXPECT_EQ(mirror.gap_samples, 0u);
  EXPECT_EQ(here.stream_info({"odometry", 0, ""}).value().channels, 1u);
}

TEST_F(SecureHosts, RefuseAHostThatWasRevokedWhileItWasConnected) {
  const Host pc3("pc3", pc1.dssmd.address());
  Session there = connect(pc3.dssmd);
  await_up(there, "pc1");
  auto writer = here.create<Numbered>("odometry", History{16, 1ms}).value();
  writer.write(numbered(0), time_from_ns(0), 0ns);
  auto reader = open_filled<Numbered>(there, "odometry");
  pc1.install({"revoke", "pc3"});
  await([&] { return is_refused(there, "certificate revoked"); });
  await([&] { return here.stream_info({"odometry", 0, ""}).value().channels == 0; });
}

TEST_F(SecureHosts, KeepTheirCredentialsWhenAFileIsWrong) {
  const Host pc2("pc2", pc1.dssmd.address());
  Session there = connect(pc2.dssmd);
  await_up(there, "pc1");
  std::ofstream(pc1.credentials + "/own.crt") << "nothing";
  pc1.reload();
  const Finished checked = run(
      {built("daemon/dssmd"), "--check-config", "--name", "pc1", "--credentials", pc1.credentials});
  EXPECT_EQ(checked.exit_status, 2);
  EXPECT_NE(checked.err.find("own.crt' holds no certificate in PEM form"), std::string::npos)
      << checked.err;
  // The reload before this renewal has failed.
  pc1.install({"renew", "pc1", "--days", "1000"});
  await([&] {
    return here.daemon_info().value().credentials.value().valid_until >
           WallClock::now() + 999 * 24h;
  });
  await_up(there, "pc1");
}

TEST_F(SecureHosts, TakeTheCertificateOfAnotherHostForNone) {
  const Finished checked = run(
      {built("daemon/dssmd"), "--check-config", "--name", "pc2", "--credentials", pc1.credentials});
  EXPECT_EQ(checked.exit_status, 2);
  EXPECT_NE(checked.err.find("is of host 'pc1', and this is host 'pc2'"), std::string::npos)
      << checked.err;
}

TEST_F(SecureHosts, GiveRightsToWhomACertificateNames) {
  auto odometry = here.create<Numbered>("odometry", History{16, 1ms}).value();
  auto camera = here.create<Numbered>("camera", History{16, 1ms}).value();
  odometry.write(numbered(0), time_from_ns(0), 0ns);
  pc1.configure_also("rights = [\"host:pc2 read,write odometry\", \"program:view* read camera\"]");
  const Host pc2("pc2", pc1.dssmd.address());
  Session there = connect(pc2.dssmd);
  auto reader = open_filled<Numbered>(there, "odometry");
  const std::vector<StreamInfo> shown = there.list_streams().value();
  ASSERT_EQ(shown.size(), 1u);
  EXPECT_EQ(shown[0].id.name, "odometry");
  EXPECT_EQ(there.open_reader<Numbered>("camera@pc1").error().code, Errc::no_permission);
  EXPECT_EQ(there.remove({"odometry", 0, "pc1"}).error().code, Errc::no_permission);
  auto writer = there.open_writer<Numbered>("odometry").value();
  writer.write(numbered(1), time_from_ns(1), 0ns);
  await([&] { return reader.newest_tid() == 1; });

  const PConnectorOptions viewer{.address = pc1.dssmd.address(),
                                 .credentials = credentials_for_program("viewer")};
  EXPECT_EQ(PConnector::list_streams(viewer).value().size(), 1u);
  EXPECT_TRUE(PConnector::open({"camera", 0, ""}, viewer));
  EXPECT_EQ(PConnector::open({"odometry", 0, ""}, viewer).error().code, Errc::no_permission);
}

TEST_F(SecureHosts, EndWhatIsNotAllowedAnyMore) {
  auto odometry = here.create<Numbered>("odometry", History{16, 1ms}).value();
  odometry.write(numbered(0), time_from_ns(0), 0ns);
  const Host pc2("pc2", pc1.dssmd.address());
  Session there = connect(pc2.dssmd);
  auto reader = open_filled<Numbered>(there, "odometry");
  pc1.configure_also("rights = [\"host:pc2 remove odometry\"]");
  await([&] { return here.stream_info({"odometry", 0, ""}).value().channels == 0; });
  odometry.write(numbered(1), time_from_ns(1), 0ns);
  // The mirror tries again for as long as it has a reader.
  await([&] {
    const MirrorInfo mirror = there.stream_info({"odometry", 0, "pc1"}).value().mirror.value();
    return mirror.error.find("may not open stream 'odometry:0@pc1'") != std::string::npos;
  });
  EXPECT_EQ(reader.newest_tid(), 0);
  // The reader is told, and goes on when it may read again.
  await([&] {
    Numbered sample{};
    SampleInfo info;
    static_cast<void>(reader.read_newest(sample, info));
    return reader.restart_error() && reader.restart_error()->code == Errc::no_permission;
  });
  pc1.configure_also("rights = [\"host:pc2 read odometry\"]");
  await([&] {
    Numbered sample{};
    SampleInfo info;
    return reader.read_newest(sample, info) == ReadStatus::ok && info.tid == 1;
  });
  EXPECT_FALSE(reader.restart_error());
  EXPECT_EQ(reader.restarts(), 0u) << "it is the same stream";
}

TEST_F(SecureHosts, ServeAProgramWithACertificate) {
  auto writer = here.create<Numbered>("odometry", History{16, 1ms}).value();
  const PConnectorOptions options{.address = pc1.dssmd.address(),
                                  .credentials = credentials_for_program("viewer")};
  EXPECT_EQ(PConnector::list_streams(options).value().size(), 1u);
  PConnector reader = PConnector::open({"odometry", 0, ""}, options).value();
  reader.subscribe({}).value();
  std::vector<std::byte> payload(sizeof(Numbered));
  SampleInfo info;
  for (int i = 0; i < 100; ++i) {
    writer.write(numbered(i), time_from_ns(i), 0ns);
    await([&] {
      static_cast<void>(reader.wait(MonoClock::now() + 10ms));
      return reader.read_next(payload, info).value() == ReadStatus::ok;
    });
    EXPECT_EQ(info.tid, i);
  }
  // Large ones, more than one receive takes, and what event libraries wait for.
  using Image = std::array<std::byte, 1'000'000>;
  auto camera =
      here.create_raw({"camera", 0, ""}, {"", sizeof(Image), 1, {}}, History{8, 1ms}).value();
  PConnector images = PConnector::open({"camera", 0, ""}, options).value();
  images.subscribe({}).value();
  std::vector<std::byte> image(sizeof(Image)), got(sizeof(Image));
  for (int i = 0; i < 20; ++i) {
    std::fill(image.begin(), image.end(), static_cast<std::byte>(i));
    camera.write(image, time_from_ns(i), 0ns);
    ReadStatus status = ReadStatus::not_yet;
    while (status != ReadStatus::ok) {
      pollfd ready{images.ready_fd(), POLLIN, 0};
      ASSERT_EQ(::poll(&ready, 1, -1), 1);
      status = images.read_next(got, info).value();
    }
    EXPECT_TRUE(got == image);
  }
}

TEST_F(SecureHosts, ServeAProgramWhoseCertificateIsReplacedWhileItRuns) {
  auto writer = here.create<Numbered>("odometry", History{16, 1ms}).value();
  const std::string folder = make_temp_dir();
  const auto install = [&](const std::string& program) {
    std::filesystem::copy(credentials_for_program(program), folder,
                          std::filesystem::copy_options::recursive |
                              std::filesystem::copy_options::overwrite_existing);
  };
  install("lost-laptop");
  PConnector reader =
      PConnector::open({"odometry", 0, ""}, {.address = pc1.dssmd.address(), .credentials = folder})
          .value();
  reader.subscribe({}).value();
  install("new-laptop");
  pc1.install({"revoke", "lost-laptop"});
  await([&] { return here.stream_info({"odometry", 0, ""}).value().channels == 0; });
  std::vector<std::byte> payload(sizeof(Numbered));
  SampleInfo info;
  Tid tid = 0;
  await([&] {
    writer.write(numbered(tid), time_from_ns(tid), 0ns);
    ++tid;
    static_cast<void>(reader.wait(MonoClock::now() + 10ms));
    const Result<ReadStatus> read = reader.read_next(payload, info);  // fails until it is connected
    return read && *read == ReadStatus::ok;
  });
  remove_tree(folder);
}

TEST_F(SecureHosts, TellAProgramWhyItIsRefused) {
  const std::string folder = credentials_for_program("intruder");
  pc1.install({"revoke", "intruder"});
  await([&] {
    const Result<PConnector> opened = PConnector::open(
        {"odometry", 0, ""}, {.address = pc1.dssmd.address(), .credentials = folder});
    EXPECT_FALSE(opened);
    return !opened && opened.error().message.find("certificate revoked") != std::string::npos;
  });
}

}  // namespace
}  // namespace dssm::test
