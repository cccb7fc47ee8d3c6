// SPDX-License-Identifier: Apache-2.0
//
// dssmctl pki request and install: what is done on the PC whose certificate it is. Its private key
// never leaves it. No dssmd is needed.
#include "client/dssmctl/pki.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/pki_files.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/this_host.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace pki {

void note(const CommonOptions& options, std::string_view text) {
  print_error(fmt::format("dssmctl: {}: {}\n", options.verb_name, escaped_message(text)));
}

Result<void> put_out(std::string_view text, const std::string& file, Output& out) {
  if (!file.empty() && file != "-") return replace_file(file, text, kPublicMode);
  out.add(text);
  return {};
}

std::string date_text(std::time_t time) {
  std::tm utc{};
  ::gmtime_r(&time, &utc);
  return fmt::format("{:04}-{:02}-{:02}", utc.tm_year + 1900, utc.tm_mon + 1, utc.tm_mday);
}

Sorted sort_certificates(const Bundle& bundle) {
  Sorted sorted;
  for (const Certificate& certificate : bundle.certificates) {
    if (identity_of(certificate).kind != Kind::ca) {
      sorted.own.push_back(certificate);
    } else if (is_self_signed(certificate)) {
      sorted.roots.push_back(certificate);
    } else {
      sorted.intermediates.push_back(certificate);
    }
  }
  return sorted;
}

std::vector<Certificate> Sorted::authorities() const {
  std::vector<Certificate> all = roots;
  all.insert(all.end(), intermediates.begin(), intermediates.end());
  return all;
}

std::vector<Certificate> authorities_in(const Bundle& ca, const Bundle& own) {
  Bundle both = ca;
  both.certificates.insert(both.certificates.end(), own.certificates.begin(),
                           own.certificates.end());
  return sort_certificates(both).authorities();
}

namespace {

Result<Identity> wanted_identity(const PkiRequestOptions& options) {
  Identity identity;
  if (options.program) {
    identity = {Kind::program, *options.program, {}};
  } else {
    const std::string name = options.host ? *options.host : DSSM_TRY(this_host_name());
    identity = {Kind::host, name, DSSM_TRY(this_host_id(name))};
  }
  DSSM_TRY(check_identity(identity));
  return identity;
}

// The key in the folder; makes both when they are missing.
Result<Key> find_or_make_key(const PkiRequestOptions& options) {
  const std::string path = path_in(options.credentials, kOwnKey);
  Result<Key> there = read_key(path);
  if (there || there.error().code != Errc::not_found) return there;
  DSSM_TRY(create_folder(options.credentials));
  const Key key = DSSM_TRY(make_key());
  const bool created = DSSM_TRY(create_key_file(path, key));
  if (!created) return read_key(path);  // another process was faster
  note(options, fmt::format("made the private key '{}'", path));
  return key;
}

template <class Object>
std::string pem_of_all(const std::vector<Object>& objects) {
  std::string text;
  for (const Object& object : objects) text += pem_of(object);
  return text;
}

Error wrong_bundle(const PkiInstallOptions& options, std::string_view reason) {
  return {Errc::protocol, fmt::format("install '{}': {}", options.bundle, reason)};
}

// Those of `bundle` and those that are there: of each CA the newest. An older list is never
// installed over a newer one, because certificates would then be valid again.
Result<std::vector<RevocationList>> lists_to_install(const PkiInstallOptions& options,
                                                     const Bundle& bundle,
                                                     const std::vector<Certificate>& authorities) {
  for (const RevocationList& list : bundle.lists) {
    if (std::none_of(authorities.begin(), authorities.end(),
                     [&](const Certificate& ca) { return is_signed_by(list, ca); })) {
      return wrong_bundle(options, fmt::format("its revocation list of '{}' was not signed by the "
                                               "CA of this PC; is it of another vehicle?",
                                               escaped(issuer_of(list))));
    }
  }
  const std::string path = path_in(options.credentials, kRevoked);
  std::vector<RevocationList> all = DSSM_TRY(read_bundle_if_there(path)).lists;
  all.insert(all.end(), bundle.lists.begin(), bundle.lists.end());
  std::vector<RevocationList> newest = newest_lists(authorities, all);
  // By their keys: while one CA replaces another, both may have the same name.
  for (const Certificate& ca : authorities) {
    const auto own = std::find_if(newest.begin(), newest.end(), [&](const RevocationList& list) {
      return is_signed_by(list, ca);
    });
    if (own == newest.end() && !newest.empty()) {
      return wrong_bundle(options,
                          fmt::format("there is no revocation list of '{}', and dssmd needs one of "
                                      "each CA; append 'revoked.crl' of that CA to what is "
                                      "installed",
                                      escaped(identity_of(ca).name)));
    }
    for (const RevocationList& list : bundle.lists) {
      if (!is_signed_by(list, ca) || !is_newer(*own, list)) continue;
      note(options, fmt::format("'{}' is newer than the revocation list with number {}; it is kept",
                                path, number_of(list)));
    }
  }
  return newest;
}

Result<void> write_lists(const PkiInstallOptions& options,
                         const std::vector<RevocationList>& lists) {
  if (lists.empty()) return {};
  return replace_file(path_in(options.credentials, kRevoked), pem_of_all(lists), kPublicMode);
}

Result<void> install_list(const PkiInstallOptions& options, const Bundle& bundle) {
  const Bundle ca =
      DSSM_TRY(read_bundle(path_in(options.credentials, kCaCertificate)),
               "install a revocation list: it needs the CA that is installed with a certificate");
  const Bundle own = DSSM_TRY(read_bundle_if_there(path_in(options.credentials, kOwnCertificate)));
  const auto lists = DSSM_TRY(lists_to_install(options, bundle, authorities_in(ca, own)));
  return write_lists(options, lists);
}

Result<void> check_own(const PkiInstallOptions& options, const Sorted& sorted) {
  if (sorted.own.size() != 1) {
    return wrong_bundle(options, fmt::format("it has {} certificates that are not of a CA, instead "
                                             "of 1; 'dssmctl pki issue' makes a bundle",
                                             sorted.own.size()));
  }
  const Certificate& own = sorted.own.front();
  const std::string path = path_in(options.credentials, kOwnKey);
  const Key key = DSSM_TRY(read_key(path),
                           "install a certificate: its private key is made by "
                           "'dssmctl pki request' on this PC");
  if (!have_same_key(own, key)) {
    return wrong_bundle(options, fmt::format("the certificate of {} does not belong to '{}'; is it "
                                             "of another PC?",
                                             identity_of(own).str(), path));
  }
  if (sorted.roots.empty()) return wrong_bundle(options, "it has no certificate of a CA");
  if (Result<void> checked = check_signature(own, sorted.intermediates, sorted.roots); !checked) {
    return wrong_bundle(options, fmt::format("the certificate of {} was not signed by the CA in "
                                             "the bundle: {}",
                                             identity_of(own).str(), checked.error().message));
  }
  if (end_of(own) < std::time(nullptr)) {
    return wrong_bundle(options, fmt::format("the certificate ended on {}; renew it, or correct "
                                             "this PC's clock",
                                             date_text(end_of(own))));
  }
  return {};
}

Result<void> install_all(const PkiInstallOptions& options, const Bundle& bundle) {
  const Sorted sorted = sort_certificates(bundle);
  DSSM_TRY(check_own(options, sorted));
  const auto lists = DSSM_TRY(lists_to_install(options, bundle, sorted.authorities()));
  const Certificate& own = sorted.own.front();
  if (is_revoked(own, lists)) {
    return wrong_bundle(options, fmt::format("the certificate of {} was revoked; make a new "
                                             "request",
                                             identity_of(own).str()));
  }
  // The CA first: a PC that loses power in between still accepts certificates of the same CA.
  DSSM_TRY(replace_file(path_in(options.credentials, kCaCertificate), pem_of_all(sorted.roots),
                        kPublicMode));
  DSSM_TRY(write_lists(options, lists));
  DSSM_TRY(replace_file(path_in(options.credentials, kOwnCertificate),
                        pem_of(own) + pem_of_all(sorted.intermediates), kPublicMode));
  note(options, fmt::format("installed the certificate of {} by '{}', valid until {}",
                            identity_of(own).str(), identity_of(sorted.roots.front()).name,
                            date_text(end_of(own))));
  return {};
}

}  // namespace
}  // namespace pki

Result<void> run(const PkiRequestOptions& options, Output& out) {
  const pki::Identity identity = DSSM_TRY(pki::wanted_identity(options));
  const pki::Key key = DSSM_TRY(pki::find_or_make_key(options));
  const std::string request = DSSM_TRY(pki::make_request(key, identity));
  return pki::put_out(request, options.out, out);
}

Result<void> run(const PkiInstallOptions& options, Output&) {
  const pki::Bundle bundle = DSSM_TRY(pki::read_bundle(options.bundle));
  const UniqueFd lock = DSSM_TRY(pki::lock_folder(options.credentials));
  DSSM_TRY(bundle.certificates.empty() ? pki::install_list(options, bundle)
                                       : pki::install_all(options, bundle));
  pki::note(options, "if dssmd runs here, let it read this: systemctl reload dssmd");
  return {};
}

}  // namespace dssm::ctl
