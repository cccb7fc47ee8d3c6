// SPDX-License-Identifier: Apache-2.0
//
// The program mdns-probe (see mdns_probe.cpp) on a test PC, and what it has found so far.
#pragma once

#include <sys/types.h>

#include <functional>
#include <map>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "tests/support/avahi_host.hpp"

namespace dssm::test {

class Probe {
 public:
  // A host `name` whose id is made of the byte `id`.
  Probe(const AvahiHost& pc, int id, const std::string& name,
        std::vector<std::string> extra = {});  // `pc` has to outlive it
  Probe(const Probe&) = delete;
  Probe& operator=(const Probe&) = delete;
  ~Probe();

  void command(const std::string& line);
  // Lets it end itself; `wait_for_end()` returns when it has.
  void finish();
  void wait_for_end();
  void kill_hard();

  // Reads what it prints until that is so.
  //   returns  false: not within a time that is far beyond all that may be expected; says what it
  //            has printed, and how the Avahi daemon is
  bool until(const std::function<bool()>& so);
  // The newest state contains all of these words.
  bool until_state(const std::vector<std::string>& words);
  bool until_found(int id, const std::string& text);  // its newest line is "found ID " + text
  bool until_lost(int id);

  const std::map<int, std::string>& hosts() const { return hosts_; }  // "NAME open ADDRESS..."
  const std::string& state() const { return state_; }
  bool state_has(const std::string& word) const { return state_.find(word) != std::string::npos; }
  // One of its threads waits in poll(2), as libdbus does for an answer; event loops do not.
  //   returns  false: none within half a minute, or this kernel does not tell
  bool until_it_waits_for_an_answer() const;
  int count(const std::string& beginning) const;  // lines that begin so
  int most_heard() const;  // the greatest number of hosts that it has heard of at a time

 private:
  bool read_line(int timeout_ms);

  const AvahiHost& pc_;
  UniqueFd commands_, output_;
  pid_t pid_ = -1;
  std::string input_;
  std::vector<std::string> lines_;
  std::map<int, std::string> hosts_;
  std::string state_;
};

// raw-avahi (see raw_avahi.cpp) that stays until this ends; has published when it is constructed,
// or does not manage to within half a minute.
class RawService {
 public:
  RawService(const AvahiHost& pc, const std::vector<std::string>& arguments);
  RawService(const RawService&) = delete;
  RawService& operator=(const RawService&) = delete;
  ~RawService();

  bool published() const { return published_; }

 private:
  pid_t pid_ = -1;
  bool published_ = false;
};

// What raw-avahi prints of a service that it waits for ("resolve"), or of a record ("record").
std::string raw_ask(const AvahiHost& pc, const std::string& what, const std::string& name,
                    const std::string& type);

}  // namespace dssm::test
