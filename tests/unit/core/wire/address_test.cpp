// SPDX-License-Identifier: Apache-2.0
#include "core/wire/address.hpp"

#include <gtest/gtest.h>

namespace dssm::wire {
namespace {

struct Good {
  const char* text;
  const char* host;
  std::uint16_t port;
  const char* str;
};

TEST(Address, ReadsHostsWithAndWithoutPort) {
  const Good cases[] = {
      {"pc2", "pc2", 13776, "pc2:13776"},
      {"pc2:80", "pc2", 80, "pc2:80"},
      {"pc2.local:65535", "pc2.local", 65535, "pc2.local:65535"},
      {"Robot_7-front", "Robot_7-front", 13776, "Robot_7-front:13776"},
      {"10.0.0.2", "10.0.0.2", 13776, "10.0.0.2:13776"},
      {"0.0.0.0:1", "0.0.0.0", 1, "0.0.0.0:1"},
      {"::", "::", 13776, "[::]:13776"},
      {"::1", "::1", 13776, "[::1]:13776"},
      {"[::1]", "::1", 13776, "[::1]:13776"},
      {"[::1]:80", "::1", 80, "[::1]:80"},
      {"fe80::1%eth0", "fe80::1%eth0", 13776, "[fe80::1%eth0]:13776"},
      {"[fe80::1%eth0.100]:80", "fe80::1%eth0.100", 80, "[fe80::1%eth0.100]:80"},
      {"2001:db8::17", "2001:db8::17", 13776, "[2001:db8::17]:13776"},
      {"::ffff:10.0.0.2", "::ffff:10.0.0.2", 13776, "[::ffff:10.0.0.2]:13776"},
  };
  for (const Good& good : cases) {
    const Result<Address> address = Address::parse(good.text);
    ASSERT_TRUE(address) << address.error().message;
    EXPECT_EQ(address->host, good.host);
    EXPECT_EQ(address->port, good.port);
    EXPECT_EQ(address->str(), good.str);
    EXPECT_EQ(Address::parse(address->str()).value(), *address);  // and back
  }
  EXPECT_EQ(Address::parse("pc2", 7)->port, 7);
}

TEST(Address, ReportsWhatIsWrong) {
  const std::pair<std::string, const char*> cases[] = {
      {"", "the host is missing"},
      {":80", "the host is missing"},
      {"pc2:", "'' is not a port"},
      {"pc2:x", "'x' is not a port"},
      {"pc2:-1", "'-1' is not a port"},
      {"pc2:+1", "'+1' is not a port"},
      {"pc2:80x", "'80x' is not a port"},
      {"pc2:65536", "'65536' is not a port"},
      {"pc2:0", "port 0"},
      {"pc2:80:80", "[IPV6]:PORT"},
      {"2001:db8::17:x", "[IPV6]:PORT"},
      {"1:2", "'1' is not an IPv4 number"},
      {"10.0.0.256", "'10.0.0.256' is not an IPv4 number"},
      {"10.1", "not an IPv4 number"},
      {"[::1", "']' is missing"},
      {"[pc2]:80", "in brackets is not an IPv6 number"},
      {"[::1]80", "after ']'"},
      {"[::1]:", "'' is not a port"},
      {"[fe80::1%]", "not an IPv6 number"},
      {"[fe80::1%an-interface-too-long]", "not an IPv6 number"},
      {"pc 2", "not a host name"},
      {"pc2\n", "not a host name"},
      {"-pc2", "not a host name"},
      {".local", "not a host name"},
      {"http://pc2", "'//pc2' is not a port"},
      {std::string(254, 'a'), "not a host name"},
  };
  for (const auto& [text, why] : cases) {
    const Result<Address> address = Address::parse(text);
    ASSERT_FALSE(address) << text;
    EXPECT_EQ(address.error().code, Errc::invalid_argument);
    EXPECT_NE(address.error().message.find(why), std::string::npos) << address.error().message;
    EXPECT_NE(address.error().message.find("'" + text + "'"), std::string::npos);
  }
}

TEST(Address, AllowsPort0OnlyToListen) {
  EXPECT_FALSE(Address::parse("127.0.0.1:0"));
  EXPECT_EQ(Address::parse("127.0.0.1:0", kDefaultPort, true)->port, 0);
  EXPECT_EQ(Address::parse("[::1]:0", kDefaultPort, true)->str(), "[::1]:0");
}

std::vector<SocketAddress> numbers(const char* text) {
  return resolve_number(Address::parse(text).value());
}

TEST(Resolve, TakesNumbersAtOnce) {
  ASSERT_EQ(numbers("10.0.0.2:80").size(), 1u);
  EXPECT_EQ(numbers("10.0.0.2:80")[0].str(), "10.0.0.2:80");
  EXPECT_EQ(numbers("10.0.0.2")[0].storage.ss_family, AF_INET);
  ASSERT_EQ(numbers("[2001:db8::17]:80").size(), 1u);
  EXPECT_EQ(numbers("[2001:db8::17]:80")[0].str(), "[2001:db8::17]:80");
  EXPECT_EQ(numbers("fe80::1%lo")[0].str(), "[fe80::1%lo]:13776");
  EXPECT_TRUE(numbers("pc2").empty());
  EXPECT_TRUE(numbers("localhost").empty());
  EXPECT_TRUE(numbers("fe80::1%nosuch0").empty());
  EXPECT_EQ(resolve(Address::parse("10.0.0.2:80").value())->front().str(), "10.0.0.2:80");
}

TEST(Resolve, FindsNames) {
  const auto found = resolve(Address::parse("localhost:80").value());
  ASSERT_TRUE(found) << found.error().message;
  for (const SocketAddress& address : *found) EXPECT_TRUE(address.is_loopback());
}

TEST(Resolve, ReportsThatThereIsNoSuchHost) {
  // RFC 6761: "invalid" never exists. Without a name server the answer is another one.
  const auto found = resolve(Address{"pc2.invalid", 80});
  ASSERT_FALSE(found);
  EXPECT_NE(found.error().message.find("look up host 'pc2.invalid'"), std::string::npos);
  EXPECT_NE(found.error().message.find("/etc/hosts"), std::string::npos) << found.error().message;
}

TEST(SocketAddress, KnowsLoopback) {
  for (const char* text : {"127.0.0.1", "127.8.9.1", "::1", "::ffff:127.0.0.1"}) {
    EXPECT_TRUE(numbers(text)[0].is_loopback()) << text;
  }
  for (const char* text :
       {"0.0.0.0", "10.127.0.1", "128.0.0.1", "::", "::2", "fe80::1%lo", "::ffff:10.0.0.1"}) {
    EXPECT_FALSE(numbers(text)[0].is_loopback()) << text;
  }
  EXPECT_FALSE(SocketAddress().is_loopback());
}

TEST(IpAddress, HasANetwork) {
  const auto network = [](const char* text) {
    return IpAddress::of(numbers(text)[0]).value().network().str();
  };
  EXPECT_EQ(network("2001:db8:1:2:3:4:5:6"), "2001:db8:1:2::");
  EXPECT_EQ(network("2001:db8:1:3:3:4:5:6"), "2001:db8:1:3::");
  EXPECT_EQ(network("10.0.0.2"), "10.0.0.2");
  EXPECT_EQ(network("::ffff:10.0.0.2"), "10.0.0.2");
}

}  // namespace
}  // namespace dssm::wire
