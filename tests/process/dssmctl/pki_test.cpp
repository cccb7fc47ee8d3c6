// SPDX-License-Identifier: Apache-2.0
//
// dssmctl pki as people use it, with the program openssl as the judge of what it makes.
#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "tests/process/dssmctl/ctl_test.hpp"
#include "tests/support/authority.hpp"

namespace dssm::test {
namespace {

std::string contents(const std::string& path) {
  std::ifstream file(path);
  return {std::istreambuf_iterator<char>(file), {}};
}

bool has_openssl() { return run({"sh", "-c", "command -v openssl"}).exit_status == 0; }

#define NEEDS_OPENSSL() \
  if (!has_openssl()) GTEST_SKIP() << "there is no program openssl"

struct Pki : testing::Test {
  Pki() { must({"init", "--ca", ca_, "--name", "truck"}); }
  ~Pki() override { remove_tree(folder_); }
  void SetUp() override {
    if (contents("/etc/machine-id").empty()) GTEST_SKIP() << "this machine has no id";
  }

  Finished pki(std::vector<std::string> words, const std::string& input = {}) {
    words.insert(words.begin(), {dssmctl_path(), "pki"});
    return run(words, {"DSSM_SOCKET=/nonexistent"}, input);
  }

  // Its standard output when it succeeds; otherwise the test fails.
  std::string must(std::vector<std::string> words, const std::string& input = {}) {
    const Finished finished = pki(words, input);
    EXPECT_EQ(finished.exit_status, 0) << Json(words) << finished.err;
    return finished.out;
  }

  // Fails with one line that contains `part`.
  void refused(std::vector<std::string> words, const std::string& part,
               const std::string& input = {}, int status = 1) {
    const Finished finished = pki(words, input);
    EXPECT_EQ(finished.exit_status, status) << Json(words);
    EXPECT_EQ(finished.out, "");
    EXPECT_TRUE(contains(finished.err, part)) << finished.err;
    EXPECT_EQ(std::count(finished.err.begin(), finished.err.end(), '\n'), 1) << finished.err;
  }

  std::string request(const std::string& credentials, const std::string& kind = "--host",
                      const std::string& name = "pc2") {
    return must({"request", "--credentials", credentials, kind, name});
  }
  std::string issue(const std::string& csr, std::vector<std::string> more = {}) {
    more.insert(more.begin(), {"issue", "-", "--ca", ca_});
    return must(more, csr);
  }
  void install(const std::string& bundle) {
    must({"install", "-", "--credentials", host_}, bundle);
  }

  // What `show --json` prints, whatever its exit status is.
  Json show(const std::string& path) { return Json::parse(pki({"show", path, "--json"}).out); }
  std::string own_state() { return show(host_)["certificates"][0]["state"]; }

  std::string folder_ = make_temp_dir();
  std::string ca_ = folder_ + "/ca";
  std::string host_ = folder_ + "/host";
};

mode_t mode_of(const std::string& path) {
  struct stat status {};
  EXPECT_EQ(::lstat(path.c_str(), &status), 0) << path;
  return status.st_mode & 07777;
}

// openssl's verdict on own.crt, with the CA and the list that are installed.
Finished verify(const std::string& host, const std::string& purpose) {
  return run({"openssl", "verify", "-x509_strict", "-crl_check", "-purpose", purpose, "-CAfile",
              host + "/ca.crt", "-CRLfile", host + "/revoked.crl", host + "/own.crt"});
}

std::string x509_text(const std::string& path) {
  return run({"openssl", "x509", "-noout", "-text", "-in", path}).out;
}

TEST_F(Pki, MakesCertificatesThatOpensslAcceptsUntilTheyAreRevoked) {
  NEEDS_OPENSSL();
  const std::string csr = request(host_);
  const std::string bundle = issue(csr);
  install(bundle);
  EXPECT_EQ(own_state(), "ok");
  EXPECT_EQ(pki({"show", host_}).exit_status, 0);
  for (const char* purpose : {"sslserver", "sslclient"}) {
    const Finished verdict = verify(host_, purpose);
    EXPECT_EQ(verdict.exit_status, 0) << verdict.out << verdict.err;
  }
  const std::string list = must({"revoke", "pc2", "--ca", ca_});
  EXPECT_EQ(own_state(), "ok");  // until the list is installed
  install(list);
  EXPECT_EQ(own_state(), "revoked");
  EXPECT_EQ(pki({"show", host_}).exit_status, 1);
  const Finished verdict = verify(host_, "sslserver");
  EXPECT_NE(verdict.exit_status, 0);
  EXPECT_TRUE(contains(verdict.err, "certificate revoked")) << verdict.err;
}

TEST_F(Pki, WritesWhatTheDocumentSays) {
  NEEDS_OPENSSL();
  install(issue(request(host_)));
  const std::string host = x509_text(host_ + "/own.crt");
  const std::string id = show(host_)["certificates"][0]["host_id"];
  EXPECT_EQ(id.size(), 32U);
  for (const std::string& part :
       {std::string("Issuer: CN = DSSM CA of truck"), std::string("Subject: CN = pc2\n"),
        std::string("Not Before: Jan  1 00:00:00 1970 GMT"), std::string("Public-Key: (256 bit)"),
        std::string("NIST CURVE: P-256"), std::string("Signature Algorithm: ecdsa-with-SHA256"),
        std::string("X509v3 Basic Constraints: critical\n                CA:FALSE"),
        std::string("X509v3 Key Usage: critical\n                Digital Signature\n"),
        std::string("TLS Web Server Authentication, TLS Web Client Authentication"),
        "DNS:pc2, URI:urn:dssm:host-id:" + id + "\n", std::string("X509v3 Subject Key Identifier"),
        std::string("X509v3 Authority Key Identifier")}) {
    EXPECT_TRUE(contains(host, part)) << part << host;
  }
  const std::string ca = x509_text(host_ + "/ca.crt");
  for (const char* part :
       {"Subject: CN = DSSM CA of truck\n", "Not Before: Jan  1 00:00:00 1970",
        "X509v3 Basic Constraints: critical\n                CA:TRUE, pathlen:0",
        "X509v3 Key Usage: critical\n                Certificate Sign, CRL Sign\n"}) {
    EXPECT_TRUE(contains(ca, part)) << part << ca;
  }
  const std::string list =
      run({"openssl", "crl", "-noout", "-text", "-in", host_ + "/revoked.crl"}).out;
  for (const char* part : {"Last Update: Jan  1 00:00:00 1970", "Next Update: Dec 31 23:59:59 9999",
                           "X509v3 CRL Number: \n                1\n"}) {
    EXPECT_TRUE(contains(list, part)) << part << list;
  }
  install(issue(request(host_, "--program", "viewer")));
  const std::string program = x509_text(host_ + "/own.crt");
  EXPECT_TRUE(contains(program, "URI:urn:dssm:program:viewer\n")) << program;
  EXPECT_TRUE(contains(program, "TLS Web Client Authentication\n")) << program;
  EXPECT_FALSE(contains(program, "Server")) << program;
}

TEST_F(Pki, KeepsKeysFromOthers) {
  request(host_);
  EXPECT_EQ(mode_of(ca_), 0700U);
  EXPECT_EQ(mode_of(ca_ + "/ca.key"), 0600U);
  EXPECT_EQ(mode_of(host_ + "/own.key"), 0600U);
  install(issue(request(host_)));
  for (const char* name : {"/own.crt", "/ca.crt", "/revoked.crl"}) {
    EXPECT_EQ(mode_of(host_ + name), 0644U) << name;
  }
}

TEST_F(Pki, InitRefusesAFolderThatHasACaAndChangesNothing) {
  const std::string key = contents(ca_ + "/ca.key");
  refused({"init", "--ca", ca_, "--name", "other"}, "'" + ca_ + "' is not empty");
  EXPECT_EQ(contents(ca_ + "/ca.key"), key);
  const std::filesystem::directory_iterator begin(folder_), end;
  EXPECT_EQ(std::distance(begin, end), 1);  // no temporary folder is left
  refused({"init", "--ca", folder_ + "/b", "--name", "a/b"}, "'a/b'", {}, 2);
}

TEST_F(Pki, RequestKeepsTheKeyThatIsThere) {
  const std::string csr = request(host_);
  const std::string key = contents(host_ + "/own.key");
  EXPECT_TRUE(key.starts_with("-----BEGIN PRIVATE KEY-----"));
  request(host_);
  EXPECT_EQ(contents(host_ + "/own.key"), key);
  EXPECT_FALSE(contains(csr, "PRIVATE"));
  const std::string out = folder_ + "/pc2.csr";
  EXPECT_EQ(must({"request", "--credentials", host_, "--host", "pc2", "--out", out}), "");
  EXPECT_TRUE(contents(out).starts_with("-----BEGIN CERTIFICATE REQUEST-----"));
  refused({"request", "--credentials", host_, "--host", "pc_2"}, "'pc_2'", {}, 2);
  refused({"request", "--credentials", host_, "--program", ""}, "''", {}, 2);
}

TEST_F(Pki, InstallRefusesWhatDoesNotFit) {
  const std::vector<std::string> install_here = {"install", "-", "--credentials", host_};
  const std::string csr = request(host_);
  const std::string bundle = issue(csr);
  const std::string own = bundle.substr(0, bundle.find("-----BEGIN", 1));

  refused(install_here, "does not belong to", issue(request(folder_ + "/pc3", "--host", "pc3")));
  refused(install_here, "no certificate of a CA", own);
  const std::string other_ca = folder_ + "/ca2";
  must({"init", "--ca", other_ca, "--name", "truck"});
  refused(install_here, "not signed by the CA in the bundle", own + contents(other_ca + "/ca.crt"));
  refused(install_here, "revocation list of 'DSSM CA of truck' was not signed",
          own + contents(ca_ + "/ca.crt") + contents(other_ca + "/revoked.crl"));
  refused(install_here, "neither a certificate nor", "nonsense");
  refused(install_here, "it is a request; `dssmctl pki issue`", csr);
  refused(install_here, "ca.crt", contents(ca_ + "/revoked.crl"));
  EXPECT_FALSE(std::filesystem::exists(host_ + "/own.crt"));

  install(bundle);
  refused(install_here, "was not signed by the CA of this PC", contents(other_ca + "/revoked.crl"));
  refused({"install", "-", "--credentials", folder_ + "/none"}, folder_ + "/none", bundle);
}

TEST_F(Pki, InstallRefusesACertificateThatHasEnded) {
  NEEDS_OPENSSL();
  const std::string csr = folder_ + "/pc2.csr";
  std::ofstream(csr) << request(host_);
  const Finished made = run({"openssl", "x509", "-req", "-in", csr, "-CA", ca_ + "/ca.crt",
                             "-CAkey", ca_ + "/ca.key", "-CAcreateserial", "-days", "-1"});
  ASSERT_EQ(made.exit_status, 0) << made.err;
  refused({"install", "-", "--credentials", host_}, "clock", made.out + contents(ca_ + "/ca.crt"));
}

// dssmd would not start with it.
TEST_F(Pki, InstallRefusesListsOfSomeOfItsCasOnly) {
  const std::string other_ca = folder_ + "/ca2";
  must({"init", "--ca", other_ca, "--name", "truck2"});
  const std::string bundle = issue(request(host_)) + contents(other_ca + "/ca.crt");
  refused({"install", "-", "--credentials", host_}, "no revocation list of 'DSSM CA of truck2'",
          bundle);
  EXPECT_FALSE(std::filesystem::exists(host_ + "/ca.crt"));
  install(bundle + contents(other_ca + "/revoked.crl"));
  EXPECT_EQ(show(host_)["revocation_lists"].size(), 2u);
}

// While one CA replaces another.
TEST_F(Pki, InstallTellsCasOfOneNameApart) {
  const std::string other_ca = folder_ + "/ca2";
  must({"init", "--ca", other_ca, "--name", "truck"});
  const std::string bundle = issue(request(host_)) + contents(other_ca + "/ca.crt");
  refused({"install", "-", "--credentials", host_}, "no revocation list of", bundle);
  install(bundle + contents(other_ca + "/revoked.crl"));
  const std::string newer = must({"revoke", "pc2", "--ca", ca_});
  const Finished finished =
      pki({"install", "-", "--credentials", host_}, newer + contents(other_ca + "/revoked.crl"));
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  EXPECT_FALSE(contains(finished.err, "it is kept")) << finished.err;
  EXPECT_EQ(show(host_)["revocation_lists"].size(), 2u);
  EXPECT_EQ(own_state(), "revoked");
}

TEST_F(Pki, InstallKeepsTheListsOfIntermediateCas) {
  Authority root("root"), below("below", &root);
  const long serial = below.issue(Authority::host("pc2"), host_);
  const auto list_of = [&](Authority& ca, long revoked) {
    ca.write_revoked(revoked, folder_);
    return contents(folder_ + "/revoked.crl");
  };
  const std::string of_root = list_of(root, 99), of_below = list_of(below, serial);
  refused({"install", "-", "--credentials", host_}, "no revocation list of 'below'", of_root);
  install(of_root + of_below);
  install(of_root);
  install(of_below);
  const Json lists = show(host_)["revocation_lists"];
  ASSERT_EQ(lists.size(), 2u);
  for (const Json& list : lists) EXPECT_EQ(list["ok"], true) << list;
  EXPECT_EQ(own_state(), "revoked");
}

TEST_F(Pki, ACaWorksOnlyWithTheListOfWhatItRevoked) {
  const std::string csr = request(host_);
  const std::string list = ca_ + "/revoked.crl";
  const std::string other_ca = folder_ + "/ca2";
  must({"init", "--ca", other_ca, "--name", "truck"});
  std::ofstream(list) << contents(other_ca + "/revoked.crl");
  refused({"issue", "-", "--ca", ca_}, "has not signed '" + list, csr);
  std::filesystem::remove(list);
  refused({"issue", "-", "--ca", ca_}, list, csr);
  refused({"revoke", "pc2", "--ca", ca_}, list);
  refused({"issue", "-", "--ca", folder_ + "/none"}, "dssmctl pki init", csr);
}

TEST_F(Pki, InstallKeepsTheNewerRevocationList) {
  const std::string bundle = issue(request(host_));
  install(bundle);
  must({"revoke", "pc2", "--ca", ca_});
  const std::string newer = contents(ca_ + "/revoked.crl");
  install(newer);
  const std::string older = bundle.substr(bundle.rfind("-----BEGIN"));
  const Finished finished = pki({"install", "-", "--credentials", host_}, older);
  EXPECT_TRUE(contains(finished.err, "it is kept")) << finished.err;
  EXPECT_EQ(contents(host_ + "/revoked.crl"), newer);
  // Nor does it come back with the bundle, whose certificate was revoked meanwhile.
  const Finished again = pki({"install", "-", "--credentials", host_}, bundle);
  EXPECT_EQ(again.exit_status, 1);
  EXPECT_TRUE(contains(again.err, "was revoked")) << again.err;
  EXPECT_EQ(contents(host_ + "/revoked.crl"), newer);
}

TEST_F(Pki, IssueWarnsWhenANameHasAnotherKey) {
  issue(request(host_));
  const std::vector<std::string> again = {"issue", "-", "--ca", ca_};
  EXPECT_FALSE(contains(pki(again, request(host_)).err, "warning"));
  const std::string other = request(folder_ + "/other");
  const Finished finished = pki(again, other);
  EXPECT_EQ(finished.exit_status, 0);
  EXPECT_TRUE(contains(finished.err, "warning")) << finished.err;
  must({"revoke", "pc2", "--ca", ca_});
  EXPECT_FALSE(contains(pki(again, request(host_)).err, "warning"));
}

// Whether it ends in so many days; the first of them has begun.
bool is_in_days(const Json& certificate, int days) {
  return certificate["days_left"] == days || certificate["days_left"] == days - 1;
}

TEST_F(Pki, IssueEndsWithTheCa) {
  const std::string csr = request(host_);
  refused({"issue", "-", "--ca", ca_, "--days", "7301"}, "the CA itself ends", csr);
  const std::string bundle = issue(csr, {"--days", "7299"});
  install(bundle);
  EXPECT_TRUE(is_in_days(show(host_)["certificates"][0], 7299));
}

TEST_F(Pki, RenewIssuesForTheSameKeyAndHost) {
  install(issue(request(host_), {"--days", "20"}));
  const Json before = show(host_)["certificates"][0];
  EXPECT_EQ(before["state"], "expires soon");
  EXPECT_EQ(pki({"show", host_}).exit_status, 0);
  install(must({"renew", "pc2", "--ca", ca_, "--days", "100"}));
  const Json after = show(host_)["certificates"][0];
  EXPECT_EQ(after["state"], "ok");
  EXPECT_TRUE(is_in_days(after, 100));
  EXPECT_EQ(after["host_id"], before["host_id"]);
  EXPECT_NE(after["serial"], before["serial"]);
  refused({"renew", "pc3", "--ca", ca_}, "'pc3'");
  must({"revoke", after["serial"], "--ca", ca_});
  refused({"renew", "pc2", "--ca", ca_}, "was revoked");
}

TEST_F(Pki, RevokeTakesOneCertificateOrAllOfAName) {
  issue(request(host_));
  issue(request(host_));
  issue(request(host_, "--program", "viewer"));
  const auto states = [&] {
    std::vector<std::string> all;
    const Json shown = show(ca_);
    for (const Json& row : shown["certificates"]) all.push_back(row["state"]);
    return all;
  };
  using States = std::vector<std::string>;
  const std::string serial = show(ca_)["certificates"][1]["serial"];
  must({"revoke", serial, "--ca", ca_});
  EXPECT_EQ(states(), (States{"ok", "revoked", "ok", "ok"}));
  const std::string list = must({"revoke", "pc2", "--ca", ca_});
  EXPECT_EQ(states(), (States{"ok", "revoked", "revoked", "ok"}));
  EXPECT_EQ(show(ca_)["revocation_lists"][0]["number"], "3");
  EXPECT_EQ(show(ca_)["revocation_lists"][0]["revoked"], 2);
  EXPECT_EQ(must({"revoke", "pc2", "--ca", ca_}), list);  // again: the same list
  EXPECT_EQ(pki({"show", ca_}).exit_status, 0);           // what was revoked belongs there
  refused({"revoke", "pc9", "--ca", ca_}, "'pc9'");
}

TEST_F(Pki, RevokeTakesWhatHasEndedToo) {
  NEEDS_OPENSSL();
  const std::string csr = folder_ + "/pc2.csr";
  std::ofstream(csr) << request(host_);
  const Finished made =
      run({"openssl", "x509", "-req", "-in", csr, "-CA", ca_ + "/ca.crt", "-CAkey", ca_ + "/ca.key",
           "-set_serial", "4711", "-days", "-1", "-out", ca_ + "/issued/ended.pem"});
  ASSERT_EQ(made.exit_status, 0) << made.err;
  must({"revoke", "pc2", "--ca", ca_});
  EXPECT_EQ(show(ca_)["revocation_lists"][0]["revoked"], 1);
}

TEST_F(Pki, RevocationsAtTheSameTimeAreAllInTheList) {
  const std::vector<std::string> names = {"a", "b", "c", "d", "e", "f"};
  for (const std::string& name : names) issue(request(host_, "--program", name));
  std::vector<pid_t> running;
  for (const std::string& name : names) {
    running.push_back(
        start({dssmctl_path(), "pki", "revoke", name, "--ca", ca_, "--out", folder_ + "/" + name}));
  }
  for (const pid_t pid : running) EXPECT_EQ(wait_for(pid), 0);
  EXPECT_EQ(show(ca_)["revocation_lists"][0]["revoked"], names.size());
  EXPECT_EQ(show(ca_)["revocation_lists"][0]["number"], std::to_string(names.size() + 1));
}

TEST_F(Pki, ShowStatesWhatIsWrong) {
  refused({"show", folder_ + "/none"}, folder_ + "/none");
  request(host_);
  refused({"show", host_}, "own.crt");
  install(issue(request(host_)));
  const std::string key = contents(host_ + "/own.key");
  request(folder_ + "/other");
  std::filesystem::copy_file(folder_ + "/other/own.key", host_ + "/own.key",
                             std::filesystem::copy_options::overwrite_existing);
  EXPECT_EQ(own_state(), "does not belong to own.key");
  std::filesystem::remove(host_ + "/own.key");
  EXPECT_EQ(own_state(), "key missing");
  EXPECT_EQ(show(host_)["ok"], false);
  std::ofstream(host_ + "/own.key") << key;
  EXPECT_EQ(own_state(), "ok");
  const std::string other_ca = folder_ + "/ca2";
  must({"init", "--ca", other_ca, "--name", "truck"});
  std::ofstream(host_ + "/ca.crt") << contents(other_ca + "/ca.crt");
  EXPECT_EQ(own_state(), "not signed by ca.crt");
  const Json file = show(host_ + "/own.crt");  // nothing to compare with
  EXPECT_EQ(file["certificates"][0]["state"], "ok");
}

TEST_F(Pki, ShowStatesWhatHasEnded) {
  NEEDS_OPENSSL();
  const std::string csr = folder_ + "/pc2.csr", path = host_ + "/own.crt";
  std::ofstream(csr) << request(host_);
  const Finished made = run({"openssl", "x509", "-req", "-in", csr, "-signkey", host_ + "/own.key",
                             "-days", "-1", "-out", path});
  ASSERT_EQ(made.exit_status, 0) << made.err;
  const Finished finished = pki({"show", path});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_TRUE(contains(finished.out, "expired")) << finished.out;
  const int days_left = show(path)["certificates"][0]["days_left"];
  EXPECT_TRUE(days_left == -1 || days_left == -2) << days_left << ": a day ago, and some seconds";
}

}  // namespace
}  // namespace dssm::test
