// SPDX-License-Identifier: Apache-2.0
//
// dssmctl, the command-line tool: reads the command line, runs a verb, reports what went wrong. Of
// DSSM it uses only <dssm/dssm.hpp>, so any program can do what it does; pki alone needs no dssmd.
//
// Exit status: 0 success, 1 failure, 2 wrong usage (what no dssmd could do).
#include <fmt/format.h>
#include <locale.h>
#include <signal.h>
#include <unistd.h>

#include <string>
#include <variant>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

constexpr int kSuccess = 0;
constexpr int kFailure = 1;
constexpr int kWrongUsage = 2;

int report(const Error& error, const std::string& verb_name) {
  print_error(fmt::format("dssmctl: {}: {}\n", verb_name, escaped_message(error.message)));
  return error.code == Errc::invalid_argument ? kWrongUsage : kFailure;
}

int main_program(int argc, char** argv) {
  ::signal(SIGPIPE, SIG_IGN);  // a closed pipe shows as EPIPE, see Output
  ::setlocale(LC_CTYPE, "");   // NOLINT(concurrency-mt-unsafe): one thread
  use_locale();
  Output out(STDOUT_FILENO);
  const CommandLine line = parse_command_line(argc, argv);
  if (!line.options) {
    if (!line.ok) return print_error(line.text), kWrongUsage;
    out.add(line.text);
    out.flush();
    return out.result() ? kSuccess : report(out.result().error(), "help");
  }
  return std::visit(
      [&](const auto& options) {
        if (options.wide) out.set_wide();
        const Result<void> result = run(options, out);
        out.flush();
        if (!result) return report(result.error(), options.verb_name);
        return out.result() ? kSuccess : report(out.result().error(), options.verb_name);
      },
      *line.options);
}

}  // namespace
}  // namespace dssm::ctl

// NOLINTNEXTLINE(bugprone-exception-escape): only std::visit could throw, of an empty variant
int main(int argc, char** argv) { return dssm::ctl::main_program(argc, argv); }
