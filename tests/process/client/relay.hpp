// SPDX-License-Identifier: Apache-2.0
//
// Stands between a program and its dssmd, with descriptors and all, and can say something in
// between in dssmd's name.
#pragma once

#include <atomic>
#include <functional>
#include <mutex>
#include <string>
#include <thread>

#include "core/base/unique_fd.hpp"
#include "local.pb.h"

namespace dssm::test {

class Relay {
 public:
  explicit Relay(std::string dssmd_socket);
  Relay(const Relay&) = delete;
  Relay& operator=(const Relay&) = delete;
  ~Relay();

  const std::string& socket_path() const { return path_; }

  // Asked with each of dssmd's answers, in the relay's thread: what to send right behind it.
  using Behind = std::function<std::string(const local::Response&)>;
  void set_behind(Behind behind);

  void cut();                           // the connection; the program comes back by itself
  int opens() const { return opens_; }  // how many Open requests have passed

 private:
  void run();
  void serve(int program);

  const std::string dssmd_socket_, folder_, path_;
  UniqueFd listener_, cut_, stop_;
  std::mutex mutex_;
  Behind behind_;
  std::atomic<int> opens_ = 0;
  std::thread thread_;
};

}  // namespace dssm::test
