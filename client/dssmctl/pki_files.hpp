// SPDX-License-Identifier: Apache-2.0
//
// The files of dssmctl pki: credentials and CA folders. A file is replaced in one step (a temporary
// file, fsync, rename), so that a reader, or a PC that loses power, has the old or the new
// contents. A private key is created readable by its owner only; no other user can open it at any
// moment.
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/certificates.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::ctl::pki {

// Their names in a folder of credentials, and in that of a CA.
inline constexpr const char* kOwnCertificate = "own.crt";
inline constexpr const char* kOwnKey = "own.key";
inline constexpr const char* kCaCertificate = "ca.crt";
inline constexpr const char* kCaKey = "ca.key";
inline constexpr const char* kRevoked = "revoked.crl";
inline constexpr const char* kIssued = "issued";

std::string path_in(const std::string& folder, std::string_view name);

// A whole file, of at most 1 MiB; "-": standard input.
//   fails  not_found, no_permission ...; limit_exceeded: it is longer
Result<std::string> read_text(const std::string& path);

// The same, parsed; without the file: an empty bundle.
Result<Bundle> read_bundle(const std::string& path);
Result<Bundle> read_bundle_if_there(const std::string& path);
Result<Key> read_key(const std::string& path);

// Replaces a file, or creates it; its permissions are `mode` whatever the umask is.
//   fails  conflict: the path is something else than a file, such as a device or a link
Result<void> replace_file(const std::string& path, std::string_view text, mode_t mode);

// Creates the file of a key unless there is one, with mode 0600. As root on a PC with the user
// dssm, it belongs to that user, so that dssmd can read it.
//   returns  whether it was created
Result<bool> create_key_file(const std::string& path, const Key& key);

// Creates a folder, and those above it that are missing.
Result<void> create_folder(const std::string& path);

// Waits until no other process has this lock of a folder; ends with the descriptor.
Result<UniqueFd> lock_folder(const std::string& path);

// What a CA issued: issued/SERIAL.pem in its folder, a line with its place and the time, and the
// certificate.
struct Issued {
  std::string path;
  std::uint64_t place = 0;  // 1, 2, 3 ... in the order of issuing, which no clock shows reliably
  Certificate certificate;
};
Result<void> store_issued(const std::string& ca, const Issued& issued, std::time_t now);

// All, in the order in which they were issued.
Result<std::vector<Issued>> read_issued(const std::string& ca);

// Whether `text` is the serial number: hexadecimal digits of either case, with or without colons.
bool is_serial(const Certificate& certificate, std::string_view text);

}  // namespace dssm::ctl::pki
