// SPDX-License-Identifier: Apache-2.0
//
// What is announced by mDNS, and what is believed of what others announce.
#include "daemon/fleet/service_record.hpp"

#include <avahi-common/domain.h>
#include <gtest/gtest.h>

#include <algorithm>

#include "core/base/text.hpp"

namespace dssm::daemon {
namespace {

ServiceRecord host_record() {
  ServiceRecord record;
  for (std::size_t i = 0; i < record.host_id.size(); ++i) {
    record.host_id[i] = static_cast<std::uint8_t>(0x11 * i);
  }
  record.host = "pc2";
  record.protocol_version = 1;
  return record;
}

ServiceRecord stream_record() {
  ServiceRecord record = host_record();
  record.stream = ServiceRecord::Stream{.name = "lidar",
                                        .id = 0,
                                        .payload_bytes = 1448,
                                        .depth = 121,
                                        .cycle = std::chrono::milliseconds(25),
                                        .type = "Scan",
                                        .type_hash = 0x1a2b3c,
                                        .incarnation = 0xfedcba9876543210};
  return record;
}

// Each field as long as it can be in a stream that was created: with such names the full name takes
// all of its 63 bytes.
ServiceRecord longest_record() {
  ServiceRecord record = host_record();
  record.host = std::string(20, 'h');
  record.protocol_version = UINT32_MAX;
  record.closed = true;
  record.stream = ServiceRecord::Stream{.name = "\u00e4" + std::string(29, 'n'),
                                        .id = INT32_MAX,
                                        .payload_bytes = kMaxPayloadBytes,
                                        .depth = kMaxDepth,
                                        .cycle = Duration::max(),
                                        .type = std::string(kMaxTypeNameBytes, 't'),
                                        .type_hash = UINT64_MAX,
                                        .incarnation = UINT64_MAX};
  return record;
}

// As it crosses the network: each string with a byte for its length.
std::size_t wire_bytes(const TxtRecord& txt) {
  std::size_t bytes = 0;
  for (const auto& [key, value] : txt) bytes += 2 + key.size() + value.size();
  return bytes;
}

TxtRecord with(TxtRecord txt, const std::string& key, const std::string& value) {
  for (auto& [found, old] : txt) {
    if (found == key) old = value;
  }
  return txt;
}

TxtRecord without(TxtRecord txt, const std::string& key) {
  std::erase_if(txt, [&](const auto& pair) { return pair.first == key; });
  return txt;
}

// Why it is refused, or "" when it is taken.
std::string refusal(const TxtRecord& txt) {
  const Result<ServiceRecord> record = service_record_untrusted(txt);
  if (record) return "";
  EXPECT_EQ(record.error().code, Errc::protocol);
  EXPECT_TRUE(is_utf8(record.error().message)) << "it goes into protobuf's strings";
  return record.error().message;
}

// --- what is announced

TEST(ServiceRecord, DescribesAStreamAsDocumented) {
  const TxtRecord expected = {{"txtvers", "1"},
                              {"host", "pc2"},
                              {"hid", "00112233445566778899aabbccddeeff"},
                              {"proto", "1"},
                              {"name", "lidar"},
                              {"id", "0"},
                              {"bytes", "1448"},
                              {"depth", "121"},
                              {"cycle", "25000000"},
                              {"type", "Scan"},
                              {"hash", "00000000001a2b3c"},
                              {"ring", "fedcba9876543210"}};
  EXPECT_EQ(stream_record().txt(), expected);
  EXPECT_EQ(stream_record().instance(), "lidar:0@pc2");
  EXPECT_EQ(stream_record().subtype(), "_lidar._sub._dssm._tcp");
}

TEST(ServiceRecord, DescribesAHostAsDocumented) {
  const TxtRecord expected = {{"txtvers", "1"},
                              {"host", "pc2"},
                              {"hid", "00112233445566778899aabbccddeeff"},
                              {"proto", "1"}};
  EXPECT_EQ(host_record().txt(), expected);
  EXPECT_EQ(host_record().instance(), "pc2");
  EXPECT_EQ(host_record().subtype(), "_host:._sub._dssm._tcp");
}

TEST(ServiceRecord, GivesClosedAsAKeyAlone) {
  ServiceRecord record = host_record();
  record.closed = true;
  EXPECT_EQ(record.txt().back(), (std::pair<std::string, std::string>("closed", "")));
}

TEST(ServiceRecord, LeavesOutTheTypeOfAStreamOfJustBytes) {
  ServiceRecord record = stream_record();
  record.stream->type.clear();
  const TxtRecord txt = record.txt();
  EXPECT_EQ(txt, without(txt, "type"));
  const Result<ServiceRecord> read = service_record_untrusted(txt);
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(*read, record);
}

TEST(ServiceRecord, KeepsTheSizesOfRfc6763WithTheLongestNames) {
  const ServiceRecord longest = longest_record();
  EXPECT_EQ(longest.instance().size(), kMaxInstanceBytes);
  EXPECT_TRUE((StreamId{longest.stream->name, longest.stream->id, longest.host}.check()));
  EXPECT_LE(wire_bytes(longest.txt()), 400u);
  EXPECT_EQ(longest.txt().front().first, "txtvers");
  for (const auto& [key, value] : longest.txt()) {
    EXPECT_LE(key.size(), 9u) << key;
    EXPECT_LE(key.size() + 1 + value.size(), 255u) << key;
    EXPECT_TRUE(std::all_of(key.begin(), key.end(), [](char c) {
      return c >= 0x20 && c <= 0x7e && c != '=';
    })) << key;
  }
}

TEST(ServiceRecord, LeavesTheInstanceNameAsItIs) {
  ServiceRecord record = stream_record();
  record.stream->name = "front \\ 2.5 m \u00e4";
  EXPECT_EQ(record.instance(), "front \\ 2.5 m \u00e4:0@pc2");
}

// Unescaped, "2.5" would be two labels of a domain name.
TEST(ServiceRecord, EscapesTheSubtypeAsAvahiDoes) {
  const auto subtype_of = [](const std::string& name) {
    ServiceRecord record = stream_record();
    record.stream->name = name;
    return record.subtype();
  };
  EXPECT_EQ(subtype_of("2.5"), "_2\\.5._sub._dssm._tcp");
  EXPECT_EQ(subtype_of("a\\b"), "_a\\\\b._sub._dssm._tcp");
  EXPECT_EQ(subtype_of("front left"), "_front\\032left._sub._dssm._tcp");
  EXPECT_EQ(subtype_of("\u00e4a"), "_\\195\\164a._sub._dssm._tcp");
  EXPECT_EQ(subtype_of("A-z_09"), "_A-z_09._sub._dssm._tcp");
}

TEST(ServiceRecord, GivesSubtypesThatAvahiTakes) {
  for (int byte = 0x20; byte < 0x7f; ++byte) {
    if (byte == ':' || byte == '@') continue;  // in no name
    for (const std::size_t length : {1, 2, 31}) {
      ServiceRecord record = stream_record();
      record.stream->name = std::string(length, static_cast<char>(byte));
      const std::string subtype = record.subtype();
      ASSERT_TRUE(avahi_is_valid_service_subtype(subtype.c_str())) << subtype;
      const char* type = avahi_get_type_from_subtype(subtype.c_str());
      ASSERT_TRUE(type) << subtype;
      EXPECT_EQ(type, kServiceType);
      char label[AVAHI_LABEL_MAX];
      const char* rest = subtype.c_str();
      ASSERT_TRUE(avahi_unescape_label(&rest, label, sizeof label)) << subtype;
      EXPECT_EQ(label, "_" + record.stream->name + (length == 1 ? ":" : ""));
    }
  }
  EXPECT_TRUE(avahi_is_valid_service_subtype(std::string(kHostSubtype).c_str()));
  EXPECT_TRUE(avahi_is_valid_service_name(longest_record().instance().c_str()));
}

// Avahi refuses "_x._sub._dssm._tcp": the whole service would not be announced.
TEST(ServiceRecord, LengthensTheSubtypeOfANameOfOneByte) {
  ServiceRecord record = stream_record();
  record.stream->name = "x";
  EXPECT_EQ(record.subtype(), "_x:._sub._dssm._tcp");
  EXPECT_EQ(record.instance(), "x:0@pc2");
  record.stream->name = ".";
  EXPECT_EQ(record.subtype(), "_\\.:._sub._dssm._tcp");
}

TEST(TypeHash, IsTheOneThatIsDocumented) {
  // The first 8 bytes of SHA-256 of "8 Odometry 24 8 1 x 12 0 1 0 ".
  const TypeInfo type{"Odometry", 24, 8, {{"x", Scalar::float64, 0, 1, 0}}};
  EXPECT_EQ(type_hash(type), 0xfa6373e11c664df0u);
}

TEST(TypeHash, DistinguishesTypes) {
  const TypeInfo type{"Odometry", 24, 8, {{"x", Scalar::float64, 0, 1, 0}}};
  std::vector<TypeInfo> others(7, type);
  others[0].name = "odometry";
  others[1].payload_bytes = 32;
  others[2].alignment_bytes = 4;
  others[3].fields[0].name = "y";
  others[4].fields[0].kind = Scalar::int64;
  others[5].fields[0].offset_bytes = 8;
  others[6].fields.clear();
  for (const TypeInfo& other : others) EXPECT_NE(type_hash(other), type_hash(type));
}

// --- what others announce

TEST(ServiceRecordUntrusted, TakesBackWhatIsAnnounced) {
  ServiceRecord closed = host_record();
  closed.closed = true;
  for (const ServiceRecord& record : {host_record(), closed, stream_record(), longest_record()}) {
    const Result<ServiceRecord> read = service_record_untrusted(record.txt());
    ASSERT_TRUE(read) << read.error().message;
    EXPECT_EQ(*read, record);
  }
}

TEST(ServiceRecordUntrusted, RefusesAnotherVersionWhateverElseItHolds) {
  const std::string words = refusal(with(host_record().txt(), "txtvers", "2"));
  EXPECT_NE(words.find("version (txtvers) '2'"), std::string::npos) << words;
  EXPECT_NE(words.find("install the same DSSM"), std::string::npos) << words;
  EXPECT_NE(refusal({{"txtvers", "2"}}).find("txtvers"), std::string::npos);
  EXPECT_NE(refusal(without(host_record().txt(), "txtvers")), "");
  EXPECT_NE(refusal(with(host_record().txt(), "txtvers", "")), "");
  EXPECT_NE(refusal({}), "");
}

TEST(ServiceRecordUntrusted, NamesTheKeyThatIsMissing) {
  for (const std::string key : {"host", "hid", "proto"}) {
    const std::string words = refusal(without(host_record().txt(), key));
    EXPECT_NE(words.find("the key '" + key + "' is missing"), std::string::npos) << words;
  }
  for (const std::string key : {"id", "bytes", "depth", "cycle", "hash", "ring"}) {
    const std::string words = refusal(without(stream_record().txt(), key));
    EXPECT_NE(words.find("the key '" + key + "' is missing"), std::string::npos) << words;
  }
}

TEST(ServiceRecordUntrusted, RefusesValuesOutOfTheirLimits) {
  const std::vector<std::pair<std::string, std::string>> wrong = {
      {"host", ""},
      {"host", "pc 2"},
      {"host", "pc2.local"},
      {"host", std::string(32, 'h')},
      {"hid", ""},
      {"hid", std::string(31, '0')},
      {"hid", std::string(33, '0')},
      {"hid", std::string(31, '0') + "g"},
      {"hid", "0x" + std::string(30, '0')},
      {"proto", ""},
      {"proto", "0"},
      {"proto", "-1"},
      {"proto", "one"},
      {"proto", "4294967296"},
      {"name", ""},
      {"name", std::string(32, 'n')},
      {"name", "a:b"},
      {"name", "a@b"},
      {"name", std::string("a\0b", 3)},
      {"name", "\xff"},
      {"id", "-1"},
      {"id", "2147483648"},
      {"bytes", "0"},
      {"bytes", "67108865"},
      {"bytes", "99999999999999999999"},
      {"depth", "1"},
      {"depth", "16777217"},
      {"cycle", "0"},
      {"cycle", "9223372036854775808"},
      {"cycle", "1e9"},
      {"type", std::string(128, 't')},
      {"type", "\xc3"},
      {"hash", "1a2b"},
      {"hash", std::string(16, 'g')},
      {"hash", "-" + std::string(15, '1')},
      {"ring", std::string(17, '0')},
      {"ring", ""},
  };
  for (const auto& [key, value] : wrong) {
    EXPECT_NE(refusal(with(stream_record().txt(), key, value)), "") << key << "=" << value;
  }
}

TEST(ServiceRecordUntrusted, RefusesANameThatIsTooLongWithItsHost) {
  TxtRecord txt = with(longest_record().txt(), "host", std::string(21, 'h'));
  EXPECT_NE(refusal(txt).find("64 bytes"), std::string::npos) << refusal(txt);
}

TEST(ServiceRecordUntrusted, PassesOverUnknownKeysAndDoubledOnes) {
  TxtRecord txt = stream_record().txt();
  txt.emplace_back("colour", "green");
  txt.emplace_back("", "no key");
  txt.emplace_back("\xff\x01", std::string(200, '\xfe'));
  txt.emplace_back("host", "not a host's name");
  txt.emplace_back("NAME", "second");
  const Result<ServiceRecord> read = service_record_untrusted(txt);
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(*read, stream_record());
}

TEST(ServiceRecordUntrusted, TakesKeysInAnyCase) {
  TxtRecord txt = stream_record().txt();
  for (auto& pair : txt) {
    std::transform(pair.first.begin(), pair.first.end(), pair.first.begin(),
                   [](char c) { return static_cast<char>(c - 'a' + 'A'); });
  }
  const Result<ServiceRecord> read = service_record_untrusted(txt);
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(*read, stream_record());
}

TEST(ServiceRecordUntrusted, RefusesAnOversizedRecord) {
  TxtRecord txt = host_record().txt();
  std::size_t bytes = wire_bytes(txt);
  while (bytes + 202 <= kMaxTxtBytes) {
    txt.emplace_back("x", std::string(199, 'y'));
    bytes += 202 - 1;
  }
  EXPECT_EQ(refusal(txt), "") << "it is long, but not too long";
  txt.emplace_back("x", std::string(199, 'y'));
  EXPECT_NE(refusal(txt).find("1300"), std::string::npos);
  EXPECT_NE(refusal(TxtRecord(10'000, {"a", ""})).find("1300"), std::string::npos);
}

TEST(ServiceRecordUntrusted, QuotesJunkWithoutPassingItOn) {
  const std::string junk = "\x1b[31m\xff\n<3>forged";
  for (const std::string key : {"txtvers", "host", "hid", "proto", "name", "id", "type", "ring"}) {
    const std::string words = refusal(with(stream_record().txt(), key, junk));
    EXPECT_NE(words, "") << key;
    EXPECT_EQ(words.find_first_of("\n\x1b\xff"), std::string::npos) << words;
  }
}

}  // namespace
}  // namespace dssm::daemon
