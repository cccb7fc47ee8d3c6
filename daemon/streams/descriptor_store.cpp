// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/descriptor_store.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <optional>
#include <string_view>
#include <utility>

#include "daemon/base/message_ids.hpp"
#include "daemon/streams/memory_files.hpp"

namespace dssm::daemon {
namespace {

constexpr const char* kClockName = "#";
constexpr std::string_view kDigits =
    "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz-_";
constexpr std::uint32_t kNames = 64 * 64 * 64;
static_assert(kDigits.size() == 64 && kNames > DescriptorStore::kMaxDescriptors);

}  // namespace

DescriptorStore::DescriptorStore(Registry& registry, PlaybackClockOwner& clock,
                                 ServiceManager& manager, Logger& logger,
                                 std::size_t max_descriptors)
    : registry_(registry),
      clock_(clock),
      manager_(manager),
      logger_(logger),
      max_descriptors_(max_descriptors) {}

DescriptorStore::~DescriptorStore() {
  clock_.on_new_clock({});
  registry_.remove_observer(*this);
}

bool DescriptorStore::restore_untrusted(std::vector<NamedDescriptor> kept, bool store_is_there) {
  std::map<std::string, std::vector<UniqueFd>> groups;
  for (NamedDescriptor& one : kept) groups[one.name].push_back(std::move(one.fd));
  bool all_is_here =
      (store_is_there || !groups.empty()) && kept.size() + Stream::kKept <= max_descriptors_;
  for (auto& [name, fds] : groups) {
    switch (take_back(name, std::move(fds))) {
      case Taken::good:
        break;
      case Taken::bad:
        all_is_here = false;
        [[fallthrough]];
      case Taken::removed_stream:
        manager_.forget(name);
        break;
    }
  }
  if (!entries_.empty()) {
    logger_.notice(
        fmt::format("took {} streams back that the service manager kept", entries_.size()),
        {.message_id = message_id::kRestored});
  }
  registry_.add_observer(*this);
  clock_.on_new_clock([this](int fd) { keep_clock(fd); });
  return !all_is_here;
}

DescriptorStore::Taken DescriptorStore::take_back(const std::string& name,
                                                  std::vector<UniqueFd> fds) {
  const std::size_t count = fds.size();
  OfferedFiles files;
  for (UniqueFd& fd : fds) {
    switch (kind_of_untrusted(fd.get())) {
      case DescriptorKind::ring:
        files.ring = std::move(fd);
        break;
      case DescriptorKind::bell:
        files.bell = std::move(fd);
        break;
      case DescriptorKind::meta:
        files.meta = std::move(fd);
        break;
      case DescriptorKind::playback_clock:
        return take_clock_back(std::move(fd));
      case DescriptorKind::doorbell:
      case DescriptorKind::other:
        break;
    }
  }
  const auto drop = [&](const std::string& why) {
    logger_.warning(fmt::format("drop what the service manager kept under '{}': {}; if it was a "
                                "stream's, the programs that hold it give it back",
                                name, why),
                    {.message_id = message_id::kStoredDropped});
    return Taken::bad;
  };
  if (files.ring) {
    // After an update this is the reason, whatever else has another form.
    const auto mapped =
        ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_only);
    if (!mapped) return drop(mapped.error().message);
  }
  if (!files.ring || !files.bell || !files.meta) {
    return drop("it is not the ring, bell and meta file of a stream");
  }
  Result<std::shared_ptr<Stream>> stream = registry_.adopt_stored_untrusted(std::move(files));
  if (!stream && stream.error().code == Errc::not_found) return Taken::removed_stream;
  if (!stream) return drop(stream.error().message);
  names_.insert(name);
  descriptors_ += count;
  entries_.emplace(stream->get(), Entry{name, count});
  return Taken::good;
}

DescriptorStore::Taken DescriptorStore::take_clock_back(UniqueFd clock) {
  const Result<void> adopted = clock_.adopt_untrusted(std::move(clock));
  if (adopted) {
    ++descriptors_;
    return Taken::good;
  }
  logger_.warning("drop the playback clock that the service manager kept: " +
                      adopted.error().message + "; a program that has it open gives it back",
                  {.message_id = message_id::kStoredDropped});
  return Taken::bad;
}

void DescriptorStore::keep_clock(int fd) {
  ++descriptors_;
  manager_.keep(kClockName, {fd});
}

void DescriptorStore::on_stream_added(const Stream& stream) {
  if (!manager_.is_there()) return;
  const std::vector<int> fds = stream.descriptors_to_keep();
  if (descriptors_ + fds.size() > max_descriptors_) {
    if (std::exchange(logged_full_, true)) return;
    return logger_.warning(
        fmt::format(
            "stream '{}' and further ones are not kept while dssmd restarts: {} descriptors are in "
            "the service manager's store already; the programs that hold these streams give them "
            "back, remove (dssmctl rm) those that are not needed",
            stream.id().str(), max_descriptors_),
        {.stream = stream.id().str(), .message_id = message_id::kStoreFull});
  }
  const Entry entry{new_name(), fds.size()};
  descriptors_ += fds.size();
  manager_.keep(entry.name, fds);
  entries_.emplace(&stream, entry);
}

void DescriptorStore::on_stream_removed(const Stream& stream) {
  const auto entry = entries_.extract(&stream);
  if (!entry) return;
  manager_.forget(entry.mapped().name);
  names_.erase(entry.mapped().name);
  descriptors_ -= entry.mapped().descriptors;
  logged_full_ = false;
}

// An unused name; there are more names than descriptors in the store.
std::string DescriptorStore::new_name() {
  for (;;) {
    const std::uint32_t number = next_++ % kNames;
    std::string name = {kDigits[number >> 12], kDigits[number >> 6 & 63], kDigits[number & 63]};
    if (names_.insert(name).second) return name;
  }
}

}  // namespace dssm::daemon
