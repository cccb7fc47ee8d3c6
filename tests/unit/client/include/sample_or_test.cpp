// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include <dssm/sample_or.hpp>

namespace dssm {
namespace {

using namespace std::chrono_literals;

TEST(SampleOr, HoldsWhatTheReadStored) {
  SampleOr<int> sample([](Sample<int>& out) {
    out = {42, {7, time_from_ns(5), 3ns, sizeof(int)}};
    return ReadStatus::ok;
  });
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample.status(), ReadStatus::ok);
  EXPECT_EQ(sample->value, 42);
  EXPECT_EQ(sample->tid(), 7);
  EXPECT_EQ(sample->time(), time_from_ns(5));
  EXPECT_EQ(sample->clock_error(), 3ns);
  sample->value = 43;
  EXPECT_EQ((*sample).value, 43);
}

TEST(SampleOr, HoldsTheStatusWithoutASample) {
  for (const ReadStatus status : {ReadStatus::not_yet, ReadStatus::too_old, ReadStatus::lapped,
                                  ReadStatus::restarted, ReadStatus::clock_out_of_bounds,
                                  ReadStatus::arriving, ReadStatus::lost, ReadStatus::stale}) {
    const SampleOr<int> none([&](Sample<int>&) { return status; });
    EXPECT_FALSE(none) << name_of(status);
    EXPECT_EQ(none.status(), status);
  }
}

TEST(SampleOr, IsReadWhereTheCallerHasIt) {
  const void* read_to = nullptr;
  const auto read = [&] {
    return SampleOr<int>([&](Sample<int>& out) {
      read_to = &out;
      return ReadStatus::ok;
    });
  };
  const SampleOr<int> sample = read();
  EXPECT_EQ(read_to, &*sample) << "it was copied";
}

}  // namespace
}  // namespace dssm
