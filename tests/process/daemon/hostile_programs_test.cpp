// SPDX-License-Identifier: Apache-2.0
//
// Programs that misuse what dssmd gave them against the others that use the same stream.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <linux/futex.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <atomic>
#include <climits>
#include <thread>

#include "core/ring/bell.hpp"
#include "core/ring/ring_memory.hpp"
#include "tests/process/daemon/raw_client.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// It may only read, so it can do nothing but suppress wake-ups.
TEST(HostileReader, DelaysNoOtherReader) {
  DaemonProcess daemon;
  Session session = connect(daemon);
  Writer<int> writer = session.create<int>("odometry", kShort).value();
  Reader<int> reader = session.open_reader<int>("odometry").value();
  RawClient hostile(daemon.socket_path());
  const Answer opened = hostile.ask(open_request("odometry"));
  ASSERT_EQ(opened.descriptors.size(), 3u);
  const SharedMapping bell =
      SharedMapping::map(opened.descriptors[1].get(), 4096, PROT_READ | PROT_WRITE).value();
  std::atomic<bool> done = false;
  std::thread attack([&] {
    auto& word = bell.as<std::atomic<std::uint32_t>>();
    std::uint32_t elsewhere = 0;
    while (!done) {
      word &= ~1U;
      ::syscall(SYS_futex, &word, FUTEX_REQUEUE, 0, static_cast<long>(INT_MAX), &elsewhere, 0);
    }
  });
  constexpr int kSamples = 100;
  const MonoTime begin = MonoClock::now();
  std::atomic<int> seen = -1;
  std::thread honest([&] {
    for (int i = 0; i < kSamples; ++i) {
      EXPECT_EQ(reader.wait(kNever), WaitStatus::ready);
      int sample = -1;
      SampleInfo info;
      EXPECT_EQ(reader.read_next(sample, info), ReadStatus::ok);
      seen = sample;
    }
  });
  for (int i = 0; i < kSamples; ++i) {
    std::this_thread::sleep_for(1ms);  // so that it sleeps
    writer.write(i);
    while (seen < i && MonoClock::now() < begin + kSamples * 1s) std::this_thread::yield();
  }
  honest.join();
  done = true;
  attack.join();
  // Each would take up to a second, if nothing but the writer woke it.
  EXPECT_LT(MonoClock::now() - begin, kSamples * 250ms);
}

// An honest program and a hostile one that write to the same stream.
class HostileWriter : public testing::Test {
 protected:
  void SetUp() override { ASSERT_EQ(opened_.descriptors.size(), 4u); }

  DaemonProcess daemon_;
  Session session_ = connect(daemon_);
  Writer<int> honest_ = session_.create<int>("odometry", kShort).value();
  RawClient hostile_{daemon_.socket_path()};
  const Answer opened_ = hostile_.ask(open_request("odometry", true));
  const std::shared_ptr<const ring::RingMapping> ring_ =
      ring::RingMapping::open_untrusted(opened_.descriptors.at(0).get(), ring::Access::read_write)
          .value();
};

// With the same eventfd for all writers, write(2) would never return.
TEST_F(HostileWriter, HangsNoOtherByItsDoorbell) {
  const int doorbell = opened_.descriptors[3].get();
  ASSERT_EQ(::fcntl(doorbell, F_SETFL, 0), 0);
  ASSERT_EQ(::eventfd_write(doorbell, UINT64_MAX - 1), 0);
  ring_->header().doorbell_armed = 1;
  for (int i = 0; i < 10; ++i) EXPECT_EQ(honest_.write(i), i);
}

// It holds the lock for ever.
TEST_F(HostileWriter, KeepsOthersOutForABoundedTime) {
  ASSERT_EQ(ring_->writer_lock().lock(), ring::LockResult::locked);
  std::thread([&] { EXPECT_EQ(honest_.write(1), kNoTid); }).join();
  ring_->writer_lock().unlock();
  EXPECT_EQ(honest_.write(1), 0);
}

// Millions of empty fields in one request took 2.4 s and 700 MiB.
TEST(HostileProgram, CannotOccupyDssmdByOneLongRequest) {
  DaemonProcess daemon;
  RawClient hostile(daemon.socket_path());
  std::string fields;
  for (std::size_t i = 0; i < (1U << 18); ++i) fields += std::string("\x22\x00", 2);
  local::Request request = create_request("bomb");
  ASSERT_TRUE(request.mutable_create()->mutable_type()->MergeFromString(fields));
  const Answer answer = hostile.ask(request);
  ASSERT_TRUE(answer.response.has_failure());
  EXPECT_NE(answer.response.failure().message().find("neither payload nor property"),
            std::string::npos);
  EXPECT_TRUE(hostile.ask(list_request()).response.has_stream_list()) << "it stays connected";
}

TEST(HostileProgram, WhoseRequestFindsNoMemoryEndsItsConnectionOnly) {
  if (!kMemoryIsMeasurable) GTEST_SKIP() << "a sanitizer needs memory itself";
  DaemonProcess daemon;
  RawClient honest(daemon.socket_path());
  honest.ask(create_request("odometry"));
  local::Request request;
  request.mutable_set_property()->mutable_id()->set_name("odometry");
  request.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
  {
    const MemoryLimit limit(daemon.pid(), 512U << 10);
    RawClient hostile(daemon.socket_path());
    EXPECT_FALSE(hostile.ask(request).response.has_done());
    EXPECT_TRUE(honest.ask(list_request()).response.has_stream_list());
  }
  EXPECT_TRUE(honest.ask(request).response.has_done());
}

TEST(HostileProgram, ThatSendsNoHelloDoesNotKeepItsPlace) {
  DaemonProcess daemon;
  RawClient silent(daemon.socket_path(), false);
  const Answer answer = silent.receive();
  EXPECT_NE(answer.response.failure().message().find("sent no Hello"), std::string::npos);
  EXPECT_TRUE(silent.receive().ended);
}

}  // namespace
}  // namespace dssm::test
