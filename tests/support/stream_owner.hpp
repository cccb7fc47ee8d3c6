// SPDX-License-Identifier: Apache-2.0
//
// The dssmd of the host "fake", which has one stream and sends its samples in any order that a test
// says, as a network does that is slower than the stream.
#pragma once

#include <condition_variable>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/network_peer.hpp"

namespace dssm::test {

class StreamOwner {
 public:
  StreamOwner();
  StreamOwner(const StreamOwner&) = delete;
  StreamOwner& operator=(const StreamOwner&) = delete;
  ~StreamOwner();

  const std::string& address() const { return address_; }
  // "late:0@fake". Its samples have 8 bytes.
  std::string stream() const { return info_.id.str(); }

  // Sends that sample, stamped with the present time, once the other dssmd has subscribed.
  void send_sample(Tid tid);

 private:
  void accept();
  void serve(NetworkPeer& peer);
  net::Frame answer(const net::Frame& request, NetworkPeer& peer);

  UniqueFd listener_;
  std::string address_;
  StreamInfo info_;
  std::mutex mutex_;  // guards what follows, and sending
  std::condition_variable subscribed_;
  NetworkPeer* channel_ = nullptr;  // the one that has subscribed last
  std::vector<int> sockets_;        // of the connections; -1: ended
  std::vector<std::thread> connections_;
  std::thread accepting_;  // last: it uses the others
};

// A base of tests whose dssmd connects to it: it is made before that.
struct WithStreamOwner {
  StreamOwner owner;
};

}  // namespace dssm::test
