// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/mdns/mdns_mailbox.hpp"

#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

namespace dssm::daemon {
namespace {

// Lines that dssmd's loop has not taken yet; beyond them lines are dropped.
constexpr std::size_t kMaxPendingLines = 64;

void ring_bell(const UniqueFd& bell) {
  const std::uint64_t one = 1;
  // Fails only when it has been rung 2^64 times.
  [[maybe_unused]] const ssize_t written = ::write(bell.get(), &one, sizeof one);
}

void clear_bell(const UniqueFd& bell) {
  std::uint64_t count;
  // Fails only when it has not been rung.
  [[maybe_unused]] const ssize_t n = ::read(bell.get(), &count, sizeof count);
}

}  // namespace

Result<std::shared_ptr<MdnsMailbox>> MdnsMailbox::open() {
  std::shared_ptr<MdnsMailbox> made(new MdnsMailbox);
  for (UniqueFd* bell : {&made->orders_, &made->updates_, &made->done_}) {
    bell->reset(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
    if (!*bell) return os_error("make an eventfd");
  }
  return made;
}

void MdnsMailbox::want(std::vector<ServiceRecord> records) {
  {
    const std::lock_guard lock(mutex_);
    wanted_ = std::move(records);
  }
  ring_bell(orders_);
}

void MdnsMailbox::stop() {
  stopping_.store(true);
  ring_bell(orders_);
}

MdnsMailbox::Update MdnsMailbox::take_update() {
  clear_bell(updates_);
  const std::lock_guard lock(mutex_);
  return std::exchange(pending_, {});
}

bool MdnsMailbox::wait_until_done(Duration timeout) const {
  pollfd bell{done_.get(), POLLIN, 0};
  const auto ms = std::chrono::duration_cast<std::chrono::milliseconds>(timeout).count();
  return ::poll(&bell, 1, static_cast<int>(ms)) > 0;
}

std::optional<std::vector<ServiceRecord>> MdnsMailbox::take_wanted() {
  clear_bell(orders_);
  const std::lock_guard lock(mutex_);
  return std::exchange(wanted_, std::nullopt);
}

void MdnsMailbox::report(FoundHosts hosts, MdnsInfo state) {
  {
    const std::lock_guard lock(mutex_);
    pending_.hosts = std::move(hosts);
    pending_.state = std::move(state);
  }
  ring_bell(updates_);
}

void MdnsMailbox::log(LogLevel level, std::string text) {
  {
    const std::lock_guard lock(mutex_);
    if (pending_.lines.size() < kMaxPendingLines)
      pending_.lines.emplace_back(level, std::move(text));
  }
  ring_bell(updates_);
}

void MdnsMailbox::done() { ring_bell(done_); }

}  // namespace dssm::daemon
