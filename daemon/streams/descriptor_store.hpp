// SPDX-License-Identifier: Apache-2.0
//
// Keeps the streams of this host, and the playback clock, in the service manager's descriptor
// store: a restarted dssmd has them at once, also streams whose programs have all ended. Which
// program has what open is known from the programs, which reconnect and offer what they hold; an
// offered ring that came from the store is joined.
//
// All descriptors of a stream (ring, bell, meta) have one name of three characters; the
// clock's name is "#". The names of memory files distinguish them. Longer names would be easier to
// read, but systemd passes all of them in one environment variable, and Linux starts no program
// with a variable above 128 KiB: dssmd could never be started again.
//
// Doorbells are not kept: the writers that have them offer them back.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "daemon/base/log.hpp"
#include "daemon/service/service_manager.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

class DescriptorStore final : private StreamObserver {
 public:
  // Beyond, streams are not kept; the unit's FileDescriptorStoreMax= is the same. With the names'
  // length 128,000 bytes of that variable; what is left is for the sockets.
  static constexpr std::size_t kMaxDescriptors = 32'000;

  // All outlive it.
  DescriptorStore(Registry& registry, PlaybackClockOwner& clock, ServiceManager& manager,
                  Logger& logger, std::size_t max_descriptors = kMaxDescriptors);
  DescriptorStore(const DescriptorStore&) = delete;
  DescriptorStore& operator=(const DescriptorStore&) = delete;
  ~DescriptorStore();

  // Takes back what was kept, checked as what programs offer. What is not in order is dropped with
  // a warning. To be called once, before anything is created.
  //   store_is_there  something else came from the store: had there been streams, they would have,
  //                   too
  //   returns         whether streams of an earlier dssmd may be missing: nothing was kept, some of
  //                   it was dropped, or the store was full
  bool restore_untrusted(std::vector<NamedDescriptor> kept, bool store_is_there);

  std::size_t descriptors() const noexcept { return descriptors_; }

 private:
  struct Entry {
    std::string name;
    std::size_t descriptors = 0;
  };
  enum class Taken : unsigned char { good, removed_stream, bad };

  Taken take_back(const std::string& name, std::vector<UniqueFd> fds);
  Taken take_clock_back(UniqueFd clock);
  void keep_clock(int fd);
  void on_stream_added(const Stream& stream) override;
  void on_stream_removed(const Stream& stream) override;
  std::string new_name();

  Registry& registry_;
  PlaybackClockOwner& clock_;
  ServiceManager& manager_;
  Logger& logger_;
  const std::size_t max_descriptors_;
  bool logged_full_ = false;
  std::size_t descriptors_ = 0;
  std::uint32_t next_ = 0;
  std::set<std::string> names_;  // in use
  std::map<const Stream*, Entry> entries_;
};

}  // namespace dssm::daemon
