// SPDX-License-Identifier: Apache-2.0
//
// dssmctl pki init, issue, renew and revoke: what is done on the PC that has the CA of the vehicle.
//
// The CA's folder holds ca.key, ca.crt (the CA, and others that the hosts accept while one replaces
// the other), revoked.crl, and issued/ with a file for each certificate. Who changes it holds the
// folder's lock, so that two of these at the same time do not lose a revocation.
#include <fmt/format.h>
#include <stdio.h>
#include <stdlib.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/pki.hpp"
#include "client/dssmctl/pki_files.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/this_host.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace pki {
namespace {

// 2025-01-01: a clock before that is wrong, and what it issues would have ended before it is used.
constexpr std::time_t kEarliestNow = 1'735'689'600;

constexpr mode_t kSecretMode = 0600;

Result<std::time_t> right_now() {
  const std::time_t now = std::time(nullptr);
  if (now >= kEarliestNow) return now;
  return Error{Errc::system, fmt::format("issue: the clock of this PC says {}, which is wrong; set "
                                         "it, then try again",
                                         date_text(now))};
}

// The folder of a CA, locked.
struct CaFolder {
  std::string path;
  UniqueFd lock;
  Authority authority;
  std::vector<Certificate> certificates;  // all of ca.crt
  RevocationList list;
  std::vector<Issued> issued;

  bool revoked(const Certificate& certificate) const { return is_revoked(certificate, {list}); }
};

Result<CaFolder> open_ca(const std::string& path) {
  CaFolder ca;
  ca.path = path;
  ca.lock = DSSM_TRY(lock_folder(path), "open the CA ('dssmctl pki init' makes one)");
  ca.authority.key = DSSM_TRY(read_key(path_in(path, kCaKey)), "open the CA");
  const std::string certificate_path = path_in(path, kCaCertificate);
  ca.certificates = DSSM_TRY(read_bundle(certificate_path), "open the CA").certificates;
  for (const Certificate& certificate : ca.certificates) {
    if (have_same_key(certificate, ca.authority.key)) ca.authority.certificate = certificate;
  }
  if (!ca.authority.certificate) {
    return Error{Errc::conflict,
                 fmt::format("open the CA: no certificate in '{}' belongs to '{}'; restore both "
                             "from one backup",
                             certificate_path, path_in(path, kCaKey))};
  }
  // Without the list, what was revoked would become valid again.
  const std::string list_path = path_in(path, kRevoked);
  const Bundle lists = DSSM_TRY(read_bundle(list_path), "open the CA");
  const auto own = newest_lists({ca.authority.certificate}, lists.lists);
  if (own.empty()) {
    return Error{Errc::conflict, fmt::format("open the CA: it has not signed '{}'; restore the "
                                             "newest list from a host or a backup",
                                             list_path)};
  }
  ca.list = own.front();
  ca.issued = DSSM_TRY(read_issued(path), "open the CA");
  return ca;
}

// A new CA's files in `folder`.
Result<void> fill_folder(const std::string& folder, const Authority& authority,
                         const RevocationList& list) {
  DSSM_TRY(replace_file(path_in(folder, kCaKey), pem_of(authority.key), kSecretMode));
  DSSM_TRY(
      replace_file(path_in(folder, kCaCertificate), pem_of(authority.certificate), kPublicMode));
  DSSM_TRY(replace_file(path_in(folder, kRevoked), pem_of(list), kPublicMode));
  return create_folder(path_in(folder, kIssued));
}

// Makes the folder whole under another name first: there is never half a CA, and one that is there
// is not touched, because rename(2) replaces only a folder that is empty.
Result<void> create_ca(const std::string& path, const Authority& authority,
                       const RevocationList& list) {
  const std::string parent = std::filesystem::path(path).parent_path().string();
  if (!parent.empty()) DSSM_TRY(create_folder(parent));
  std::string temporary = path + ".XXXXXX";
  if (!::mkdtemp(temporary.data())) {  // mode 0700
    return os_error(fmt::format("create the folder '{}'", path));
  }
  Result<void> done = fill_folder(temporary, authority, list);
  if (done && ::rename(temporary.c_str(), path.c_str())) {
    done = errno == ENOTEMPTY || errno == EEXIST
               ? Error{Errc::conflict,
                       fmt::format("create the CA: the folder '{}' is not empty, so there may be a "
                                   "CA; use it, or choose another folder with --ca",
                                   path)}
               : os_error(fmt::format("create the folder '{}'", path));
  }
  std::error_code ignored;
  if (!done) std::filesystem::remove_all(temporary, ignored);
  return done;
}

// Its path without a slash at the end, which would not be part of a name.
std::string without_slash(std::string path) {
  while (path.size() > 1 && path.ends_with('/')) path.pop_back();
  return path;
}

Result<std::time_t> end_after(const CaFolder& ca, std::int64_t days, std::time_t now) {
  const std::time_t end = now + days * kSecondsPerDay;
  const std::time_t ca_end = end_of(ca.authority.certificate);
  if (end <= ca_end) return end;
  return Error{
      Errc::conflict,
      fmt::format("issue for {} days: the CA itself ends on {}; give fewer --days, or make "
                  "a new CA",
                  days, date_text(ca_end))};
}

// What a person has to know before two PCs use one name.
void warn_about_others(const PkiIssueOptions& options, const CaFolder& ca, const Request& request,
                       std::time_t now) {
  for (const Issued& other : ca.issued) {
    const Identity identity = identity_of(other.certificate);
    const bool same_host = identity.host_id == request.identity.host_id;
    if (identity.kind != request.identity.kind || identity.name != request.identity.name ||
        end_of(other.certificate) < now || ca.revoked(other.certificate) ||
        (same_host && have_same_key(other.certificate, request.public_key))) {
      continue;
    }
    note(options,
         fmt::format("warning: certificate {} of {}, with another {}, stays valid; if it is not "
                     "needed any more: dssmctl pki revoke {}",
                     serial_of(other.certificate), identity.str(), same_host ? "key" : "host id",
                     serial_of(other.certificate)));
  }
}

// Signs, stores what was issued, and prints the bundle.
Result<void> issue_bundle(const PkiCaOptions& options, const CaFolder& ca, const Request& request,
                          std::int64_t days, std::time_t now, Output& out) {
  const std::time_t end = DSSM_TRY(end_after(ca, days, now));
  const Certificate certificate = DSSM_TRY(issue(ca.authority, request, end));
  const std::uint64_t place = ca.issued.empty() ? 1 : ca.issued.back().place + 1;
  DSSM_TRY(store_issued(ca.path, {{}, place, certificate}, now));
  std::string bundle = pem_of(certificate);
  for (const Certificate& authority : ca.certificates) bundle += pem_of(authority);
  bundle += pem_of(ca.list);
  DSSM_TRY(put_out(bundle, options.out, out));
  note(options, fmt::format("issued certificate {} for {}, valid until {}", serial_of(certificate),
                            request.identity.str(), date_text(end)));
  return {};
}

// Those that have this name or serial number, in the order in which they were issued.
Result<std::vector<Certificate>> find_issued(const CaFolder& ca, const std::string& name) {
  std::vector<Certificate> found;
  for (const Issued& issued : ca.issued) {
    if (identity_of(issued.certificate).name == name || is_serial(issued.certificate, name)) {
      found.push_back(issued.certificate);
    }
  }
  if (!found.empty()) return found;
  return Error{Errc::not_found,
               fmt::format("find '{}': this CA issued no certificate with that name or serial "
                           "number; 'dssmctl pki show {}' lists all",
                           escaped(name), ca.path)};
}

}  // namespace
}  // namespace pki

Result<void> run(const PkiInitOptions& options, Output&) {
  const std::string path = pki::without_slash(options.ca);
  const std::string vehicle = options.vehicle ? *options.vehicle : DSSM_TRY(this_host_name());
  const std::time_t now = DSSM_TRY(pki::right_now());
  const pki::Authority authority = DSSM_TRY(pki::make_authority(vehicle, now));
  const pki::RevocationList list = DSSM_TRY(pki::make_list(authority, nullptr, {}, now));
  DSSM_TRY(pki::create_ca(path, authority, list));
  pki::note(options,
            fmt::format("made '{}' in '{}', valid until {}; keep a copy of this folder in a "
                        "safe place",
                        pki::identity_of(authority.certificate).name, path,
                        pki::date_text(pki::end_of(authority.certificate))));
  return {};
}

Result<void> run(const PkiIssueOptions& options, Output& out) {
  const std::time_t now = DSSM_TRY(pki::right_now());
  const std::string text = DSSM_TRY(pki::read_text(options.request));
  const pki::Request request =
      DSSM_TRY(pki::parse_request_untrusted(text), fmt::format("issue for '{}'", options.request));
  const pki::CaFolder ca = DSSM_TRY(pki::open_ca(options.ca));
  pki::warn_about_others(options, ca, request, now);
  return pki::issue_bundle(options, ca, request, options.days, now, out);
}

Result<void> run(const PkiRenewOptions& options, Output& out) {
  const std::time_t now = DSSM_TRY(pki::right_now());
  const pki::CaFolder ca = DSSM_TRY(pki::open_ca(options.ca));
  const auto found = DSSM_TRY(pki::find_issued(ca, options.name));
  const pki::Certificate& newest = found.back();
  const pki::Identity identity = pki::identity_of(newest);
  for (const pki::Certificate& other : found) {
    if (pki::identity_of(other).kind != identity.kind) {
      return Error{Errc::conflict,
                   fmt::format("renew '{}': a host and a program have this name; give the serial "
                               "number, which 'dssmctl pki show {}' lists",
                               escaped(options.name), options.ca)};
    }
  }
  if (ca.revoked(newest)) {
    return Error{Errc::conflict,
                 fmt::format("renew '{}': its newest certificate, {}, was revoked; issue for a new "
                             "request",
                             escaped(options.name), pki::serial_of(newest))};
  }
  const pki::Request request{identity, pki::public_key_of(newest)};
  return pki::issue_bundle(options, ca, request, options.days, now, out);
}

Result<void> run(const PkiRevokeOptions& options, Output& out) {
  const std::time_t now = std::time(nullptr);
  pki::CaFolder ca = DSSM_TRY(pki::open_ca(options.ca));
  std::vector<pki::Certificate> revoked;
  for (const pki::Certificate& certificate : DSSM_TRY(pki::find_issued(ca, options.name))) {
    // Also those that have ended: a PC whose clock is behind believes them.
    if (!ca.revoked(certificate)) revoked.push_back(certificate);
  }
  if (!revoked.empty()) {
    ca.list = DSSM_TRY(pki::make_list(ca.authority, ca.list, revoked, now));
    DSSM_TRY(pki::replace_file(pki::path_in(options.ca, pki::kRevoked), pki::pem_of(ca.list),
                               pki::kPublicMode));
  }
  DSSM_TRY(pki::put_out(pki::pem_of(ca.list), options.out, out));
  for (const pki::Certificate& certificate : revoked) {
    pki::note(options, fmt::format("revoked certificate {} of {}", pki::serial_of(certificate),
                                   pki::identity_of(certificate).str()));
  }
  pki::note(options, fmt::format("{}revocation list {}: put it on every host with 'dssmctl pki "
                                 "install'",
                                 revoked.empty() ? "nothing left to revoke; " : "",
                                 pki::number_of(ca.list)));
  return {};
}

}  // namespace dssm::ctl
