// SPDX-License-Identifier: Apache-2.0
//
// The key `rights` with a real user: nobody, in the group that has the number 54321 or not.
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <dssm/dssm.hpp>
#include <fstream>
#include <functional>
#include <iterator>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

constexpr gid_t kDrivers = 54321;

class RightsProcess : public testing::Test {
 protected:
  void SetUp() override {
    if (::geteuid() != 0) GTEST_SKIP() << "only root can become somebody else";
    configure("user:0 all *");
    daemon_.emplace(std::vector<std::string>{"--config", path_, "--listen", "", "--socket-mode",
                                             "0666", "--recovery-grace", "3 s"});
    ASSERT_EQ(::chmod(daemon_->runtime_dir().c_str(), 0755), 0);
  }
  void TearDown() override {
    if (child_ > 0) {
      ::kill(child_, SIGKILL);
      wait_for(child_);
    }
    daemon_.reset();
    remove_tree(dir_);
  }

  void configure(const std::string& line) {
    std::ofstream(path_) << "rights = [\"" << line << "\"]\n";
  }
  void reload(const std::string& line) {
    configure(line);
    ::kill(daemon_->pid(), SIGHUP);
    Session root = session();
    await([&] {
      const std::vector<RightLine> lines = root.stream_rights({"lidar", 0, ""}).value().lines;
      return lines.size() == 1 && lines[0].line == line;
    });
  }

  // Runs `program` as nobody; `tell` makes a line of text that heard() waits for.
  using Tell = std::function<void(const std::string&)>;
  void as_nobody(const std::vector<gid_t>& groups,
                 const std::function<void(const Tell&)>& program) {
    int ends[2] = {-1, -1};
    ASSERT_EQ(::pipe(ends), 0);
    child_ = ::fork();
    if (child_ == 0) {
      become_nobody(groups);
      program([&](const std::string& line) {
        const std::string text = line + "\n";
        if (::write(ends[1], text.data(), text.size()) < 0) ::_exit(101);
      });
      ::_exit(0);
    }
    ::close(ends[1]);
    if (from_child_) std::fclose(from_child_);
    from_child_ = ::fdopen(ends[0], "r");
  }
  std::string heard() {
    char line[1024] = {};
    if (!std::fgets(line, sizeof line, from_child_)) return "(it has ended)";
    return std::string(line, std::strlen(line) - 1);
  }
  void end_child() {
    ::kill(child_, SIGKILL);
    wait_for(std::exchange(child_, -1));
  }
  Session session() { return Session::connect({.socket_path = daemon_->socket_path()}).value(); }

  std::string dir_ = make_temp_dir();
  std::string path_ = dir_ + "/dssmd.conf";
  std::optional<DaemonProcess> daemon_;
  pid_t child_ = -1;
  std::FILE* from_child_ = nullptr;
};

std::string outcome(const Result<RawWriter>& writer) {
  return writer ? "created"
                : std::string(name_of(writer.error().code)) + " " + writer.error().message;
}

const TypeInfo& number_type() {
  static const TypeInfo type = type_of<double>();
  return type;
}

TEST_F(RightsProcess, AGroupCountsAsTheKernelReportsIt) {
  reload("group:54321 create lidar*");
  const auto create = [&](const Tell& tell) {
    Session own = session();
    tell(outcome(own.create_raw({"lidar", 0, ""}, number_type(), {4, Duration(1)})));
    tell(std::to_string(own.list_streams().value().size()));
    ::pause();
  };
  as_nobody({}, create);
  const std::string refused = heard();
  EXPECT_NE(refused.find("no_permission"), std::string::npos) << refused;
  EXPECT_NE(refused.find("\"user:65534 create lidar\""), std::string::npos) << refused;
  end_child();
  as_nobody({kDrivers}, create);
  EXPECT_EQ(heard(), "created");
  EXPECT_EQ(heard(), "1");
  EXPECT_EQ(session().list_streams().value().size(), 1u) << "root may do everything";
  end_child();
  as_nobody({}, create);
  heard();
  EXPECT_EQ(heard(), "0") << "lists do not show what nobody may not see";
}

TEST_F(RightsProcess, AStreamThatIsGivenBackNeedsThemToo) {
  reload("user:nobody create lidar");
  as_nobody({}, [&](const Tell& tell) {
    Session own = session();
    const auto writer = own.create_raw({"lidar", 0, ""}, number_type(), {4, Duration(1)});
    tell(outcome(writer));
    ::pause();
  });
  ASSERT_EQ(heard(), "created");
  daemon_->kill_hard();
  daemon_->start();
  await([&] { return session().list_streams().value().size() == 1; });
  daemon_->kill_hard();
  configure("user:nobody read lidar");
  daemon_->start();
  Session own = session();
  // The program of nobody connects again, too.
  await([&] { return own.list_clients().value().size() == 2; });
  EXPECT_EQ(own.stream_info({"lidar", 0, ""}).error().code, Errc::not_found);
}

TEST_F(RightsProcess, WhoMayOnlyWriteReplacesNothingOnAnotherHost) {
  const DaemonProcess pc2({}, "pc2");
  daemon_.emplace(std::vector<std::string>{"--config", path_, "--listen", "", "--socket-mode",
                                           "0666", "--peer", pc2.address()});
  ASSERT_EQ(::chmod(daemon_->runtime_dir().c_str(), 0755), 0);
  reload("user:nobody write lidar");
  as_nobody({}, [&](const Tell& tell) {
    Session own = session();
    await([&] { return own.list_streams().value().size() == 1; });
    const StreamId lidar{"lidar", 0, "pc2"};
    tell(outcome(own.create_raw(lidar, type_of<float>(), {4, Duration(1)})));
    tell(outcome(own.create_raw(lidar, number_type(), {5, Duration(1)})));
    tell(outcome(own.create_raw(lidar, number_type(), {4, Duration(1)})));
    tell(outcome(own.create_raw({"lidar", 0, ""}, number_type(), {4, Duration(1)})));
    ::pause();
  });
  Session there = Session::connect({.socket_path = pc2.socket_path()}).value();
  const StreamId lidar{"lidar", 0, ""};
  ASSERT_TRUE(there.create_raw(lidar, number_type(), {4, Duration(1)}));
  const std::uint64_t ring = there.stream_info(lidar).value().incarnation;
  const auto heard_code = [&] {
    const std::string line = heard();
    return line.substr(0, line.find(' '));
  };
  EXPECT_EQ(heard_code(), "type_mismatch");
  EXPECT_EQ(heard_code(), "conflict") << "it is shorter";
  EXPECT_EQ(heard_code(), "created") << "it fits: the program joins it";
  EXPECT_EQ(heard_code(), "no_permission") << "here is none";
  EXPECT_EQ(there.stream_info(lidar).value().incarnation, ring) << "nothing took its place";
}

TEST_F(RightsProcess, AReaderIsToldThatItMayNotReadAnyMore) {
  reload("local read *");
  // Before this process has a session, whose thread the child would not have.
  as_nobody({}, [&](const Tell& tell) {
    Session own = session();
    Reader<double> reader = own.await_reader<double>("lidar").value();
    tell("open");
    double sample = 0;
    SampleInfo info;
    while (!reader.restart_error()) {
      static_cast<void>(reader.wait(deadline_in(std::chrono::milliseconds(100))));
      static_cast<void>(reader.read_newest(sample, info));
    }
    tell(std::string(name_of(reader.restart_error()->code)));
    ::pause();
  });
  Session root = session();
  Writer<double> writer = root.create<double>("lidar", {4, Duration(1)}).value();
  ASSERT_EQ(heard(), "open");
  reload("local write *");
  EXPECT_EQ(heard(), "no_permission");
  EXPECT_EQ(root.stream_info({"lidar", 0, ""}).value().readers, 0u);
}

}  // namespace
}  // namespace dssm::test
