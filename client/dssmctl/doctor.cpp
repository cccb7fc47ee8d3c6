// SPDX-License-Identifier: Apache-2.0
//
// dssmctl doctor: checks what usually goes wrong, and reports for each check what it found, the
// likely cause, and a command that fixes it or shows more. It changes nothing itself.
#include "client/dssmctl/doctor.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

void print_text(const std::vector<Finding>& findings, Output& out) {
  for (const Finding& finding : findings) {
    const std::string mark = finding.status == Finding::Status::ok     ? "OK    "
                             : finding.status == Finding::Status::warn ? out.bold("WARN") + "  "
                                                                       : out.bold("FAIL") + "  ";
    out.add(fmt::format("{}{}: {}\n", mark, escaped(finding.name), escaped_message(finding.text)));
    if (finding.status == Finding::Status::ok) continue;
    out.add(fmt::format("      likely: {}\n      try:    {}\n", escaped_message(finding.cause),
                        escaped_message(finding.command)));
  }
}

}  // namespace

Json findings_json(const std::vector<Finding>& findings) {
  const auto status_name = [](Finding::Status status) {
    return status == Finding::Status::ok ? "ok" : status == Finding::Status::warn ? "warn" : "fail";
  };
  Json checks = Json::array();
  for (const Finding& finding : findings) {
    checks.push_back({{"name", finding.name},
                      {"status", status_name(finding.status)},
                      {"text", finding.text},
                      {"cause", or_null(finding.cause)},
                      {"command", or_null(finding.command)}});
  }
  return checks;
}

Result<void> run(const DoctorOptions& options, Output& out) {
  const std::vector<Finding> findings = findings_of(collect_facts(options));
  const auto failed = std::count_if(findings.begin(), findings.end(), [](const Finding& finding) {
    return finding.status == Finding::Status::fail;
  });
  if (options.json) {
    out.add(json_document({{"checks", findings_json(findings)}, {"ok", failed == 0}}));
  } else {
    print_text(findings, out);
  }
  if (failed == 0) return {};
  return Error{Errc::system,
               fmt::format("{} of {} checks failed; run the commands shown, then run doctor again",
                           failed, findings.size())};
}

}  // namespace dssm::ctl
