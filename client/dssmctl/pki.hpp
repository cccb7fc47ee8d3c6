// SPDX-License-Identifier: Apache-2.0
//
// What the verbs of dssmctl pki share.
#pragma once

#include <sys/types.h>

#include <ctime>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/certificates.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl::pki {

inline constexpr mode_t kPublicMode = 0644;  // of certificates and lists

// A line on standard error: what was done, or a warning. Standard output is for PEM text.
void note(const CommonOptions& options, std::string_view text);

// PEM text to `file`; to `out` when that is empty or "-".
Result<void> put_out(std::string_view text, const std::string& file, Output& out);

// "2028-11-26", UTC.
std::string date_text(std::time_t time);

// The certificates of a bundle by what they are for.
struct Sorted {
  std::vector<Certificate> own;  // of hosts, programs and others
  std::vector<Certificate> intermediates;
  std::vector<Certificate> roots;  // CAs that signed themselves

  std::vector<Certificate> authorities() const;  // roots and intermediates
};
Sorted sort_certificates(const Bundle& bundle);

// The CAs in a folder of credentials; intermediate ones are beside the own certificate.
//   ca, own  the files ca.crt and own.crt
std::vector<Certificate> authorities_in(const Bundle& ca, const Bundle& own);

}  // namespace dssm::ctl::pki
