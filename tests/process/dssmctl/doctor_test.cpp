// SPDX-License-Identifier: Apache-2.0
//
// dssmctl doctor with a real dssmd. What this machine itself lacks is no matter here: only checks
// whose outcome a test has in hand are looked at.
#include <sys/stat.h>

#include <cstdlib>
#include <fstream>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using DoctorInAFleet = FleetTest;

class Doctor : public CtlTest {
 protected:
  // The document, and the check of that name in it; the exit status fits.
  Json doctor(std::vector<std::string> words = {}) {
    words.insert(words.begin(), {"doctor", "--json"});
    return checked(ctl(std::move(words)));
  }

 public:
  static Json checked(const Finished& finished) {
    Json document = Json::parse(finished.out, nullptr, false);
    EXPECT_TRUE(document.is_object()) << finished.out << finished.err;
    EXPECT_EQ(document["ok"], finished.exit_status == 0) << finished.out;
    return document;
  }
  static Json check(const Json& document, const std::string& name) {
    for (const Json& check : document["checks"]) {
      if (check["name"] == name) return check;
    }
    return {};
  }
};

TEST_F(Doctor, FindsAHealthyDssmdAndSucceeds) {
  const Json document = doctor();
  EXPECT_EQ(document["ok"], true);
  for (const char* name : {"daemon", "version", "listening", "host names", "stream names"}) {
    const Json found = check(document, name);
    EXPECT_EQ(found["status"], "ok") << name << found;
    EXPECT_TRUE(found["cause"].is_null() && found["command"].is_null()) << found;
  }
  EXPECT_TRUE(contains(check(document, "daemon")["text"], std::to_string(daemon_.pid())));
  EXPECT_FALSE(check(document, "disk /").is_null());

  const std::vector<std::string> lines = lines_of(output({"doctor"}));
  ASSERT_GT(lines.size(), 5U);
  EXPECT_TRUE(lines[0].starts_with("OK    daemon: dssmd (pid ")) << lines[0];
}

TEST_F(Doctor, ReportsWhatToDoWithoutADssmd) {
  daemon_.kill_hard();
  const Finished finished = ctl({"doctor"});
  EXPECT_EQ(finished.exit_status, 1);
  const std::vector<std::string> lines = lines_of(finished.out);
  ASSERT_GT(lines.size(), 3U);
  EXPECT_TRUE(lines[0].starts_with("FAIL  daemon: ")) << lines[0];
  EXPECT_TRUE(contains(lines[0], daemon_.socket_path())) << lines[0];
  EXPECT_TRUE(lines[1].starts_with("      likely: ")) << lines[1];
  EXPECT_TRUE(lines[2].starts_with("      try:    ")) << lines[2];
  EXPECT_TRUE(finished.err.starts_with("dssmctl: doctor: 1 of ")) << finished.err;
  EXPECT_EQ(check(doctor(), "daemon")["status"], "fail");
}

TEST_F(Doctor, DistinguishesAFileFromASocket) {
  const std::string file = daemon_.runtime_dir() + "/no-socket";
  std::ofstream(file) << "x";
  const Json daemon = check(doctor({"--socket", file}), "daemon");
  EXPECT_EQ(daemon["status"], "fail");
  EXPECT_TRUE(contains(daemon["cause"], "is not a socket")) << daemon;
  const Json nothing = check(doctor({"--socket", file + "-at-all"}), "daemon");
  EXPECT_TRUE(contains(nothing["command"], "unset DSSM_SOCKET")) << nothing;
}

TEST_F(Doctor, RunsChronyc) {
  const std::string folder = daemon_.runtime_dir() + "/bin";
  ASSERT_EQ(::mkdir(folder.c_str(), 0755), 0);
  std::ofstream(folder + "/chronyc") << "#!/bin/sh\n[ \"$*\" = '-c tracking' ] || exit 9\n"
                                        "echo C0A80001,ntp.pc9,3,1.5,0,0,0,0,0,0,0,0,64,Normal\n";
  ASSERT_EQ(::chmod((folder + "/chronyc").c_str(), 0755), 0);
  const char* path = std::getenv("PATH");
  const Finished finished =
      run(argv({"doctor", "--json"}),
          {daemon_.environment(), "PATH=" + folder + ":" + (path ? path : "/usr/bin:/bin")});
  const Json clock = check(checked(finished), "clock");
  EXPECT_EQ(clock["status"], "warn") << "dssmd reaches no chronyd: " << clock;
  EXPECT_TRUE(contains(clock["text"], "ntp.pc9")) << clock;
}

TEST_F(DoctorInAFleet, FindsTheHostThatIsDown) {
  Json document = Doctor::checked(ctl({"doctor", "--json"}));
  EXPECT_EQ(document["ok"], true);
  EXPECT_EQ(Doctor::check(document, "host pc3")["status"], "ok");
  pc3_.kill_hard();
  await_state("pc3", HostState::down);
  document = Doctor::checked(ctl({"doctor", "--json"}));
  EXPECT_EQ(document["ok"], false);
  EXPECT_EQ(Doctor::check(document, "host pc2")["status"], "ok");
  const Json down = Doctor::check(document, "host pc3");
  EXPECT_EQ(down["status"], "fail");
  EXPECT_TRUE(contains(down["text"], pc3_.address())) << down;
  EXPECT_TRUE(down["command"].is_string()) << down;
}

TEST_F(DoctorInAFleet, FindsStreamsOfOneName) {
  auto on_2 = on_pc2_.create<double>("odom", depth_of(4)).value();
  auto on_3 = on_pc3_.create<double>("odom", depth_of(4)).value();
  await_streams(2);
  const Json document = Doctor::checked(ctl({"doctor", "--json"}));
  const Json names = Doctor::check(document, "stream names");
  EXPECT_EQ(names["status"], "warn");
  EXPECT_TRUE(contains(names["text"], "'odom:0' (on pc2, pc3)")) << names;
  EXPECT_EQ(document["ok"], true);  // it works
}

TEST_F(Doctor, FindsTwoHostsOfOneName) {
  DaemonProcess namesake({"--peer", daemon_.address()}, "pc1");
  Session session = session_with(namesake);
  await([&] { return session.list_hosts().value().at(1).state == HostState::refused; });
  const Json document = doctor({"--socket", namesake.socket_path()});
  EXPECT_EQ(check(document, "host names")["status"], "fail") << document;
}

}  // namespace
}  // namespace dssm::test
