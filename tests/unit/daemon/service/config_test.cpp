// SPDX-License-Identifier: Apache-2.0
//
// The configuration file and its values: what is taken, and what is said about what is not.
#include "daemon/service/config.hpp"

#include <fnmatch.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>

#include "daemon/service/config_values.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::daemon {
namespace {

// The message about `text`, or "" when it is taken.
std::string mistakes_in(const std::string& text) {
  Config config;
  const Result<void> applied = apply_text_untrusted(config, text, "dssmd.conf");
  if (applied) return "";
  EXPECT_EQ(applied.error().code, Errc::invalid_argument);
  return applied.error().message;
}

TEST(Config, TakesEveryKeyFromTheFile) {
  Config config;
  const Result<void> applied = apply_text_untrusted(config, R"(
name = "pc7"
runtime_dir = "/run/elsewhere"
socket_group = "root"
socket_mode = "0600"
log_level = "debug"
max_clients = 10
max_clients_per_user = 9
max_streams = 11
max_memory = "12 MiB"
max_opens = 13
max_opens_per_client = 14
max_share = "60%"
max_property = 15
recovery_grace = "16 ms"
listen = ["127.0.0.1:17", "[::]:18", "::1"]
peers = ["pc2", "10.0.0.2:19"]
insecure = true
mdns = false
interfaces = ["eth0", "wlan*"]
avoid_interfaces = ["eth0.[0-9]*"]
max_connections = 20
max_connections_per_host = 21
max_peer_memory = "22 MiB"
mirror_linger = "23 s"
mirror_history = "at_once"
mirror_streams = ["camera*=when_read, 10 Hz,500 ms", "map:2=at_once", "rear=5 Hz"]
stream_priorities = ["encoder=normal", "camera*=low 30%"]
rights = ["local read *", "group:0 create,clock lidar*", "host:pc[23]  all  map:2"]
)",
                                                    "dssmd.conf");
  ASSERT_TRUE(applied) << applied.error().message;
  EXPECT_EQ(config.name, "pc7");
  EXPECT_EQ(config.runtime_dir, "/run/elsewhere");
  EXPECT_EQ(config.socket_group, gid_t{0});
  EXPECT_EQ(config.socket_mode, mode_t{0600});
  EXPECT_EQ(config.log_level, LogLevel::debug);
  EXPECT_EQ(config.max_clients, 10u);
  EXPECT_EQ(config.max_clients_per_user, 9u);
  EXPECT_EQ(config.max_streams, 11u);
  EXPECT_EQ(config.max_memory_bytes, 12u << 20);
  EXPECT_EQ(config.max_opens, 13u);
  EXPECT_EQ(config.max_opens_per_client, 14u);
  EXPECT_EQ(config.max_share_percent, 60u);
  EXPECT_EQ(config.max_property_bytes, 15u);
  EXPECT_EQ(config.recovery_grace, std::chrono::milliseconds(16));
  const std::vector<wire::Address> listen = {{"127.0.0.1", 17}, {"::", 18}, {"::1", 13776}};
  EXPECT_EQ(config.listen, listen);
  const std::vector<wire::Address> peers = {{"pc2", 13776}, {"10.0.0.2", 19}};
  EXPECT_EQ(config.peers, peers);
  EXPECT_TRUE(config.insecure);
  EXPECT_FALSE(config.mdns);
  EXPECT_EQ(config.interfaces, (std::vector<std::string>{"eth0", "wlan*"}));
  EXPECT_EQ(config.avoid_interfaces, std::vector<std::string>{"eth0.[0-9]*"});
  EXPECT_EQ(config.max_connections, 20u);
  EXPECT_EQ(config.max_connections_per_host, 21u);
  EXPECT_EQ(config.max_peer_memory_bytes, 22u << 20);
  EXPECT_EQ(config.mirror_linger, std::chrono::seconds(23));
  const auto demand_for = [&](const char* name, std::int32_t id) {
    return config.mirrors.demand_for({name, id, "pc1"});
  };
  EXPECT_EQ(demand_for("camera3", 0), (MirrorDemand{false, 10, std::chrono::milliseconds(500)}));
  EXPECT_EQ(demand_for("map", 2), (MirrorDemand{true, 0, {}}));
  EXPECT_EQ(demand_for("map", 1), (MirrorDemand{true, 0, {}}));
  EXPECT_EQ(demand_for("rear", 0), (MirrorDemand{true, 5, {}})) << "the time is as in general";
  const auto sending = [&](const std::string& name, std::uint64_t payload_bytes) {
    return config.sending.demand_for({name, 0, "pc7"}, payload_bytes);
  };
  EXPECT_EQ(sending("encoder", 8), (SendingDemand{wire::Priority::normal, 100}));
  EXPECT_EQ(sending("camera3", 8), (SendingDemand{wire::Priority::low, 30}));
  EXPECT_EQ(sending("imu", 16383), (SendingDemand{wire::Priority::high, 100}));
  EXPECT_EQ(sending("map", 16384), (SendingDemand{wire::Priority::normal, 100}));
  ASSERT_EQ(config.rights.size(), 3u);
  EXPECT_EQ(config.rights[2].streams, "map:2");
}

TEST(Config, TakesRights) {
  const auto right = [](const char* text) { return parse_right(text).value(); };
  Right parsed = right("everyone read,write lidar*");
  EXPECT_EQ(parsed.who, Right::Who::everyone);
  EXPECT_EQ(parsed.verbs.str(), "read,write");
  EXPECT_EQ(parsed.streams, "lidar*");
  EXPECT_EQ(parsed.line, "everyone read,write lidar*");
  parsed = right("  user:root   create   map:2 ");
  EXPECT_EQ(parsed.who, Right::Who::user);
  EXPECT_EQ(parsed.number, 0u);
  EXPECT_EQ(parsed.verbs.str(), "write,create");
  EXPECT_EQ(parsed.streams, "map:2");
  parsed = right("group:1000 all *");
  EXPECT_EQ(parsed.who, Right::Who::group);
  EXPECT_EQ(parsed.number, 1000u);
  EXPECT_EQ(parsed.verbs, Verbs::all());
  EXPECT_EQ(right("host:pc[23] read *").name_pattern, "pc[23]");
  EXPECT_EQ(right("program:viewer read *").who, Right::Who::program);
}

TEST(Config, NamesWhatIsWrongInARight) {
  const auto mistake = [](const std::string& line) {
    return mistakes_in("rights = [\"" + line + "\"]\n");
  };
  EXPECT_EQ(mistake("local read"),
            "dssmd.conf:1: key 'rights': 'local read' is not a right; write \"WHO VERBS STREAMS\", "
            "such as \"group:drivers read,write lidar*\" or \"host:pc2 all *\"");
  EXPECT_EQ(mistake("alice read *"),
            "dssmd.conf:1: key 'rights': 'alice read *': 'alice' is not known; write everyone, "
            "local, user:NAME, group:NAME, host:NAME or program:NAME");
  EXPECT_EQ(
      mistake("local read,record *"),
      "dssmd.conf:1: key 'rights': 'local read,record *': 'record' is not a verb; the verbs are "
      "read, write, create, remove, property, clock and all");
  EXPECT_EQ(mistake("user:no-such-user read *"),
            "dssmd.conf:1: key 'rights': 'user:no-such-user read *': there is no user "
            "'no-such-user'");
  for (const char* wrong :
       {"", "local read * *", "host: read *", "local:x read *", "group:no-such-group read *",
        "local , *", "local read lidar@pc2", "user:4294967295 read *", "user:-1 read *"}) {
    EXPECT_NE(mistake(wrong), "") << wrong;
  }
}

TEST(Config, TakesAnEmptyFile) { EXPECT_EQ(mistakes_in(""), ""); }

TEST(Config, NamesLineAndKeyOfAnUnknownKey) {
  const std::string message = mistakes_in("name = \"pc1\"\n\nmax_stream = 5\n");
  EXPECT_EQ(message.find("dssmd.conf:3: key 'max_stream': unknown"), 0u) << message;
  EXPECT_NE(message.find("max_streams"), std::string::npos) << "the right key is not offered";
}

TEST(Config, NamesLineAndKeyOfAWrongType) {
  EXPECT_EQ(mistakes_in("max_streams = \"five\"\n"),
            "dssmd.conf:1: key 'max_streams': a text instead of a whole number");
  EXPECT_EQ(mistakes_in("\nname = 5\n"),
            "dssmd.conf:2: key 'name': a whole number instead of a text in quotes");
  EXPECT_EQ(mistakes_in("max_memory = [1]\n"),
            "dssmd.conf:1: key 'max_memory': a list instead of a whole number or a text in "
            "quotes");
  EXPECT_NE(mistakes_in("[name]\nx = 1\n").find("a table instead of"), std::string::npos);
  EXPECT_NE(mistakes_in("max_clients = 1.5\n").find("a number with a point"), std::string::npos);
  EXPECT_NE(mistakes_in("max_clients = true\n").find("true or false"), std::string::npos);
}

TEST(Config, NamesLineAndKeyOfWhatIsWrongInAList) {
  EXPECT_EQ(mistakes_in("listen = \"127.0.0.1\"\n"),
            "dssmd.conf:1: key 'listen': a text instead of a list of texts in quotes");
  EXPECT_EQ(mistakes_in("peers = [\"pc2\", 5]\n"),
            "dssmd.conf:1: key 'peers': a whole number instead of a text in quotes");
  EXPECT_EQ(mistakes_in("insecure = \"yes\"\n"),
            "dssmd.conf:1: key 'insecure': a text instead of true or false");
  EXPECT_NE(mistakes_in("peers = [\"pc2:99999\"]\n").find("'99999' is not a port"),
            std::string::npos);
  EXPECT_NE(mistakes_in("peers = [\"pc2:0\"]\n").find("port 0"), std::string::npos);
  EXPECT_NE(mistakes_in("listen = [\"pc1\"]\n").find("'pc1' is a name"), std::string::npos);
}

TEST(Config, NamesWhatIsWrongInAPriority) {
  const auto mistake = [](const std::string& demand) {
    return mistakes_in("stream_priorities = [\"" + demand + "\"]\n");
  };
  EXPECT_EQ(mistake("camera=urgent"),
            "dssmd.conf:1: key 'stream_priorities': 'camera=urgent' has a priority that is none: "
            "'urgent' is neither high, normal nor low; write \"STREAM=PRIORITY\" or "
            "\"STREAM=PRIORITY SHARE\", such as \"encoder*=high\" or \"camera*=low 30%\"");
  for (const char* wrong : {"camera", "=low", "camera=", "camera=low 0%", "camera=low 101%",
                            "camera=low 30", "camera=low 30 ms", "camera=low  ", "camera=30%"}) {
    EXPECT_NE(mistake(wrong), "") << wrong;
  }
}

TEST(Config, NamesWhatIsWrongInADemandOnMirrors) {
  const auto mistake = [](const std::string& demand) {
    return mistakes_in("mirror_streams = [\"" + demand + "\"]\n");
  };
  EXPECT_EQ(mistake("camera=fast"),
            "dssmd.conf:1: key 'mirror_streams': 'camera=fast' is wrong: 'fast' is "
            "neither when_read nor at_once, nor a rate or a time; write \"STREAM=WHAT\" or "
            "\"STREAM=WHAT, WHAT\", such as \"map=at_once\", \"camera*=10 Hz\" or "
            "\"camera*=when_read, 10 Hz, 2 s\"");
  for (const char* wrong :
       {"camera", "=10 Hz", "camera=", "camera=10", "camera=0 Hz", "camera=-1 Hz", "camera=10 km",
        "camera=at_once 10 Hz", "camera=100001 Hz", "camera=at_once,", "camera=0 ms",
        "camera=90000 s"}) {
    EXPECT_NE(mistake(wrong), "") << wrong;
  }
}

TEST(Config, DistinguishesNoNetworkFromNoSetting) {
  Config config;
  EXPECT_FALSE(config.listen);
  ASSERT_TRUE(apply_text_untrusted(config, "listen = []", "dssmd.conf"));
  ASSERT_TRUE(config.listen);
  EXPECT_TRUE(config.listen->empty());
}

TEST(Config, UsesMdnsOnAllInterfacesButThoseOfContainersAndTunnels) {
  const Config config;
  EXPECT_TRUE(config.mdns);
  EXPECT_TRUE(config.interfaces.empty());
  const auto avoided = [&](const char* name) {
    return std::any_of(
        config.avoid_interfaces.begin(), config.avoid_interfaces.end(),
        [&](const std::string& pattern) { return ::fnmatch(pattern.c_str(), name, 0) == 0; });
  };
  for (const char* name : {"docker0", "veth1a2b", "br-0c1d", "virbr0", "lxcbr0", "lxdbr0", "tun0",
                           "tap0", "wg0", "tailscale0", "zt7nnig34", "vmnet8"}) {
    EXPECT_TRUE(avoided(name)) << name;
  }
  for (const char* name : {"lo", "eth0", "enp3s0", "wlan0", "wlp2s0", "br0", "bond0", "can0"}) {
    EXPECT_FALSE(avoided(name)) << name;
  }
}

TEST(Config, PutsAListOfInterfacesInPlaceOfTheDefault) {
  Config config;
  ASSERT_TRUE(apply_text_untrusted(config, "avoid_interfaces = [\"can0\"]", "dssmd.conf"));
  EXPECT_EQ(config.avoid_interfaces, std::vector<std::string>{"can0"});
  ASSERT_TRUE(apply_text_untrusted(config, "avoid_interfaces = []", "dssmd.conf"));
  EXPECT_TRUE(config.avoid_interfaces.empty());
}

TEST(Config, RequiresInsecureForAnAddressThatIsNotOfThisPc) {
  const auto finished = [](const std::string& text) {
    Config config;
    config.name = "pc1";
    const Result<void> applied = apply_text_untrusted(config, text, "dssmd.conf");
    EXPECT_TRUE(applied) << applied.error().message;
    const Result<void> done = finish(config);
    return done ? std::string() : done.error().message;
  };
  EXPECT_EQ(finished("listen = [\"127.0.0.1\", \"127.9.9.9:5\", \"[::1]:0\"]"), "");
  EXPECT_EQ(finished("peers = [\"localhost:5\", \"127.0.0.1\"]"), "");
  const std::string refused = finished("listen = [\"0.0.0.0:5\"]\npeers = [\"pc2\"]");
  EXPECT_NE(refused.find("listen '0.0.0.0:5', peer 'pc2:13776'"), std::string::npos) << refused;
  EXPECT_NE(refused.find("insecure = true"), std::string::npos) << refused;
  EXPECT_NE(finished("listen = [\"[::]:5\"]"), "");
  EXPECT_EQ(finished("listen = [\"0.0.0.0:5\"]\npeers = [\"pc2\"]\ninsecure = true"), "");
}

TEST(Config, NamesLineKeyAndRangeOfAValueOutOfRange) {
  EXPECT_EQ(mistakes_in("max_streams = 0\n"),
            "dssmd.conf:1: key 'max_streams': '0' is outside of 1 to 32768");
  EXPECT_NE(mistakes_in("max_streams = -1\n").find("key 'max_streams'"), std::string::npos);
  EXPECT_NE(mistakes_in("max_opens = 100001\n").find("outside of 1 to 100000"), std::string::npos);
  EXPECT_NE(mistakes_in("recovery_grace = \"61 s\"\n").find("outside of 0 to 60000 ms"),
            std::string::npos);
}

TEST(Config, ReportsAllMistakesInTheOrderOfTheFile) {
  const std::string message = mistakes_in("zzz = 1\nmax_streams = 0\naaa = 2\n");
  const std::size_t first = message.find("dssmd.conf:1: key 'zzz'");
  const std::size_t second = message.find("\ndssmd.conf:2: key 'max_streams'");
  const std::size_t third = message.find("\ndssmd.conf:3: key 'aaa'");
  EXPECT_EQ(first, 0u) << message;
  EXPECT_NE(third, std::string::npos) << message;
  EXPECT_LT(second, third) << message;
}

TEST(Config, NamesTheLineOfASyntaxError) {
  EXPECT_EQ(mistakes_in("name = \"pc1\"\nmax_streams = = 3\n").find("dssmd.conf:2: "), 0u);
  EXPECT_NE(mistakes_in("name = pc1\n").find("texts are in quotes"), std::string::npos);
  EXPECT_NE(mistakes_in("name = \"\xff\"\n"), "");
}

TEST(Config, ReportsThatAFileIsMissing) {
  Config config;
  const Result<void> applied = apply_file(config, "/nowhere/dssmd.conf");
  ASSERT_FALSE(applied);
  EXPECT_EQ(applied.error().message,
            "read the configuration '/nowhere/dssmd.conf': No such file or directory");
}

TEST(Config, ReadsAFile) {
  const std::string dir = test::make_temp_dir();
  std::ofstream(dir + "/dssmd.conf") << "max_streams = 77\n";
  Config config;
  EXPECT_TRUE(apply_file(config, dir + "/dssmd.conf"));
  EXPECT_EQ(config.max_streams, 77u);
  test::remove_tree(dir);
}

TEST(Config, TakesTheDefaultFileOfTheProjectWithAllItsLinesInUse) {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");
  ASSERT_TRUE(root);
  std::ifstream file(std::string(root) + "/systemd/dssmd.conf");
  ASSERT_TRUE(file) << "systemd/dssmd.conf is missing";
  std::string text, in_use;
  std::size_t keys = 0;
  for (std::string line; std::getline(file, line);) {
    text += line + "\n";
    if (line.starts_with("#") && line.find(" = ") != std::string::npos && !line.starts_with("# ")) {
      line.erase(0, 1);
      if (line.starts_with("socket_group")) line = "socket_group = \"root\"";
      ++keys;
    }
    in_use += line + "\n";
  }
  EXPECT_EQ(mistakes_in(text), "");
  EXPECT_EQ(mistakes_in(in_use), "");
  EXPECT_EQ(keys, config_keys().size()) << "each key once, commented out with its default";
}

TEST(Config, LetsOneUserHaveHalfOfTheClientsUnlessItIsSet) {
  const auto per_user = [](std::uint64_t max_clients, std::uint64_t given) {
    Config config;
    config.name = "pc1";
    config.max_clients = max_clients;
    config.max_clients_per_user = given;
    EXPECT_TRUE(finish(config));
    return config.max_clients_per_user;
  };
  EXPECT_EQ(per_user(4096, 0), 2048u);
  EXPECT_EQ(per_user(1, 0), 1u);
  EXPECT_EQ(per_user(10, 9), 9u);
}

TEST(Config, GivesTheMachinesNameUpToTheFirstDotWhenNoneIsSet) {
  Config config;
  config.name = "chosen";
  ASSERT_TRUE(finish(config));
  EXPECT_EQ(config.name, "chosen");
  config.name.clear();
  const Result<void> finished = finish(config);
  if (finished) {
    EXPECT_FALSE(config.name.empty());
    EXPECT_EQ(config.name.find('.'), std::string::npos);
  } else {  // a machine whose name is none for a host; then the way out is named
    EXPECT_NE(finished.error().message.find("--name"), std::string::npos);
  }
}

TEST(ConfigValues, ReadBytesWithTheirUnits) {
  const auto bytes = [](std::string_view text) {
    const Result<std::uint64_t> parsed = parse_bytes(text, 0, 1ULL << 50);
    return parsed ? *parsed : 1;
  };
  EXPECT_EQ(bytes("4096"), 4096u);
  EXPECT_EQ(bytes("2KiB"), 2048u);
  EXPECT_EQ(bytes("3 MiB"), 3u << 20);
  EXPECT_EQ(bytes("4 GiB"), 4ULL << 30);
  EXPECT_EQ(bytes("5 TiB"), 5ULL << 40);
  EXPECT_EQ(bytes("50%"), memory_of_the_machine() / 100 * 50);
  EXPECT_FALSE(parse_bytes("101%", 0, UINT64_MAX));
  EXPECT_FALSE(parse_bytes("3 MB", 0, UINT64_MAX));
  EXPECT_FALSE(parse_bytes("-3", 0, UINT64_MAX));
  EXPECT_FALSE(parse_bytes("MiB", 0, UINT64_MAX));
  EXPECT_FALSE(parse_bytes("99999999999999999999", 0, UINT64_MAX));
  EXPECT_FALSE(parse_bytes("16777216 TiB", 0, UINT64_MAX - 1)) << "2^64 must not wrap to 0";
}

TEST(ConfigValues, ReadDurationsOnlyWithTheirUnits) {
  const Duration zero{}, minute = std::chrono::minutes(1);
  EXPECT_EQ(*parse_duration("500 ms", zero, minute), std::chrono::milliseconds(500));
  EXPECT_EQ(*parse_duration("2s", zero, minute), std::chrono::seconds(2));
  EXPECT_FALSE(parse_duration("2", zero, minute));
  EXPECT_FALSE(parse_duration("2 h", zero, minute));
  EXPECT_FALSE(parse_duration("18446744073709551615 s", zero, minute));
}

TEST(ConfigValues, TakeNamesAndPatternsOfInterfaces) {
  for (const std::string good :
       {"eth0", "enp0s31f6", "eth*", "eth[0-3]", "wl?n0", "15-bytes-long--"}) {
    const Result<std::string> taken = parse_interface(good);
    ASSERT_TRUE(taken) << taken.error().message;
    EXPECT_EQ(*taken, good);
  }
  EXPECT_TRUE(parse_interface("*" + std::string(62, 'x')));
  EXPECT_FALSE(parse_interface("*" + std::string(63, 'x')));
  EXPECT_FALSE(parse_interface("16-bytes-long---"));
  EXPECT_FALSE(parse_interface(""));
  EXPECT_FALSE(parse_interface("eth 0"));
  EXPECT_FALSE(parse_interface("eth0\n"));
  EXPECT_FALSE(parse_interface("eth/*"));
}

TEST(ConfigValues, TakeOnlyTrueAndFalse) {
  EXPECT_TRUE(*parse_boolean("true"));
  EXPECT_FALSE(*parse_boolean("false"));
  EXPECT_FALSE(parse_boolean("yes"));
  EXPECT_FALSE(parse_boolean(""));
}

TEST(ConfigValues, ReadModesInOctal) {
  EXPECT_EQ(*parse_mode("0660"), mode_t{0660});
  EXPECT_EQ(*parse_mode("600"), mode_t{0600});
  EXPECT_FALSE(parse_mode("0680"));
  EXPECT_FALSE(parse_mode("01777"));
  EXPECT_FALSE(parse_mode("0460"));
  EXPECT_FALSE(parse_mode(""));
}

TEST(ConfigValues, RefuseAGroupThatIsNotThere) {
  const Result<gid_t> group = parse_group("no-such-group-here");
  ASSERT_FALSE(group);
  EXPECT_NE(group.error().message.find("groupadd"), std::string::npos);
}

}  // namespace
}  // namespace dssm::daemon
