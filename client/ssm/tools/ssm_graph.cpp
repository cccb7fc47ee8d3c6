// SPDX-License-Identifier: Apache-2.0
//
// ssm-graph: the registered processes and the streams between them, as a digraph for Graphviz.
//
// Exit status: 0, or 1 without dssmd.
#include <unistd.h>

#include <fstream>

#include "tool.hpp"

using namespace dssm::ssm_tools;

namespace {

// As the text of a label in double quotes.
std::string escaped(const std::string& text) {
  std::string result;
  for (const char c : text) {
    if (c == '"' || c == '\\') result += '\\';
    result += c;
  }
  return result;
}

// argv[0] of a process; its number where that cannot be read.
std::string program_of(int pid) {
  std::ifstream file("/proc/" + std::to_string(pid) + "/cmdline");
  std::string program;
  std::getline(file, program, '\0');
  return program.empty() ? std::to_string(pid) : program;
}

}  // namespace

int main(int argc, char** argv) {
  if (prints_help(argc, argv, "prints the SSM programs and the streams between them, for dot(1)"))
    return 0;
  if (!connect()) return 1;
  std::printf(
      "digraph ssm {\n\tgraph [ rankdir = LR ];\n\tnode [ shape = box, style = filled ];\n");
  for (int i = 0, pid = 0; getSSM_node_info(i, &pid); ++i) {
    if (pid == ::getpid()) continue;
    std::printf("\t%d [ label = \"%s\"];\n", pid, escaped(program_of(pid)).c_str());
  }
  char name[SSM_SNAME_MAX] = {};
  for (int i = 0, id = 0, from = 0, to = 0, mode = 0;
       getSSM_edge_info(i, name, sizeof name, &id, &from, &to, &mode); ++i) {
    std::printf("\t%d -> %d [ label = \"%s[%d]\"];\n", from, to, escaped(name).c_str(), id);
  }
  std::printf("}\n");
  endSSM();
  return 0;
}
