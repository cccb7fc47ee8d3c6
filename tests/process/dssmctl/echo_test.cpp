// SPDX-License-Identifier: Apache-2.0
//
// dssmctl echo.
#include <signal.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

struct Inner {
  std::int32_t a;
  std::uint8_t b[2];
};
DSSM_DESCRIBE(Inner, a, b)

struct Sample {
  std::int64_t number;
  double value;
  Inner inner;
  Inner row[2];
  char text[8];
};
DSSM_DESCRIBE(Sample, number, value, inner, row, text)

class Echo : public CtlTest {
 protected:
  // Sample i has number i and the time 100 + i seconds.
  void write(int i) {
    Sample sample{};
    sample.number = i;
    sample.value = i / 2.0;
    sample.inner = {-i, {1, 2}};
    sample.row[0] = {10, {11, 12}};
    sample.row[1] = {20, {21, 22}};
    std::strcpy(sample.text, "a,\"b\"");
    writer_.write(sample, at_ns((100 + i) * kSecond), Duration(i * 1000));
  }
  void write(int first, int last) {
    for (int i = first; i <= last; ++i) write(i);
  }
  std::vector<std::int64_t> tids(std::vector<std::string> words) {
    words.insert(words.begin(), {"echo", "s", "--json"});
    std::vector<std::int64_t> found;
    for (const std::string& line : lines_of(output(words)))
      found.push_back(Json::parse(line)["tid"]);
    return found;
  }

  Writer<Sample> writer_ = session_.create<Sample>("s", depth_of(16)).value();
};

using Tids = std::vector<std::int64_t>;

TEST_F(Echo, ShowsFieldsByName) {
  write(0, 3);
  EXPECT_EQ(output({"echo", "s", "--last"}),
            "tid: 3\n"
            "time: 103.000000000\n"
            "clock_error: 3.00 us\n"
            "number: 3\n"
            "value: 1.5\n"
            "inner.a: -3\n"
            "inner.b: [1, 2]\n"
            "row.a: [10, 20]\n"
            "row[0].b: [11, 12]\n"
            "row[1].b: [21, 22]\n"
            "text: \"a,\\\"b\\\"\"\n"
            "---\n");
}

TEST_F(Echo, PrintsTheSameAsJson) {
  write(0, 3);
  EXPECT_EQ(json({"echo", "s", "--last"}), Json::parse(R"({
      "stream": "s:0@pc1", "tid": 3, "time_ns": 103000000000, "clock_error_ns": 3000, "lost": 0,
      "restarts": 0,
      "fields": {"number": 3, "value": 1.5, "inner.a": -3, "inner.b": [1, 2], "row.a": [10, 20],
                 "row[0].b": [11, 12], "row[1].b": [21, 22], "text": "a,\"b\""}})"));
}

TEST_F(Echo, PrintsCsvWithAHeaderAndQuotes) {
  write(0, 3);
  EXPECT_EQ(output({"echo", "s", "--at", "102", "-n", "2", "--csv", "--field", "text", "--field",
                    "inner"}),
            "tid,time_ns,clock_error_ns,inner.a,inner.b[0],inner.b[1],text\n"
            "2,102000000000,2000,-2,1,2,\"a,\"\"b\"\"\"\n"
            "3,103000000000,3000,-3,1,2,\"a,\"\"b\"\"\"\n");
}

TEST_F(Echo, KeepsEveryBitOfLargeNumbersAndHasNullForNan) {
  Sample sample{};
  sample.number = std::numeric_limits<std::int64_t>::min() + 1;
  sample.value = std::nan("");
  writer_.write(sample, at_ns(-5), Duration(0));
  const Json line = json({"echo", "s", "--last"});
  EXPECT_EQ(line["fields"]["number"].get<std::int64_t>(), sample.number);
  EXPECT_TRUE(line["fields"]["value"].is_null());
  EXPECT_EQ(line["time_ns"], -5);
  EXPECT_EQ(line["clock_error_ns"], 0);
}

TEST_F(Echo, FindsSamplesByTimeSince1970AndBeforeTheNewest) {
  write(0, 9);
  EXPECT_EQ(tids({"--at", "104"}), Tids{4});
  EXPECT_EQ(tids({"--at", "104.999999999"}), Tids{4});
  EXPECT_EQ(tids({"--at", "1e9"}), Tids{9});
  EXPECT_EQ(tids({"--at", "-0"}), Tids{9});
  EXPECT_EQ(tids({"--at", "-1.5"}), Tids{7});
  EXPECT_EQ(tids({"--at", "-3", "--count", "3"}), (Tids{6, 7, 8}));
  EXPECT_EQ(tids({"--last"}), Tids{9});
}

TEST_F(Echo, FailsWhereTheRingHoldsNothing) {
  Finished finished = ctl({"echo", "s", "--last"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("nothing was written"), std::string::npos) << finished.err;
  EXPECT_EQ(ctl({"echo", "s", "--at", "-1"}).exit_status, 1);
  write(0, 9);
  finished = ctl({"echo", "s", "--at", "99"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("from 100.000000000 on"), std::string::npos) << finished.err;
}

TEST_F(Echo, ContinuesAfterATimeWithLaterSamples) {
  write(0, 3);
  Running echo(argv({"echo", "s", "--at", "102", "--count", "4", "--field", "number", "--csv"}),
               environment());
  EXPECT_EQ(echo.line().substr(0, 4), "tid,");
  EXPECT_EQ(echo.line().substr(0, 2), "2,");
  EXPECT_EQ(echo.line().substr(0, 2), "3,");
  write(4, 9);
  EXPECT_EQ(echo.line().substr(0, 2), "4,");
  EXPECT_EQ(echo.line().substr(0, 2), "5,");
  EXPECT_EQ(echo.rest(), "");
  EXPECT_EQ(echo.status(), 0);
}

TEST_F(Echo, ShowsOnlyWhatComesFromNowOnEachSampleOnce) {
  write(0, 3);
  Running echo(argv({"echo", "s", "--json"}), environment());
  int next = 4;
  std::int64_t tid = Json::parse(echo.line([&] { write(next++); }))["tid"];
  EXPECT_GE(tid, 4);
  // The ring is short, and echo may have begun late.
  while (tid < next - 1) tid = Json::parse(echo.line())["tid"];
  for (int i = 0; i < 20; ++i) {
    write(next++);
    EXPECT_EQ(Json::parse(echo.line())["tid"], next - 1);
  }
  echo.signal(SIGINT);
  echo.rest();
  EXPECT_EQ(echo.status(), 0);
}

TEST_F(Echo, CountsWhatWasOverwrittenBeforeItCouldBeShown) {
  auto small = session_.create<double>("small", depth_of(4)).value();
  Running echo(argv({"echo", "small", "--json"}), environment());
  std::int64_t tid = Json::parse(echo.line([&] { small.write(1); }))["tid"];
  while (tid < small.newest_tid()) tid = Json::parse(echo.line())["tid"];
  echo.stop();
  for (int i = 0; i < 100; ++i) small.write(2);
  echo.signal(SIGCONT);
  const Json line = Json::parse(echo.line());
  // A ring of 4 slots keeps 3 readable.
  EXPECT_EQ(line["tid"].get<std::int64_t>(), small.newest_tid() - 2);
  EXPECT_EQ(line["lost"], 97);
  EXPECT_EQ(Json::parse(echo.line())["lost"], 0);
}

TEST_F(Echo, AwaitsAStreamAndShowsItFromItsFirstSample) {
  auto other = session_.create<double>("later", depth_of(4)).value();
  Running echo(argv({"echo", "late", "--wait", "60", "--count", "3", "--csv"}), environment());
  const std::string notice = echo.line();
  EXPECT_TRUE(notice.starts_with(
      "dssmctl: echo: waits up to 60.0 s: open 'late:0': there is no stream 'late:0' on this host"))
      << notice;
  EXPECT_TRUE(notice.ends_with("; is it 'later'?")) << notice;
  auto late = session_.create<double>("late", depth_of(16)).value();
  for (int i = 0; i < 3; ++i) late.write(i, at_ns(i));
  EXPECT_EQ(echo.line(), "tid,time_ns,clock_error_ns,value");
  for (const char* row : {"0,0,,0", "1,1,,1", "2,2,,2"}) EXPECT_EQ(echo.line(), row);
  EXPECT_EQ(echo.status(), 0);
}

TEST_F(Echo, FailsWhenTheAwaitedStreamDoesNotCome) {
  const Finished finished = ctl({"echo", "never", "--wait", "0.05"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("'never:0'"), std::string::npos) << finished.err;
}

TEST_F(Echo, DumpsBytesWhereNothingIsDescribed) {
  auto raw = session_.create_raw({"raw", 2, ""}, {"", 100, 1, {}}, depth_of(4)).value();
  raw.write(std::vector<std::byte>(100, std::byte{'A'}), at_ns(kSecond));
  const std::string text = output({"echo", "raw:2", "--last"});
  EXPECT_NE(text.find("payload: 100 bytes\n  00000000  41 41"), std::string::npos) << text;
  EXPECT_NE(text.find("36 bytes more"), std::string::npos) << text;
  EXPECT_NE(output({"echo", "raw:2", "--last", "--full"}).find("00000060"), std::string::npos);
  EXPECT_EQ(json({"echo", "raw:2", "--last"})["payload_hex"].get<std::string>().size(), 200U);
}

// A stream whose programs do not describe its type, and the type.
class EchoDescribed : public CtlTest {
 protected:
  void write() { raw_.write(bytes_, at_ns(kSecond)); }
  const TypeInfo type_ = type_of<Inner>();
  const std::vector<std::byte> bytes_ = std::vector(sizeof(Inner), std::byte{1});
  RawWriter raw_ =
      session_.create_raw({"raw", 0, ""}, {"", sizeof(Inner), 1, {}}, depth_of(1024)).value();
};

TEST_F(EchoDescribed, ShowsFieldsOnceTheStreamIsDescribed) {
  Running echo(argv({"echo", "raw", "--json"}), environment());
  Json line = Json::parse(echo.line([&] { write(); }));
  EXPECT_TRUE(line.contains("payload_hex")) << line;
  ASSERT_TRUE(session_.describe(raw_.id(), type_));
  while (!line.contains("fields")) line = Json::parse(echo.line([&] { write(); }));
  EXPECT_EQ(line["fields"]["a"], 0x01010101);
  EXPECT_FALSE(line.contains("payload_hex")) << line;
  // Created again without them: it goes on with bytes. Stopped, it never finds the stream missing.
  echo.stop();
  ASSERT_TRUE(session_.remove(raw_.id()));
  raw_ = session_.create_raw(raw_.id(), {"", sizeof(Inner), 1, {}}, depth_of(1024)).value();
  echo.signal(SIGCONT);
  std::string text;
  do {
    text = echo.line([&] { write(); });
  } while (contains(text, "\"fields\""));
  while (!contains(text, "payload_hex") && !text.empty()) text = echo.line([&] { write(); });
  EXPECT_TRUE(contains(text, "\"restarts\":1")) << text;
}

TEST_F(EchoDescribed, KeepsTheColumnsOfCsv) {
  Running echo(argv({"echo", "raw", "--csv"}), environment());
  EXPECT_EQ(echo.line(), "tid,time_ns,clock_error_ns,payload_hex");
  ASSERT_FALSE(echo.line([&] { write(); }).empty());
  ASSERT_TRUE(session_.describe(raw_.id(), type_));
  std::string text;
  do {
    text = echo.line([&] { write(); });
  } while (!contains(text, "was described") && !text.empty());
  EXPECT_TRUE(contains(text, "because CSV has one header; start again")) << text;
  EXPECT_TRUE(contains(echo.line([&] { write(); }), ",0101010101010101"));
  ASSERT_TRUE(raw_.set_property(bytes_));
  for (int i = 0; i < 100; ++i) {
    text = echo.line([&] { write(); });
    ASSERT_TRUE(contains(text, ",0101010101010101")) << text;
  }
}

TEST_F(Echo, NamesTheFieldsThereAreWhenOneIsUnknown) {
  const Finished finished = ctl({"echo", "s", "--field", "nmber"});
  EXPECT_EQ(finished.exit_status, 2);
  EXPECT_NE(finished.err.find("'nmber'"), std::string::npos) << finished.err;
  EXPECT_NE(finished.err.find("'number'"), std::string::npos) << finished.err;
}

}  // namespace
}  // namespace dssm::test
