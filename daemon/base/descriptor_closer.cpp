// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/descriptor_closer.hpp"

#include <deque>
#include <mutex>
#include <thread>
#include <utility>

#include "core/base/quiet_thread.hpp"

namespace dssm::daemon {

struct DescriptorCloser::Shared {
  std::mutex mutex;
  std::deque<std::vector<UniqueFd>> groups;  // the first one is being closed
  bool is_running = false;
};

DescriptorCloser::DescriptorCloser() : shared_(std::make_shared<Shared>()) {}

void DescriptorCloser::close(std::vector<UniqueFd> group) {
  {
    const std::lock_guard lock(shared_->mutex);
    shared_->groups.push_back(std::move(group));
  }
  go_on();
}

std::size_t DescriptorCloser::unclosed() const {
  const std::lock_guard lock(shared_->mutex);
  return shared_->groups.size();
}

void DescriptorCloser::go_on() {
  const std::lock_guard lock(shared_->mutex);
  if (shared_->is_running || shared_->groups.empty()) return;
  Result<std::thread> thread =
      quiet_thread("closing descriptors", [shared = shared_] { work(*shared); });
  if (!thread) return;
  shared_->is_running = true;
  thread->detach();  // to join it would mean to wait for close()
}

// The thread.
void DescriptorCloser::work(Shared& shared) {
  std::unique_lock lock(shared.mutex);
  for (; !shared.groups.empty(); shared.groups.pop_front()) {
    std::vector<UniqueFd> group = std::move(shared.groups.front());
    lock.unlock();
    group.clear();
    lock.lock();
  }
  shared.is_running = false;
}

}  // namespace dssm::daemon
