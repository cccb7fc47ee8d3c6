// SPDX-License-Identifier: Apache-2.0
//
// dssmd is killed and started anew, and programs give their streams back: by raw messages, the
// honest and the forged ones. The same with real programs is in tests/process/client.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/base/sealed_memory.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"
#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {
namespace {

UniqueFd memory_file(std::size_t bytes, int seals) {
  UniqueFd fd(::memfd_create("forged", MFD_CLOEXEC | MFD_ALLOW_SEALING));
  EXPECT_EQ(::ftruncate(fd.get(), static_cast<off_t>(bytes)), 0);
  EXPECT_EQ(::fcntl(fd.get(), F_ADD_SEALS, seals), 0);
  return fd;
}

class Offer : public testing::Test {
 protected:
  // Creates a stream, sets its property, and kills dssmd; gives what the writer holds.
  std::vector<UniqueFd> hold_through_crash(const std::string& name, bool as_writer = true) {
    return hold_through_crash(daemon_, name, as_writer);
  }
  static std::vector<UniqueFd> hold_through_crash(DaemonProcess& daemon, const std::string& name,
                                                  bool as_writer) {
    std::vector<UniqueFd> held;
    {
      RawClient client(daemon.socket_path());
      Answer created = client.ask(create_request(name));
      EXPECT_TRUE(created.response.has_opened()) << created.response.failure().message();
      local::Request set;
      set.mutable_set_property()->mutable_id()->set_name(name);
      set.mutable_set_property()->set_property("upside down");
      EXPECT_TRUE(client.ask(set).response.has_done());
      held = as_writer ? std::move(created.descriptors)
                       : std::move(client.ask(open_request(name)).descriptors);
    }
    daemon.kill_hard();
    daemon.start();
    return held;
  }

  std::string refusal(const std::string& name, const std::vector<UniqueFd>& descriptors) {
    RawClient client(daemon_.socket_path());
    const Answer answer = client.ask(offer_request(name, true), numbers(descriptors));
    EXPECT_TRUE(answer.response.has_failure()) << "a forged stream was taken";
    EXPECT_EQ(client.ask(list_request()).response.stream_list().streams_size(), 0);
    return answer.response.failure().code();
  }

  DaemonProcess daemon_{{"--log-level", "error"}};
};

TEST_F(Offer, BringsAWritersStreamBackWithSamplesTypeAndProperty) {
  std::vector<UniqueFd> held = hold_through_crash("odometry");
  const auto mapping = ring::RingMapping::open_untrusted(held[0].get(), ring::Access::read_write);
  const auto bell = ring::Bell::open_untrusted(held[1].get());
  ASSERT_TRUE(mapping && bell);
  ring::RingWriter writer(**mapping, **bell, held[3].get());
  const std::vector<std::byte> payload(24, std::byte{7});
  writer.write(payload, time_from_ns(1000), Duration(5));  // dssmd is back, but does not know yet

  RawClient client(daemon_.socket_path());
  const Answer taken = client.ask(offer_request("odometry", true), numbers(held));
  ASSERT_TRUE(taken.response.has_opened()) << taken.response.failure().message();
  EXPECT_TRUE(taken.descriptors.empty());
  EXPECT_GT(taken.response.opened().handle(), 0u);
  writer.write(payload, time_from_ns(2000), Duration(5));

  RawClient reader(daemon_.socket_path());
  const local::Response list = reader.ask(list_request()).response;
  ASSERT_EQ(list.stream_list().streams_size(), 1);
  EXPECT_EQ(list.stream_list().streams(0).newest(), 1);
  EXPECT_EQ(list.stream_list().streams(0).writers(), 1u);
  EXPECT_EQ(list.stream_list().streams(0).type().name(), "Odometry");
  EXPECT_EQ(list.stream_list().streams(0).creator_pid(), ::getpid());
  local::Request get;
  get.mutable_get_property()->mutable_id()->set_name("odometry");
  EXPECT_EQ(reader.ask(get).response.property().property(), "upside down");

  const Answer opened = reader.ask(open_request("odometry"));
  ASSERT_EQ(opened.descriptors.size(), 3u);
  const auto seen =
      ring::RingMapping::open_untrusted(opened.descriptors[0].get(), ring::Access::read_only);
  ASSERT_TRUE(seen) << seen.error().message;
  std::vector<std::byte> read(24);
  SampleInfo info;
  EXPECT_EQ(ring::RingReader(**seen).read(1, read, info), ReadStatus::ok);
  EXPECT_EQ(read, payload);
  EXPECT_EQ(to_ns(info.time), 2000);
}

TEST_F(Offer, BringsAStreamBackFromAReaderAloneForWritersToo) {
  const std::vector<UniqueFd> held = hold_through_crash("odometry", false);
  ASSERT_EQ(held.size(), 3u);
  RawClient client(daemon_.socket_path());
  ASSERT_TRUE(client.ask(offer_request("odometry"), numbers(held)).response.has_opened());
  const Answer writer = client.ask(create_request("odometry"));
  EXPECT_FALSE(writer.response.opened().created()) << "the old ring, not a new one";
  ASSERT_EQ(writer.descriptors.size(), 4u);
  EXPECT_TRUE(
      ring::RingMapping::open_untrusted(writer.descriptors[0].get(), ring::Access::read_write));
}

TEST_F(Offer, OfOneRingByTwoProgramsCountsBoth) {
  const std::vector<UniqueFd> held = hold_through_crash("odometry");
  RawClient one(daemon_.socket_path()), two(daemon_.socket_path());
  ASSERT_TRUE(one.ask(offer_request("odometry", true), numbers(held)).response.has_opened());
  ASSERT_TRUE(two.ask(offer_request("odometry"), numbers(held)).response.has_opened());
  const local::Response list = one.ask(list_request()).response;
  ASSERT_EQ(list.stream_list().streams_size(), 1);
  EXPECT_EQ(list.stream_list().streams(0).writers(), 1u);
  EXPECT_EQ(list.stream_list().streams(0).readers(), 1u);
}

TEST_F(Offer, ManyInOneGoEachFindTheirOwnDescriptors) {
  std::vector<std::vector<UniqueFd>> held;
  {
    RawClient client(daemon_.socket_path());
    for (std::size_t i = 0; i < 50; ++i) {
      held.push_back(client.ask(create_request(numbered("s", i))).descriptors);
    }
  }
  daemon_.kill_hard();
  daemon_.start();
  RawClient client(daemon_.socket_path());
  for (std::size_t i = 0; i < held.size(); ++i) {
    client.send(offer_request(numbered("s", i), true), numbers(held[i]));
    client.send(list_request());
  }
  for (std::size_t i = 0; i < held.size(); ++i) {
    EXPECT_TRUE(client.receive().response.has_opened());
    EXPECT_TRUE(client.receive().response.has_stream_list());
  }
}

TEST_F(Offer, OfAnotherRingThanTheRegisteredOneIsAConflict) {
  const std::vector<UniqueFd> held = hold_through_crash("odometry");
  RawClient fresh(daemon_.socket_path());
  ASSERT_TRUE(fresh.ask(create_request("odometry")).response.opened().created())
      << "after the time for offers";
  const Answer late = fresh.ask(offer_request("odometry", true), numbers(held));
  EXPECT_EQ(late.response.failure().code(), "conflict");
}

TEST_F(Offer, ComesBeforeAFreshWriterThatAskedEarlier) {
  DaemonProcess patient({"--recovery-grace", "60 s", "--log-level", "error"});
  const std::vector<UniqueFd> held = hold_through_crash(patient, "odometry", true);
  RawClient fresh(patient.socket_path()), old(patient.socket_path());
  fresh.send(create_request("odometry"));
  ASSERT_TRUE(old.ask(offer_request("odometry", true), numbers(held)).response.has_opened());
  const Answer joined = fresh.receive();
  ASSERT_TRUE(joined.response.has_opened()) << joined.response.failure().message();
  EXPECT_FALSE(joined.response.opened().created()) << "a new ring replaced one that is in use";
}

TEST_F(Offer, IsNotWaitedForAfterAProperStop) {
  DaemonProcess daemon({"--recovery-grace", "60 s", "--log-level", "error"});
  EXPECT_EQ(daemon.stop(), 0);
  daemon.start();
  RawClient client(daemon.socket_path());  // would not be answered for a minute
  EXPECT_TRUE(client.ask(create_request("odometry")).response.opened().created());
}

TEST_F(Offer, OfFilesThatAreNotSealedIsRefused) {
  for (std::size_t which = 0; which < 3; ++which) {
    std::vector<UniqueFd> held = hold_through_crash("odometry");
    held[which] = memory_file(1 << 16, 0);
    EXPECT_EQ(refusal("odometry", held), "protocol");
  }
}

TEST_F(Offer, OfFilesOfAnotherUserIsRefused) {
  if (::geteuid() != 0) GTEST_SKIP() << "only root can make a file of another user";
  for (std::size_t which = 0; which < 3; ++which) {
    std::vector<UniqueFd> held = hold_through_crash("odometry");
    ASSERT_EQ(::fchown(held[which].get(), 65534, 65534), 0);
    EXPECT_EQ(refusal("odometry", held), "no_permission");
  }
}

TEST_F(Offer, OfARingOfWrongGeometryIsRefused) {
  std::vector<UniqueFd> held = hold_through_crash("odometry");
  held[0] = memory_file(1 << 16, kSizeSeals);
  EXPECT_EQ(refusal("odometry", held), "protocol") << "no header";
  held = hold_through_crash("odometry");
  const auto mapping = ring::RingMapping::open_untrusted(held[0].get(), ring::Access::read_write);
  (*mapping)->header().depth *= 2;
  EXPECT_EQ(refusal("odometry", held), "protocol") << "a header that lies";
}

TEST_F(Offer, UnderAnotherNameIsRefused) {
  const std::vector<UniqueFd> held = hold_through_crash("odometry");
  EXPECT_EQ(refusal("lidar", held), "protocol");
}

TEST_F(Offer, OfWhatAreNoMemoryFilesIsRefused) {
  std::vector<UniqueFd> held;
  for (int i = 0; i < 3; ++i) held.emplace_back(::open("/dev/zero", O_RDWR | O_CLOEXEC));
  {
    RawClient client(daemon_.socket_path());
    client.send(offer_request("odometry", true), numbers(held));
    EXPECT_EQ(client.receive().response.failure().code(), "protocol");
    EXPECT_TRUE(client.receive().ended);
  }
  held.clear();
  for (int i = 0; i < 3; ++i) held.emplace_back(::eventfd(0, EFD_CLOEXEC));
  EXPECT_EQ(refusal("odometry", held), "protocol");
  held.pop_back();
  EXPECT_EQ(refusal("odometry", held), "protocol") << "two descriptors are not three";
  held.clear();
  EXPECT_EQ(refusal("odometry", held), "protocol");
}

TEST_F(Offer, OfARemovedStreamIsRefused) {
  std::vector<UniqueFd> held;
  {
    RawClient client(daemon_.socket_path());
    held = client.ask(create_request("odometry")).descriptors;
    local::Request remove;
    remove.mutable_remove()->mutable_id()->set_name("odometry");
    ASSERT_TRUE(client.ask(remove).response.has_done());
  }
  EXPECT_EQ(refusal("odometry", held), "not_found");
  daemon_.kill_hard();
  daemon_.start();
  EXPECT_EQ(refusal("odometry", held), "not_found");
}

}  // namespace
}  // namespace dssm::test
