// SPDX-License-Identifier: Apache-2.0
//
// Streams by name: creating, joining, limits, figures, properties, and taking streams back after a
// restart, which here is a second Registry.
#include "daemon/streams/registry.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstring>
#include <ctime>
#include <optional>

#include "core/base/sealed_memory.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_writer.hpp"
#include "tests/support/sanitized.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

const StreamId kOdometry{"odometry", 0, ""};

std::shared_ptr<Stream> create(Registry& registry, const StreamId& id = kOdometry) {
  Result<OpenedRing> created = registry.create(id, odometry_type(), kHistory, 42);
  EXPECT_TRUE(created) << created.error().message;
  return created ? created->stream : nullptr;
}

OfferedFiles kept_by(Role role, Stream& stream) {
  Result<std::vector<UniqueFd>> descriptors = stream.descriptors_for(role);
  EXPECT_TRUE(descriptors) << descriptors.error().message;
  return as_offer(*std::move(descriptors));
}

Errc code_of(const Result<std::shared_ptr<Stream>>& result) {
  return result ? Errc::closed : result.error().code;
}

// --- creating

TEST(Registry, CreatesAStreamOnceAndJoinsItAfterwards) {
  Registry registry("pc1", kLimits);
  const Result<OpenedRing> first = registry.create(kOdometry, odometry_type(), kHistory, 42);
  ASSERT_TRUE(first) << first.error().message;
  EXPECT_TRUE(first->created);
  EXPECT_EQ(first->stream->id().str(), "odometry:0@pc1");
  const Result<OpenedRing> second = registry.create(kOdometry, odometry_type(), kHistory, 43);
  ASSERT_TRUE(second);
  EXPECT_FALSE(second->created);
  EXPECT_EQ(second->stream, first->stream);
  EXPECT_EQ(second->stream->creator_pid(), 42);
  EXPECT_EQ(registry.streams().size(), 1u);
}

TEST(Registry, RefusesToJoinWithAnotherSizeOrType) {
  Registry registry("pc1", kLimits);
  create(registry);
  TypeInfo larger = odometry_type();
  larger.payload_bytes = 32;
  TypeInfo renamed = odometry_type();
  renamed.name = "Pose";
  TypeInfo nameless{"", 24, 8, {}};
  EXPECT_EQ(registry.create(kOdometry, larger, kHistory, 1).error().code, Errc::type_mismatch);
  const Result<OpenedRing> other = registry.create(kOdometry, renamed, kHistory, 1);
  EXPECT_EQ(other.error().code, Errc::type_mismatch);
  EXPECT_NE(other.error().message.find("'Odometry'"), std::string::npos);
  EXPECT_NE(other.error().message.find("'Pose'"), std::string::npos);
  EXPECT_TRUE(registry.create(kOdometry, nameless, kHistory, 1));
}

TEST(Registry, DistinguishesStreamsByNameAndId) {
  Registry registry("pc1", kLimits);
  const auto zero = create(registry, {"lidar", 0, ""});
  const auto one = create(registry, {"lidar", 1, "pc1"});
  EXPECT_NE(zero, one);
  EXPECT_EQ(*registry.find({"lidar", 1, ""}), one);
  EXPECT_EQ(*registry.find({"lidar", 0, "pc1"}), zero);
  EXPECT_FALSE(registry.find({"lidar", 2, ""}));
}

TEST(Registry, AnswersOnlyForItsOwnHost) {
  Registry registry("pc1", kLimits);
  create(registry);
  const auto elsewhere = registry.find({"odometry", 0, "pc2"});
  ASSERT_FALSE(elsewhere);
  EXPECT_EQ(elsewhere.error().code, Errc::not_found);
  EXPECT_NE(elsewhere.error().message.find("'pc2'"), std::string::npos);
  EXPECT_FALSE(registry.create({"x", 0, "pc2"}, odometry_type(), kHistory, 1));
}

TEST(Registry, RefusesANameThatIsTooLongWithTheHost) {
  const std::string host(31, 'h');
  Registry registry(host, kLimits);
  EXPECT_TRUE(registry.create({std::string(29, 'n'), 0, ""}, odometry_type(), kHistory, 1))
      << "29 + 2 + 1 + 31 = 63 bytes";
  const auto created = registry.create({std::string(30, 'n'), 0, ""}, odometry_type(), kHistory, 1);
  ASSERT_FALSE(created);
  EXPECT_NE(created.error().message.find("at most 63"), std::string::npos);
}

TEST(Registry, RefusesDepthsAndCyclesThatCannotBe) {
  Registry registry("pc1", kLimits);
  const auto code = [&](const History& history) {
    return registry.create(kOdometry, odometry_type(), history, 1).error().code;
  };
  EXPECT_EQ(code({16, Duration::zero()}), Errc::invalid_argument);
  EXPECT_EQ(code({16, Duration(-1)}), Errc::invalid_argument);
  EXPECT_NE(code({0, Duration(1)}), Errc::closed);
  EXPECT_NE(code({1, Duration(1)}), Errc::closed);
  EXPECT_NE(code({kMaxDepth + 1, Duration(1)}), Errc::closed);
  EXPECT_TRUE(registry.streams().empty());
}

TEST(Registry, TakesTheDescriptionThatAStreamHasNot) {
  Registry registry("pc1", kLimits);
  const TypeInfo plain{"", odometry_type().payload_bytes, 1, {}};
  const auto stream = registry.create(kOdometry, plain, kHistory, 42)->stream;
  const std::uint64_t before = registry.budget().used();
  TypeInfo too_long = odometry_type();
  too_long.fields[0].name = std::string(kMaxTypeBytes, 'x');
  EXPECT_EQ(registry.create(kOdometry, too_long, kHistory, 43).error().code, Errc::limit_exceeded);
  EXPECT_EQ(stream->type(), plain);

  ASSERT_TRUE(registry.create(kOdometry, odometry_type(), kHistory, 43));
  EXPECT_EQ(stream->type(), odometry_type());
  EXPECT_GT(registry.budget().used(), before);
  ASSERT_TRUE(registry.create(kOdometry, plain, kHistory, 44));
  EXPECT_EQ(stream->type(), odometry_type());

  Registry next("pc1", kLimits);  // after a restart
  const auto again = next.adopt_untrusted(kOdometry, kept_by(Role::reader, *stream));
  ASSERT_TRUE(again) << again.error().message;
  EXPECT_EQ((*again)->type(), odometry_type());
}

TEST(Registry, RefusesATypeWhoseDescriptionIsTooLong) {
  Registry registry("pc1", kLimits);
  TypeInfo type = odometry_type();
  type.fields[0].name = std::string(kMaxTypeBytes, 'x');
  const auto created = registry.create(kOdometry, type, kHistory, 1);
  ASSERT_FALSE(created);
  EXPECT_EQ(created.error().code, Errc::limit_exceeded);
}

// --- limits

TEST(Registry, NamesTheLimitOnStreams) {
  Registry registry("pc1", {.max_streams = 2, .max_memory_bytes = 1 << 30});
  create(registry, {"a", 0, ""});
  create(registry, {"b", 0, ""});
  const auto third = registry.create({"c", 0, ""}, odometry_type(), kHistory, 1);
  ASSERT_FALSE(third);
  EXPECT_EQ(third.error().code, Errc::limit_exceeded);
  EXPECT_NE(third.error().message.find("max_streams = 2"), std::string::npos);
  EXPECT_TRUE(registry.create({"b", 0, ""}, odometry_type(), kHistory, 1))
      << "joining needs no room";
}

TEST(Registry, NamesTheLimitOnMemoryAndGivesMemoryBack) {
  Registry registry("pc1", {.max_streams = 10, .max_memory_bytes = 1 << 20});
  const TypeInfo large{"", 600 << 10, 1, {}};
  const auto refused = registry.create(kOdometry, large, {2, Duration(1)}, 1);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::limit_exceeded);
  EXPECT_NE(refused.error().message.find("max_memory = 1048576"), std::string::npos);
  EXPECT_EQ(registry.budget().used(), 0u);

  const TypeInfo medium{"", 200 << 10, 1, {}};
  std::shared_ptr<Stream> held = registry.create(kOdometry, medium, {3, Duration(1)}, 1)->stream;
  ASSERT_TRUE(registry.remove(kOdometry));
  EXPECT_FALSE(registry.create(kOdometry, medium, {3, Duration(1)}, 1))
      << "a removed ring that somebody holds still takes its memory";
  held.reset();
  EXPECT_EQ(registry.budget().used(), 0u);
  EXPECT_TRUE(registry.create(kOdometry, medium, {3, Duration(1)}, 1));
}

TEST(Registry, LeavesNoDescriptorBehind) {
  const auto count = [] {
    int open = 0;
    for (int fd = 0; fd < 256; ++fd) open += ::fcntl(fd, F_GETFD) >= 0;
    return open;
  };
  Registry registry("pc1", kLimits);
  const int before = count();
  const auto stream = create(registry);
  EXPECT_EQ(count(), before + 3) << "ring, bell, meta";
  ASSERT_TRUE(stream->descriptors_for(Role::writer, 7));
  ASSERT_TRUE(stream->descriptors_for(Role::writer, 7));
  ASSERT_TRUE(stream->descriptors_for(Role::reader, 7));
  EXPECT_EQ(count(), before + 4) << "and the client's doorbell";
  static_cast<void>(registry.create({"too large", 0, ""}, {"", 64 << 20, 1, {}}, kHistory, 1));
  EXPECT_EQ(count(), before + 4);
  stream->remove_doorbell(7);
  EXPECT_EQ(count(), before + 3);
}

// Half a gigabyte: the thread that closes the last descriptor frees it.
TEST(Stream, LetsAThreadFreeALongRing) {
  if (test::kIsSanitized) GTEST_SKIP() << "a sanitizer takes longer to begin a thread";
  Registry registry("pc1", {10, 4ULL << 30, 1 << 20});
  const auto time_of = [](auto work) {  // of this thread's processor
    timespec begin, end;
    ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &begin);
    work();
    ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &end);
    return (end.tv_sec - begin.tv_sec) * 1'000'000'000 + end.tv_nsec - begin.tv_nsec;
  };
  auto stream =
      registry
          .create({"camera", 0, ""}, {"", 1 << 20, 1, {}}, {512, std::chrono::milliseconds(10)}, 1)
          ->stream;
  const std::uint64_t bytes = stream->info().memory_bytes;
  UniqueFd same = create_sealed_memory("test-long", bytes, 0600).value();
  ASSERT_EQ(::posix_fallocate(same.get(), 0, static_cast<off_t>(bytes)), 0);
  const long freeing = time_of([&] { same.reset(); });
  ASSERT_TRUE(stream->reserve(0, bytes));
  ASSERT_TRUE(registry.remove({"camera", 0, ""}));
  EXPECT_LT(time_of([&] { stream.reset(); }), freeing / 2);
}

// --- what is handed out

TEST(Stream, HandsOutARingThatReadersCannotMapWritable) {
  Registry registry("pc1", kLimits);
  const auto stream = create(registry);
  const OfferedFiles for_reader = kept_by(Role::reader, *stream);
  EXPECT_FALSE(for_reader.doorbell) << "the doorbell is for writers";
  EXPECT_EQ(::mmap(nullptr, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, for_reader.ring.get(), 0),
            MAP_FAILED);
  EXPECT_EQ(::mmap(nullptr, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, for_reader.meta.get(), 0),
            MAP_FAILED);
  const OfferedFiles for_writer = kept_by(Role::writer, *stream);
  EXPECT_TRUE(for_writer.doorbell);
  EXPECT_TRUE(ring::RingMapping::open_untrusted(for_writer.ring.get(), ring::Access::read_write));
  EXPECT_TRUE(ring::Bell::open_untrusted(for_reader.bell.get()));
}

TEST(Stream, ReadsNewestOldestAndRateFromTheRing) {
  Registry registry("pc1", kLimits);
  const auto stream = create(registry);
  EXPECT_EQ(stream->info().newest, kNoTid);
  EXPECT_EQ(stream->info().rate_hz, 0);
  const OfferedFiles files = kept_by(Role::writer, *stream);
  const auto mapping =
      ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write);
  const auto bell = ring::Bell::open_untrusted(files.bell.get());
  ring::RingWriter writer(**mapping, **bell, -1);
  const std::vector<std::byte> payload(24);
  for (int i = 0; i < 40; ++i) {
    writer.write(payload, time_from_ns(1'000'000'000LL + i * 20'000'000LL), Duration::zero());
  }
  const StreamInfo info = stream->info();
  EXPECT_EQ(info.newest, 39);
  EXPECT_EQ(info.oldest, 39 - 16 + 2);
  EXPECT_EQ(to_ns(info.newest_time), 1'000'000'000LL + 39 * 20'000'000LL);
  EXPECT_NEAR(info.rate_hz, 50, 1e-6);
  EXPECT_EQ(info.depth, 16u);
  EXPECT_EQ(info.cycle, std::chrono::milliseconds(10));
  EXPECT_EQ(info.creator_pid, 42);
  const Time last = info.newest_time;
  EXPECT_EQ(stream->info(true, last).state, StreamState::live);
  EXPECT_EQ(stream->info(true, last + std::chrono::seconds(9)).state, StreamState::stalled);
  EXPECT_EQ(stream->info(true, last + std::chrono::seconds(9)).age, std::chrono::seconds(9));
}

TEST(Stream, AsksNoMirrorWhetherItsOwnerWrites) {
  MemoryBudgets budgets(1 << 30, {});
  Stream::Plan plan;
  plan.id = {"odometry", 0, "pc2"};
  plan.type = odometry_type();
  plan.depth = 16;
  plan.cycle = std::chrono::milliseconds(10);
  plan.purpose = Purpose::mirror;
  EXPECT_EQ(Stream::create(plan, budgets).value()->info().state, StreamState::unknown);
}

TEST(Stream, SurvivesNonsenseInARingItDoesNotTrust) {
  Registry registry("pc1", kLimits);
  const auto stream = create(registry);
  const OfferedFiles files = kept_by(Role::writer, *stream);
  const auto mapping =
      ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write);
  for (const std::int64_t top : {INT64_MAX, INT64_MIN, INT64_C(-2), INT64_C(1) << 62}) {
    (*mapping)->header().top.store(top);
    const StreamInfo info = stream->info();
    EXPECT_GE(info.newest, kNoTid);
    EXPECT_LE(info.oldest, info.newest);
    EXPECT_EQ(info.rate_hz, 0);
  }
}

TEST(Registry, LeavesStreamsToOthersThanTheAccountWithMany) {
  Registry registry("pc1", {.max_streams = 4, .max_memory_bytes = 1 << 30, .max_share = {50}});
  const std::string user = "user 1000";
  std::optional<RingQuota> mirror = registry.acquire_quota(user).value();
  ASSERT_TRUE(registry.create({"a", 0, ""}, odometry_type(), kHistory, 1, user));
  const auto third = registry.create({"b", 0, ""}, odometry_type(), kHistory, 1, user);
  ASSERT_FALSE(third);
  EXPECT_EQ(third.error().code, Errc::limit_exceeded);
  EXPECT_NE(third.error().message.find(
                "user 1000 has 2 streams already, counting those of other hosts; remove some "
                "(dssmctl rm) or raise the key max_share: it may have 50% of max_streams = 4"),
            std::string::npos)
      << third.error().message;
  EXPECT_FALSE(registry.acquire_quota(user));
  LimitUses limits;
  registry.add_limits(limits);
  EXPECT_EQ(limits.at(1).name, "max_streams of one user or host");
  EXPECT_EQ(limits.at(1).used, 2U);
  EXPECT_EQ(limits.at(1).limit, 2U);
  EXPECT_TRUE(registry.create({"b", 0, ""}, odometry_type(), kHistory, 1, "user 1001"));
  EXPECT_TRUE(registry.create({"c", 0, ""}, odometry_type(), kHistory, 1)) << "no limit of its own";
  EXPECT_FALSE(registry.create({"d", 0, ""}, odometry_type(), kHistory, 1)) << "all are taken";
  ASSERT_TRUE(registry.remove({"c", 0, ""}));
  ASSERT_TRUE(registry.remove({"a", 0, ""}));
  EXPECT_TRUE(registry.create({"d", 0, ""}, odometry_type(), kHistory, 1, user));
  mirror.reset();
  EXPECT_TRUE(registry.acquire_quota(user));
}

TEST(Registry, LeavesMemoryToOthersThanTheAccountWithMuch) {
  Registry registry("pc1", {.max_streams = 10,
                            .max_memory_bytes = 1 << 20,
                            .max_property_bytes = 1 << 20,
                            .max_share = {50}});
  const TypeInfo type{"", 100 << 10, 1, {}};
  const History history{3, Duration(1)};
  std::shared_ptr<Stream> held =
      registry.create({"a", 0, ""}, type, history, 1, "user 1000")->stream;
  const auto second = registry.create({"b", 0, ""}, type, history, 1, "user 1000");
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, Errc::limit_exceeded);
  EXPECT_NE(second.error().message.find("are left of the 524288 that user 1000 may take of "
                                        "max_memory"),
            std::string::npos)
      << second.error().message;
  EXPECT_NE(second.error().message.find("max_share"), std::string::npos);
  LimitUses limits;
  registry.add_limits(limits);
  EXPECT_EQ(limits.at(3).name, "max_memory of one user or host");
  EXPECT_EQ(limits.at(3).used, registry.budget().used());
  EXPECT_EQ(limits.at(3).limit, 1U << 19);
  EXPECT_TRUE(registry.create({"b", 0, ""}, type, history, 1, "user 1001"));
  const auto third = registry.create({"c", 0, ""}, type, {4, Duration(1)}, 1, "user 1002");
  ASSERT_FALSE(third);
  EXPECT_NE(third.error().message.find("max_memory = 1048576"), std::string::npos)
      << third.error().message;
  ASSERT_TRUE(registry.remove({"a", 0, ""}));
  EXPECT_FALSE(registry.create({"c", 0, ""}, type, history, 1, "user 1000")) << "held";
  held.reset();
  EXPECT_TRUE(registry.create({"c", 0, ""}, type, history, 1, "user 1000"));
}

TEST(Registry, ChargesAPropertyToTheAccountThatSetsIt) {
  Registry registry("pc1", {.max_streams = 10,
                            .max_memory_bytes = 1 << 20,
                            .max_property_bytes = 1 << 20,
                            .max_share = {50}});
  create(registry);
  ASSERT_TRUE(registry.set_property(kOdometry, std::string(300'000, 'x'), "user 1000"));
  EXPECT_EQ(registry.budgets().most_used(), 300'000U);
  EXPECT_FALSE(registry.set_property(kOdometry, std::string(300'000, 'y'), "user 1000"))
      << "both exist for a moment";
  ASSERT_TRUE(registry.set_property(kOdometry, "", "user 1000"));
  EXPECT_EQ(registry.budgets().most_used(), 0U);
  ASSERT_TRUE(registry.set_property(kOdometry, "one", "user 1001")) << "the other one is forgotten";
  EXPECT_EQ(registry.budgets().most_used(), 3U);
}

// --- descriptions

TEST(Registry, DescribesAStreamOnRequestButKeepsWhatItsProgramsSay) {
  Registry registry("pc1", kLimits);
  ASSERT_TRUE(registry.create(kOdometry, {"", 8, 1, {}}, {10, Duration(1'000'000)}, 1));
  struct Described final : StreamObserver {
    int times = 0;
    void on_stream_added(const Stream&) override {}
    void on_stream_removed(const Stream&) override {}
    void on_stream_described(const Stream&) override { ++times; }
  } observer;
  registry.add_observer(observer);
  const TypeInfo pose{
      "Pose", 8, 4, {{"x", Scalar::float32, 0}, {"flags", Scalar::uint8, 4, 1, 1, 3, 2}}};
  const TypeInfo twist{"Twist", 8, 8, {{"v", Scalar::float64, 0}}};
  const TypeInfo longer{"Pose", 16, 8, {{"x", Scalar::float64, 0}}};
  EXPECT_EQ(registry.describe(kOdometry, longer, true).error().code, Errc::type_mismatch);
  ASSERT_TRUE(registry.describe(kOdometry, pose, false));
  EXPECT_EQ((*registry.find(kOdometry))->type(), pose);
  EXPECT_EQ(observer.times, 1);

  EXPECT_EQ(registry.describe(kOdometry, twist, false).error().code, Errc::type_mismatch);
  EXPECT_EQ((*registry.find(kOdometry))->type(), pose);
  ASSERT_TRUE(registry.describe(kOdometry, twist, true));
  EXPECT_EQ((*registry.find(kOdometry))->type(), twist);
  EXPECT_EQ((*registry.find(kOdometry))->info().type, twist);
  EXPECT_TRUE(registry.describe(kOdometry, twist, false)) << "nothing to do";
  EXPECT_EQ(observer.times, 2);
  EXPECT_EQ(registry.describe({"other", 0, ""}, pose, false).error().code, Errc::not_found);
  registry.remove_observer(observer);
}

// --- property

TEST(Registry, KeepsThePropertyOfAStreamAndChargesItsMemory) {
  Registry registry("pc1", kLimits);
  const auto stream = create(registry);
  const std::uint64_t before = registry.budget().used();
  ASSERT_TRUE(registry.set_property(kOdometry, "mounted upside down"));
  EXPECT_EQ(*stream->property(), "mounted upside down");
  EXPECT_EQ(stream->info().property_bytes, 19u);
  EXPECT_EQ(registry.budget().used(), before + 19);
  ASSERT_TRUE(registry.set_property(kOdometry, ""));
  EXPECT_EQ(*stream->property(), "");
  EXPECT_EQ(registry.budget().used(), before);
  const Result<void> refused = registry.set_property(kOdometry, std::string((1 << 20) + 1, 'x'));
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("max_property = 1048576"), std::string::npos);
  EXPECT_EQ(registry.set_property({"other", 0, ""}, "x").error().code, Errc::not_found);
}

// --- taking streams back

class Adoption : public testing::Test {
 protected:
  // What a client holds after its dssmd died.
  OfferedFiles held(Role role, const StreamId& id = kOdometry) {
    Registry before("pc1", kLimits);
    const auto stream = create(before, id);
    EXPECT_TRUE(before.set_property(id, "kept"));
    return kept_by(role, *stream);
  }
  Errc error_of(OfferedFiles files) {
    return code_of(registry_.adopt_untrusted(kOdometry, std::move(files)));
  }
  static UniqueFd memory_file(int seals = F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL) {
    UniqueFd fd(::memfd_create("forged", MFD_CLOEXEC | MFD_ALLOW_SEALING));
    EXPECT_EQ(::ftruncate(fd.get(), 65536), 0);
    EXPECT_EQ(::fcntl(fd.get(), F_ADD_SEALS, seals), 0);
    return fd;
  }
  Registry registry_{"pc1", kLimits};
};

TEST_F(Adoption, BringsAStreamBackWithAllThatWasKnownOfIt) {
  const auto stream = registry_.adopt_untrusted(kOdometry, held(Role::reader));
  ASSERT_TRUE(stream) << stream.error().message;
  EXPECT_EQ((*stream)->type(), odometry_type());
  EXPECT_EQ((*stream)->creator_pid(), 42);
  EXPECT_EQ((*stream)->info().depth, 16u);
  EXPECT_EQ(*(*stream)->property(), "kept");
  EXPECT_EQ(*registry_.find(kOdometry), *stream);
  // From a reader's read-only descriptors a writer gets what it needs, doorbell included.
  const OfferedFiles for_writer = kept_by(Role::writer, **stream);
  EXPECT_TRUE(for_writer.doorbell);
  EXPECT_TRUE(ring::RingMapping::open_untrusted(for_writer.ring.get(), ring::Access::read_write));
  EXPECT_TRUE(registry_.set_property(kOdometry, "newer"));
}

TEST_F(Adoption, ChargesTheAccountThatCreatedTheStream) {
  OfferedFiles files;
  {
    Registry before("pc1", kLimits);
    files = kept_by(Role::reader,
                    *before.create(kOdometry, odometry_type(), kHistory, 42, "user 1000")->stream);
  }
  const auto stream = registry_.adopt_untrusted(kOdometry, std::move(files));
  ASSERT_TRUE(stream) << stream.error().message;
  EXPECT_EQ((*stream)->account(), "user 1000");
  EXPECT_EQ(registry_.budgets().most_used(), registry_.budget().used());
  LimitUses limits;
  registry_.add_limits(limits);
  EXPECT_EQ(limits.at(1).used, 1U);
}

TEST_F(Adoption, RefusesABellOrAMetaFileOfAnotherStream) {
  for (UniqueFd OfferedFiles::*const file : {&OfferedFiles::bell, &OfferedFiles::meta}) {
    OfferedFiles files = held(Role::writer), same_name = held(Role::writer);
    files.*file = std::move(same_name.*file);
    EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
  }
}

// Who may write to a ring could take the name of a stream that it may only read.
TEST_F(Adoption, RefusesARingThatClaimsToBeAnother) {
  OfferedFiles files = held(Role::writer, {"other", 0, ""});
  OfferedFiles wanted = held(Role::reader);
  const auto own =
      ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write).value();
  const auto other =
      ring::RingMapping::open_untrusted(wanted.ring.get(), ring::Access::read_only).value();
  std::memcpy(own->base(), other->base(), offsetof(ring::RingHeader, doorbell_armed));
  files.bell = std::move(wanted.bell), files.meta = std::move(wanted.meta);
  EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
}

TEST_F(Adoption, OnlyNotesTheSecondOfferOfTheSameRing) {
  OfferedFiles one = held(Role::reader), two;
  two.ring = copy_of(one.ring), two.bell = copy_of(one.bell), two.meta = copy_of(one.meta);
  const auto first = registry_.adopt_untrusted(kOdometry, std::move(one));
  const auto second = registry_.adopt_untrusted(kOdometry, std::move(two));
  ASSERT_TRUE(first && second);
  EXPECT_EQ(*first, *second);
  EXPECT_EQ(registry_.streams().size(), 1u);
}

TEST_F(Adoption, RefusesAnotherRingOfATakenName) {
  create(registry_);
  EXPECT_EQ(error_of(held(Role::writer)), Errc::conflict);
}

TEST_F(Adoption, TakesTheDoorbellThatAWriterKeptButNothingElseForOne) {
  OfferedFiles files = held(Role::writer);
  const std::uint64_t rung = 5;
  ASSERT_EQ(::write(files.doorbell.get(), &rung, sizeof rung), ssize_t{sizeof rung});
  const auto stream = registry_.adopt_untrusted(kOdometry, std::move(files));
  ASSERT_TRUE(stream);
  std::uint64_t read = 0;
  const OfferedFiles again = kept_by(Role::writer, **stream);
  ASSERT_EQ(::read(again.doorbell.get(), &read, sizeof read), ssize_t{sizeof read});
  EXPECT_EQ(read, 5u) << "the same eventfd as before";

  OfferedFiles wrong = held(Role::writer, {"other", 0, ""});
  wrong.doorbell.reset(::open("/dev/null", O_RDWR | O_CLOEXEC));
  const auto other = registry_.adopt_untrusted({"other", 0, ""}, std::move(wrong));
  ASSERT_TRUE(other);
  const OfferedFiles fresh = kept_by(Role::writer, **other);
  EXPECT_EQ(kind_of_untrusted(fresh.doorbell.get()), DescriptorKind::doorbell) << "a new one";
}

TEST_F(Adoption, KeepsTheOrderOfCreation) {
  std::vector<OfferedFiles> kept;
  const std::vector<StreamId> ids = {{"a", 0, ""}, {"b", 0, ""}, {"c", 0, ""}};
  {
    Registry before("pc1", kLimits);
    for (const StreamId& id : ids) kept.push_back(kept_by(Role::reader, *create(before, id)));
  }
  for (const std::size_t i : {2, 0, 1}) {
    ASSERT_TRUE(registry_.adopt_untrusted(ids[i], std::move(kept[i])));
  }
  create(registry_, {"d", 0, ""});
  std::string order;
  for (const auto& stream : registry_.streams()) order += stream->id().name;
  EXPECT_EQ(order, "abcd");
}

TEST_F(Adoption, HoldsToTheLimits) {
  Registry full("pc1", {.max_streams = 1, .max_memory_bytes = 1 << 30});
  create(full, {"first", 0, ""});
  EXPECT_EQ(code_of(full.adopt_untrusted(kOdometry, held(Role::reader))), Errc::limit_exceeded);
  Registry small("pc1", {.max_streams = 9, .max_memory_bytes = 4096});
  EXPECT_EQ(code_of(small.adopt_untrusted(kOdometry, held(Role::reader))), Errc::limit_exceeded);
  EXPECT_EQ(small.budget().used(), 0u);
}

TEST_F(Adoption, DoesNotBringBackWhatWasRemoved) {
  OfferedFiles files;
  {
    Registry before("pc1", kLimits);
    files = kept_by(Role::writer, *create(before));
    ASSERT_TRUE(before.remove(kOdometry));
  }
  EXPECT_EQ(error_of(std::move(files)), Errc::not_found);
}

TEST_F(Adoption, RefusesFilesOfAnotherUser) {
  if (::geteuid() != 0) GTEST_SKIP() << "only root can make a file of another user";
  for (UniqueFd OfferedFiles::*file :
       {&OfferedFiles::ring, &OfferedFiles::bell, &OfferedFiles::meta}) {
    OfferedFiles files = held(Role::writer);
    ASSERT_EQ(::fchown((files.*file).get(), 65534, 65534), 0);
    EXPECT_EQ(error_of(std::move(files)), Errc::no_permission);
  }
}

TEST_F(Adoption, RefusesFilesThatAreNotSealedOrNoMemoryFiles) {
  for (UniqueFd OfferedFiles::*file :
       {&OfferedFiles::ring, &OfferedFiles::bell, &OfferedFiles::meta}) {
    OfferedFiles files = held(Role::writer);
    files.*file = memory_file(0);
    EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
    files = held(Role::writer);
    (files.*file).reset(::open("/dev/null", O_RDWR | O_CLOEXEC));
    EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
    files = held(Role::writer);
    files.*file = memory_file();  // sealed, but empty
    EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
  }
}

TEST_F(Adoption, RefusesARingOfAnotherGeometryThanInItsMetaFile) {
  OfferedFiles files = held(Role::writer);
  Registry before("pc1", kLimits);
  TypeInfo larger = odometry_type();
  larger.payload_bytes = 32;
  const auto stream = before.create(kOdometry, larger, kHistory, 1)->stream;
  files.ring = std::move(kept_by(Role::writer, *stream).ring);
  EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
}

TEST_F(Adoption, RefusesARingUnderAnotherName) {
  EXPECT_EQ(error_of(held(Role::writer, {"lidar", 0, ""})), Errc::protocol);
  EXPECT_EQ(error_of(held(Role::writer, {"odometry", 1, ""})), Errc::protocol);
  EXPECT_TRUE(registry_.streams().empty());
}

TEST_F(Adoption, RefusesAStreamOfAnotherHost) {
  Registry other("pc2", kLimits);
  EXPECT_EQ(code_of(other.adopt_untrusted(kOdometry, held(Role::reader))), Errc::protocol);
}

TEST_F(Adoption, RefusesARingWhoseHeaderWasRewritten) {
  OfferedFiles files = held(Role::writer);
  const auto mapping =
      ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write);
  (*mapping)->header().depth = 1 << 20;
  EXPECT_EQ(error_of(std::move(files)), Errc::protocol);
}

// --- removing and watching

TEST(Registry, FreesTheNameOfARemovedStreamAndLeavesItsHoldersAlone) {
  Registry registry("pc1", kLimits);
  const auto removed = create(registry);
  ASSERT_TRUE(registry.remove(kOdometry));
  EXPECT_FALSE(registry.find(kOdometry));
  EXPECT_TRUE(removed->removed());
  EXPECT_EQ(registry.remove(kOdometry).error().code, Errc::not_found);
  const auto next = create(registry);
  EXPECT_NE(next, removed);
  EXPECT_NE(next->info().incarnation, removed->info().incarnation);
}

TEST(Registry, NotifiesItsObserversOfAdditionsAndRemovals) {
  struct Recorder final : StreamObserver {
    void on_stream_added(const Stream& stream) override { text += "+" + stream.id().name; }
    void on_stream_removed(const Stream& stream) override { text += "-" + stream.id().name; }
    void on_stream_described(const Stream& stream) override { text += "=" + stream.id().name; }
    std::string text;
  } recorder, other;
  Registry registry("pc1", kLimits);
  registry.add_observer(recorder);
  registry.add_observer(other);
  create(registry, {"a", 0, ""});
  create(registry, {"a", 0, ""});
  ASSERT_TRUE(registry.create({"b", 0, ""}, {"", 24, 8, {}}, kHistory, 42));
  create(registry, {"b", 0, ""});
  registry.remove_observer(other);
  ASSERT_TRUE(registry.remove({"a", 0, ""}));
  EXPECT_EQ(recorder.text, "+a+b=b-a");
  EXPECT_EQ(other.text, "+a+b=b");
}

// A program that may write a stream can write into its header, too.
TEST(Registry, OpensNoRingForWritingWhoseSizeAProgramHasOverwritten) {
  Registry registry("pc1", kLimits);
  const std::shared_ptr<Stream> stream =
      registry.create({"lidar", 0, ""}, {"Scan", 4000, 8, {}}, {2, std::chrono::milliseconds(1)}, 1)
          .value()
          .stream;
  const auto of_program = stream->map_for_writing().value();
  const ring::Geometry right = stream->mapping().geometry();
  // Small slots, many of them: a file of the same length.
  Result<ring::Geometry> wrong = ring::Geometry::of(1, 2);
  while (wrong->total_bytes < right.total_bytes) wrong = ring::Geometry::of(1, wrong->depth + 1);
  ASSERT_EQ(wrong->total_bytes, right.total_bytes);
  ring::RingHeader& header = of_program->header();
  header.payload_bytes = wrong->payload_bytes;
  header.depth = wrong->depth;
  header.slot_bytes = wrong->slot_bytes;
  header.times_offset = wrong->times_offset;
  header.slots_offset = wrong->slots_offset;
  const auto opened = stream->map_for_writing();
  ASSERT_FALSE(opened);
  EXPECT_EQ(opened.error().code, Errc::protocol);
  EXPECT_NE(opened.error().message.find("'lidar:0@pc1': a program has overwritten"),
            std::string::npos)
      << opened.error().message;
}

}  // namespace
}  // namespace dssm::daemon
