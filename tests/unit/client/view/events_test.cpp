// SPDX-License-Identifier: Apache-2.0
#include "client/view/events.hpp"

#include <gtest/gtest.h>

namespace dssm::view {
namespace {

class EventsTest : public testing::Test {
 protected:
  EventsTest() {
    for (const char* name : {"pc1", "pc2"}) {
      HostInfo host;
      host.name = name;
      host.state = hosts_.empty() ? HostState::self : HostState::up;
      hosts_.push_back(host);
    }
    streams_.push_back(stream("lamp:0@pc1"));
    streams_.push_back(stream("lidar:0@pc2"));
    EXPECT_EQ(found(), "");  // what was there already is not an event
  }

  static StreamInfo stream(const std::string& name) {
    StreamInfo stream;
    stream.id = StreamId::parse(name).value();
    stream.state = StreamState::live;
    return stream;
  }

  // The new events: "warn: text\n" for each.
  std::string found() {
    events_.find(hosts_, streams_);
    std::string text;
    for (const ctl::Json& event : events_.all()) {
      if (event["number"] <= last_) continue;
      last_ = event["number"];
      text += event["severity"].get<std::string>() + ": " + event["text"].get<std::string>() + "\n";
    }
    return text;
  }

  std::vector<HostInfo> hosts_;
  std::vector<StreamInfo> streams_;

 private:
  Events events_;
  int last_ = 0;
};

TEST_F(EventsTest, NameStreams) {
  streams_[0].state = StreamState::stalled;
  EXPECT_EQ(found(), "warn: stream lamp:0@pc1: stalled\n");
  EXPECT_EQ(found(), "");
  streams_[0].state = StreamState::live;
  EXPECT_EQ(found(), "info: stream lamp:0@pc1 is live again\n");
  streams_[0].state = StreamState::no_writer;
  EXPECT_EQ(found(), "warn: stream lamp:0@pc1: no writer\n");
  streams_.push_back(stream("camera:0@pc1"));
  EXPECT_EQ(found(), "info: stream camera:0@pc1 was created\n");
  streams_.pop_back();
  EXPECT_EQ(found(), "") << "a list may lack it for a moment";
  EXPECT_EQ(found(), "info: stream camera:0@pc1 is gone\n");
  EXPECT_EQ(found(), "");
}

TEST_F(EventsTest, NameClocksThatAreOutOfBounds) {
  hosts_[1].clock_refused = true;
  hosts_[1].clock_reason = "its chronyd follows no source";
  EXPECT_EQ(found(), "warn: the clock of pc2 is out of bounds: its chronyd follows no source\n");
  EXPECT_EQ(found(), "");
  hosts_[1].clock_refused = false;
  EXPECT_EQ(found(), "info: the clock of pc2 is within its bounds again\n");
}

// Its streams are not listed meanwhile, but are not gone.
TEST_F(EventsTest, NameAHostThatIsDown) {
  const StreamInfo lidar = streams_[1];
  hosts_[1].state = HostState::down;
  hosts_[1].error = "connection refused";
  streams_.pop_back();
  EXPECT_EQ(found(), "warn: host pc2 is down: connection refused\n");
  EXPECT_EQ(found(), "");
  hosts_[1].state = HostState::up;
  streams_.push_back(lidar);
  EXPECT_EQ(found(), "info: host pc2 is up\n");
  streams_.pop_back();
  EXPECT_EQ(found(), "");
  EXPECT_EQ(found(), "info: stream lidar:0@pc2 is gone\n");
}

// Its streams are listed a little later than the host, or it is not listed any more.
TEST_F(EventsTest, NameNoStreamsWhoseHostComesOrGoes) {
  const StreamInfo lidar = streams_[1];
  streams_.pop_back();
  EXPECT_EQ(found(), "");
  streams_.push_back(lidar);
  EXPECT_EQ(found(), "");
  const HostInfo pc2 = hosts_[1];
  hosts_.pop_back();
  streams_.pop_back();
  EXPECT_EQ(found(), "warn: host pc2 is down: it is not known any more\n");
  EXPECT_EQ(found(), "");
  hosts_.push_back(pc2);
  EXPECT_EQ(found(), "info: host pc2 is up\n");
  streams_.push_back(lidar);
  EXPECT_EQ(found(), "");
}

}  // namespace
}  // namespace dssm::view
