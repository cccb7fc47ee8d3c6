// SPDX-License-Identifier: Apache-2.0
//
// dssmctl, the person's tool: reads the command line, runs a verb, says what went wrong. It is
// built on nothing but <dssm/dssm.hpp>, so whatever it can do, any program can do.
//
// Exit status: 0 success, 1 failure, 2 wrong usage (whatever no daemon could have made work).
#include <signal.h>
#include <unistd.h>

#include <string>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

constexpr int kSuccess = 0;
constexpr int kFailure = 1;
constexpr int kWrongUsage = 2;

Result<void> run(const Options& options, Output& out) {
  switch (options.verb) {
    case Verb::ls:
      return run_ls(options, out);
    case Verb::hosts:
      return run_hosts(options, out);
    case Verb::clock:
      return run_clock(options, out);
    case Verb::doctor:
      return run_doctor(options, out);
    case Verb::ping:
      return run_ping(options, out);
    case Verb::info:
      return run_info(options, out);
    case Verb::echo:
      return run_echo(options, out);
    case Verb::hz:
      return run_hz(options, out);
    case Verb::bw:
      return run_bw(options, out);
    case Verb::delay:
      return run_delay(options, out);
    case Verb::create:
      return run_create(options, out);
    case Verb::rm:
      return run_rm(options, out);
    case Verb::property_get:
      return run_property_get(options, out);
    case Verb::property_set:
      return run_property_set(options, out);
    case Verb::playback_show:
    case Verb::playback_set:
    case Verb::playback_pause:
    case Verb::playback_resume:
    case Verb::playback_reset:
      return run_playback(options, out);
  }
  return Error{Errc::invalid_argument, "no such verb"};  // not reached: all verbs are listed above
}

int report(const Error& error, const std::string& verb_name) {
  complain("dssmctl: " + verb_name + ": " + escaped_message(error.message) + "\n");
  return error.code == Errc::invalid_argument ? kWrongUsage : kFailure;
}

int main_program(int argc, char** argv) {
  ::signal(SIGPIPE, SIG_IGN);  // a closed pipe shows as EPIPE, see Output
  Output out(STDOUT_FILENO);
  const CommandLine line = parse_command_line(argc, argv);
  if (!line.options) {
    if (!line.ok) return complain(line.text), kWrongUsage;
    out.add(line.text);
    out.flush();
    return out.result() ? kSuccess : report(out.result().error(), "help");
  }
  const Result<void> result = run(*line.options, out);
  out.flush();
  if (!result) return report(result.error(), line.options->verb_name);
  if (!out.result()) return report(out.result().error(), line.options->verb_name);
  return kSuccess;
}

}  // namespace
}  // namespace dssm::ctl

int main(int argc, char** argv) { return dssm::ctl::main_program(argc, argv); }
