// SPDX-License-Identifier: Apache-2.0
//
// What a program meets before it runs: headers that compile everywhere without warnings, a library
// that exports the documented names and nothing else, and a pkg-config file that fits C programs.
#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <iterator>
#include <set>
#include <sstream>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

// Compiles a program that includes `headers`, one by one and all, strictly.
void compile(const std::string& compiler, const std::string& dialect, const std::string& suffix,
             const std::vector<std::string>& headers) {
  const std::string folder = make_temp_dir();
  const std::string file = folder + "/program." + suffix;
  std::vector<std::string> texts;
  std::string all;
  for (const std::string& header : headers) {
    texts.push_back("#include <" + header + ">\nint main(void) { return 0; }\n");
    all += "#include <" + header + ">\n";
  }
  texts.push_back(all + all + "int main(void) { return 0; }\n");
  for (const std::string& text : texts) {
    std::ofstream(file) << text;
    std::vector<std::string> command = {
        compiler,    "-std=" + dialect, "-fsyntax-only",
        "-Werror",   "-Wall",           "-Wextra",
        "-pedantic", "-Wshadow",        "-I" + source("client/ssm/include")};
    if (suffix == "cpp") {
      command.insert(command.end(), {"-Wold-style-cast", "-Wconversion", "-Wnon-virtual-dtor"});
    } else {
      command.insert(command.end(), {"-Wstrict-prototypes", "-Wmissing-prototypes"});
    }
    command.push_back(file);
    const Finished finished = run(command);
    EXPECT_EQ(finished.exit_status, 0) << dialect << "\n" << text << finished.err;
  }
  remove_tree(folder);
}

const std::vector<std::string> kCHeaders = {"ssm.h", "ssm-time.h", "libssm.h", "ssmtype/bumper.h",
                                            "ssmtype/ultrasonic.h"};

TEST(SsmHeaders, CompileWithoutWarningsInEveryDialectOfC) {
  for (const char* dialect : {"gnu89", "c89", "c99", "gnu99", "c11", "gnu17"}) {
    compile("cc", dialect, "c", kCHeaders);
  }
}

TEST(SsmHeaders, CompileWithoutWarningsInEveryDialectOfCpp) {
  std::vector<std::string> headers = kCHeaders;
  headers.insert(headers.end(), {"ssm.hpp", "ssmp.hpp", "ssm-log.hpp"});
  for (const char* dialect : {"gnu++98", "c++11", "c++14", "c++17", "c++20"}) {
    compile("c++", dialect, "cpp", headers);
  }
}

TEST(SsmHeaders, OfTheRemoteInterfaceCompileWithoutWarningsFromCpp11On) {
  const std::vector<std::string> headers = {
      "dssm-def.hpp", "dssm-utility.hpp",     "dssm-proxy-client.hpp",
      "dssm.hpp",     "ssm-proxy-client.hpp", "ssm-proxy-client-child.hpp",
      "ssm.hpp"};
  compile("c++", "c++11", "cpp", headers);
  for (const char* dialect : {"c++14", "c++17", "c++20"}) {
    compile("c++", dialect, "cpp", {"ssm-proxy-client-child.hpp"});  // which includes the others
  }
}

// One has a folder in front, and what they declare has other names.
TEST(SsmHeaders, LiveBesideDssmsOwn) {
  const std::string folder = make_temp_dir();
  std::ofstream(folder + "/program.cpp")
      << "#include <dssm.hpp>\n#include <dssm/dssm.hpp>\n"
         "DSSMApi<int> old_one; dssm::PConnectorOptions own_one; PConnector* old_base = &old_one;\n"
         "int main() {}\n";
  const Finished finished = run(
      {"c++", "-std=c++20", "-fsyntax-only", "-I" + source("client/ssm/include"),
       "-I" + source("client/include"), "-I" + source("core/include"), folder + "/program.cpp"});
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  remove_tree(folder);
}

TEST(SsmHeaders, TakeNoNamesThatProgramsUse) {
  const std::string folder = make_temp_dir();
  std::ofstream(folder + "/program.cpp")
      << "#include <libssm.h>\n#include <ssm-log.hpp>\n#include <ssmp.hpp>\n"
         "#if __cplusplus >= 201103L\n#include <dssm.hpp>\n#endif\n"
         "static void ctrlC(int) {}\nbool gShutOff;\nvoid setSigInt() {}\n"
         "#ifdef PI\n#error PI\n#endif\nconst double PI = 3;\n"
         "struct node {}; struct edge {}; int get_unit(); int Time, Duration, Stream, Error;\n"
         "namespace dssm { int mine; }\n"
         "int main() { ctrlC(0); setSigInt(); node n; edge e; (void)n; (void)e; }\n";
  for (const char* dialect : {"-std=gnu++98", "-std=c++11"}) {
    const Finished finished = run({"c++", dialect, "-fsyntax-only",
                                   "-I" + source("client/ssm/include"), folder + "/program.cpp"});
    EXPECT_EQ(finished.exit_status, 0) << finished.err;
  }
  remove_tree(folder);
}

// The names of libssm.map, all of them declared in a header, and those that the library exports.
TEST(SsmLibrary, ExportsTheDocumentedNamesAndNothingElse) {
  std::ifstream map(source("client/ssm/libssm.map"));
  std::set<std::string> documented;
  for (std::string word; map >> word;) {
    if (word.back() != ';' || word == "*;" || word == "};") continue;
    documented.insert(word.substr(0, word.size() - 1));
  }
  const Finished finished = run({"nm", "-D", "--defined-only", built("client/ssm/libssm.so")});
  ASSERT_EQ(finished.exit_status, 0) << finished.err;
  std::set<std::string> exported;
  std::istringstream lines(finished.out);
  for (std::string address, kind, name; lines >> address >> kind >> name;) {
    if (kind == "A") continue;  // the version's own name
    exported.insert(name.substr(0, name.find('@')));
  }
  EXPECT_EQ(exported, documented);
  std::string headers;
  for (const char* header :
       {"ssm.h", "ssm-time.h", "libssm.h", "ssm.hpp", "ssm-log.hpp", "dssm-proxy-client.hpp"}) {
    std::ifstream file(source("client/ssm/include/") + header);
    headers.append(std::istreambuf_iterator<char>(file), {});
  }
  for (const std::string& name : documented) {
    const bool declared = headers.find(" " + name + "(") != std::string::npos ||
                          headers.find(" " + name + ";") != std::string::npos;
    EXPECT_TRUE(declared) << name;
  }
}

TEST(SsmLibrary, PkgConfigGivesPlainFlags) {
  const std::string path = "PKG_CONFIG_PATH=" + built("meson-private");
  const Finished libs = run({"pkg-config", "--libs", "ssm"}, {path});
  EXPECT_EQ(libs.exit_status, 0) << libs.err;
  EXPECT_NE(libs.out.find("-lssm"), std::string::npos) << libs.out;
  const Finished flags = run({"pkg-config", "--cflags", "ssm"}, {path});
  EXPECT_EQ(flags.out.find("-std="), std::string::npos) << flags.out;  // C and C++98 use it
}

}  // namespace
}  // namespace dssm::test
