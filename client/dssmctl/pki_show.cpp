// SPDX-License-Identifier: Apache-2.0
//
// dssmctl pki show: the certificates of a folder or file, and what is wrong with them. In the
// folder of a CA only the CA itself can be wrong: certificates that ended or were revoked belong
// there.
#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <optional>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/pki.hpp"
#include "client/dssmctl/pki_files.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace pki {
namespace {

constexpr std::int64_t kSoonDays = 30;

struct Row {
  std::string file;
  Certificate certificate;
  std::int64_t days_left = 0;  // whole ones; negative: it ended
  std::string state;
  bool wrong = false;  // so that it cannot be used
};

struct ListRow {
  std::string file;
  RevocationList list;
  bool wrong = false;  // not signed by the CA beside it
};

struct Shown {
  std::vector<Row> rows;
  std::vector<ListRow> lists;
};

// What certificates are compared with.
struct Surroundings {
  bool has_authorities = true;  // false: a file without any
  std::vector<Certificate> intermediates{}, roots{};
  std::vector<RevocationList> lists{};
  std::time_t now = std::time(nullptr);
};

std::int64_t days_until(std::time_t end, std::time_t now) {
  const std::int64_t seconds = end - now;
  return seconds >= 0 ? seconds / kSecondsPerDay : -((-seconds - 1) / kSecondsPerDay) - 1;
}

std::string file_name(const std::string& path) {
  return std::filesystem::path(path).filename().string();
}

// A row by what the certificate and its surroundings show; keys are checked by check_key().
Row make_row(const std::string& path, const Certificate& certificate, const Surroundings& around) {
  Row row{file_name(path), certificate, days_until(end_of(certificate), around.now), "ok"};
  const auto set_wrong = [&](const char* state) { row.state = state, row.wrong = true; };
  if (around.has_authorities && !check_signature(certificate, around.intermediates, around.roots)) {
    set_wrong("not signed by ca.crt");
  } else if (is_revoked(certificate, around.lists)) {
    set_wrong("revoked");
  } else if (row.days_left < 0) {
    set_wrong("expired");
  } else if (row.days_left < kSoonDays) {
    row.state = "expires soon";
  }
  return row;
}

// Compares the rows with a key, of which at least one of the first `count` has to be.
Result<void> check_key(std::vector<Row>& rows, std::size_t count, const std::string& key_path,
                       const CommonOptions& options) {
  const Result<Key> key = read_key(key_path);
  if (!key && key.error().code == Errc::no_permission) {  // certificates are public, keys are not
    note(options, fmt::format("'{}' is not compared with its certificate: this user may not read "
                              "it",
                              key_path));
    return {};
  }
  if (!key && key.error().code != Errc::not_found) return key.error();
  for (std::size_t i = 0; key && i < count; ++i) {
    if (have_same_key(rows[i].certificate, *key)) return {};
  }
  if (count > 0) {
    rows[0].state = key ? "does not belong to " + file_name(key_path) : "key missing";
    rows[0].wrong = true;
  }
  return {};
}

void add_rows(Shown& shown, const std::string& path, const std::vector<Certificate>& certificates,
              const Surroundings& around) {
  for (const Certificate& certificate : certificates) {
    shown.rows.push_back(make_row(path, certificate, around));
  }
}

// Lists, and which of them count.
void add_lists(Shown& shown, const std::string& path, const std::vector<RevocationList>& lists,
               const std::vector<Certificate>& authorities, Surroundings& around) {
  for (const RevocationList& list : lists) {
    const bool is_signed =
        std::any_of(authorities.begin(), authorities.end(),
                    [&](const Certificate& ca) { return is_signed_by(list, ca); });
    shown.lists.push_back({file_name(path), list, around.has_authorities && !is_signed});
    if (is_signed) around.lists.push_back(list);
  }
}

Result<Shown> credentials_in(const PkiShowOptions& options) {
  const std::string& folder = options.path;
  const std::string own_path = path_in(folder, kOwnCertificate);
  const std::string ca_path = path_in(folder, kCaCertificate);
  const std::string list_path = path_in(folder, kRevoked);
  const Bundle own =
      DSSM_TRY(read_bundle(own_path), "find certificates ('dssmctl pki install' puts them there)");
  const Bundle of_ca = DSSM_TRY(read_bundle_if_there(ca_path));
  const Sorted ca = sort_certificates(of_ca);
  const Bundle lists = DSSM_TRY(read_bundle_if_there(list_path));
  Shown shown;
  Surroundings around{.intermediates = sort_certificates(own).intermediates, .roots = ca.roots};
  add_lists(shown, list_path, lists.lists, authorities_in(of_ca, own), around);
  add_rows(shown, own_path, own.certificates, around);
  const std::size_t own_count = std::min<std::size_t>(shown.rows.size(), 1);  // the first is own
  DSSM_TRY(check_key(shown.rows, own_count, path_in(folder, kOwnKey), options));
  add_rows(shown, ca_path, ca.authorities(), around);
  return shown;
}

Result<Shown> ca_in(const PkiShowOptions& options) {
  const std::string& folder = options.path;
  const std::string ca_path = path_in(folder, kCaCertificate);
  const std::string list_path = path_in(folder, kRevoked);
  const Sorted ca = sort_certificates(DSSM_TRY(read_bundle(ca_path)));
  const Bundle lists = DSSM_TRY(read_bundle(list_path));
  Shown shown;
  Surroundings around{.roots = ca.roots};
  add_lists(shown, list_path, lists.lists, ca.roots, around);
  add_rows(shown, ca_path, ca.authorities(), around);
  DSSM_TRY(check_key(shown.rows, shown.rows.size(), path_in(folder, kCaKey), options));
  for (const Issued& issued : DSSM_TRY(read_issued(folder))) {
    Row row = make_row(issued.path, issued.certificate, around);
    row.wrong = false;
    shown.rows.push_back(std::move(row));
  }
  return shown;
}

Result<Shown> in_file(const PkiShowOptions& options) {
  const Bundle bundle = DSSM_TRY(read_bundle(options.path));
  const Sorted sorted = sort_certificates(bundle);
  Shown shown;
  Surroundings around{.has_authorities = !sorted.roots.empty(),
                      .intermediates = sorted.intermediates,
                      .roots = sorted.roots};
  add_lists(shown, options.path, bundle.lists, sorted.authorities(), around);
  add_rows(shown, options.path, bundle.certificates, around);
  return shown;
}

Result<Shown> find(const PkiShowOptions& options) {
  std::error_code error;
  if (!std::filesystem::is_directory(options.path, error)) return in_file(options);
  const bool is_ca = std::filesystem::exists(path_in(options.path, kIssued), error);
  return is_ca ? ca_in(options) : credentials_in(options);
}

std::string utc_text(std::time_t time) {
  std::tm utc{};
  ::gmtime_r(&time, &utc);
  return fmt::format("{}T{:02}:{:02}:{:02}Z", date_text(time), utc.tm_hour, utc.tm_min, utc.tm_sec);
}

void print_json(const Shown& shown, bool ok, Output& out) {
  Json certificates = Json::array();
  for (const Row& row : shown.rows) {
    const Identity identity = identity_of(row.certificate);
    certificates.push_back({{"file", row.file},
                            {"kind", name_of(identity.kind)},
                            {"name", identity.name},
                            {"host_id", or_null(identity.host_id)},
                            {"serial", serial_of(row.certificate)},
                            {"valid_until", utc_text(end_of(row.certificate))},
                            {"days_left", row.days_left},
                            {"state", row.state},
                            {"ok", !row.wrong}});
  }
  Json lists = Json::array();
  for (const ListRow& row : shown.lists) {
    lists.push_back({{"file", row.file},
                     {"issuer", issuer_of(row.list)},
                     {"number", number_of(row.list)},
                     {"revoked", size_of(row.list)},
                     {"ok", !row.wrong}});
  }
  out.add(json_document({{"certificates", std::move(certificates)},
                         {"revocation_lists", std::move(lists)},
                         {"ok", ok}}));
}

void print_text(const Shown& shown, Output& out) {
  Table table({{"FILE"},
               {"KIND"},
               {"NAME"},
               {"HOST ID"},
               {"SERIAL"},
               {"VALID UNTIL"},
               {"DAYS", Table::Align::right},
               {"STATE"}});
  for (const Row& row : shown.rows) {
    const Identity identity = identity_of(row.certificate);
    table.add_row({escaped(row.file), std::string(name_of(identity.kind)), escaped(identity.name),
                   or_dash(identity.host_id), serial_of(row.certificate),
                   date_text(end_of(row.certificate)), std::to_string(row.days_left), row.state});
  }
  if (!shown.rows.empty()) table.print(out);
  for (const ListRow& row : shown.lists) {
    const std::size_t size = size_of(row.list);
    out.add(fmt::format("{}: revocation list {} of '{}', {} certificate{} revoked{}\n",
                        escaped(row.file), number_of(row.list), escaped(issuer_of(row.list)), size,
                        size == 1 ? "" : "s", row.wrong ? "; not signed by ca.crt" : ""));
  }
}

template <class Rows>
auto count_wrong(const Rows& rows) {
  return std::count_if(rows.begin(), rows.end(), [](const auto& row) { return row.wrong; });
}

}  // namespace
}  // namespace pki

Result<void> run(const PkiShowOptions& options, Output& out) {
  const pki::Shown shown = DSSM_TRY(pki::find(options));
  const auto wrong = pki::count_wrong(shown.rows) + pki::count_wrong(shown.lists);
  options.json ? pki::print_json(shown, wrong == 0, out) : pki::print_text(shown, out);
  if (wrong == 0) return {};
  return Error{Errc::protocol,
               fmt::format("{} of the certificates and lists in '{}' cannot be used; see their "
                           "state",
                           wrong, options.path)};
}

}  // namespace dssm::ctl
