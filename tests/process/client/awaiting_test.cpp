// SPDX-License-Identifier: Apache-2.0
//
// What is reported to a program that waits for a stream.
#include <gtest/gtest.h>

#include "tests/process/client/callbacks.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;

struct Awaiting : testing::Test {
  Session noticing(std::function<void(const std::string&)> on_notice) {
    return Session::connect({.socket_path = daemon.socket_path(),
                             .request_timeout = 60s,
                             .on_notice = std::move(on_notice)})
        .value();
  }
  void create(const std::string& name) {
    writers.push_back(session.create<double>(name, test::kShort).value());
  }

  test::DaemonProcess daemon;
  Session session = test::connect(daemon);
  std::vector<Writer<double>> writers;
  test::Events<std::string> notices;
};

const std::string kBegin = "has waited ", kSimilar = "'lidar@pc1'";

TEST_F(Awaiting, AReaderIsReportedOnceWithTheReasonAndSimilarNames) {
  create("lidar");
  Session waiting = noticing([&](const std::string& text) {
    notices.add(text);
    create("lidr");
  });
  ASSERT_TRUE(waiting.await_reader<double>("lidr"));
  ASSERT_EQ(notices.now().size(), 1u);
  const std::string text = notices.now()[0];
  EXPECT_TRUE(text.starts_with(kBegin)) << text;
  EXPECT_NE(text.find("there is no stream 'lidr:0'"), std::string::npos) << text;
  EXPECT_NE(text.find(kSimilar), std::string::npos) << text;
}

TEST_F(Awaiting, ACallbackIsReportedInTheSameWay) {
  create("lidar");
  Session waiting = noticing([&](const std::string& text) { notices.add(text); });
  test::Events<Tid> calls;
  const auto handle = waiting.subscribe<double>(
      "lidr", [&](const Sample<double>& sample) { calls.add(sample.tid()); });
  const std::string text = notices.await(1)[0];
  EXPECT_TRUE(text.starts_with(kBegin)) << text;
  EXPECT_NE(text.find(kSimilar), std::string::npos) << text;
  create("lidr");
  writers.back().write(0);
  calls.await(1);
  EXPECT_EQ(notices.now().size(), 1u);
}

TEST_F(Awaiting, IsPrintedToStandardErrorByDefault) {
  testing::internal::CaptureStderr();
  EXPECT_FALSE(session.await_reader<double>("lidr", 2100ms));
  const std::string printed = testing::internal::GetCapturedStderr();
  EXPECT_TRUE(printed.starts_with("dssm: " + kBegin)) << printed;
  EXPECT_EQ(std::count(printed.begin(), printed.end(), '\n'), 1) << printed;
}

}  // namespace
}  // namespace dssm
