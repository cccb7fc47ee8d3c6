// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/resolver.hpp"

#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <condition_variable>
#include <deque>
#include <mutex>
#include <optional>
#include <thread>
#include <utility>

#include "core/base/check.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

// What a caller waits for; its ticket keeps the request alive.
struct Resolver::Question {
  wire::Address address;
  Then then;
};

struct Resolver::Shared {
  struct Answered {
    std::weak_ptr<Question> question;
    Result<std::vector<wire::SocketAddress>> addresses;
  };

  const Lookup lookup;
  const UniqueFd wake{::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)};  // readable: answers are there

  std::mutex mutex;  // guards what follows
  std::condition_variable asked_or_ended;
  bool ended = false;
  // Beside each question its address: only the loop may touch a Question.
  std::deque<std::pair<wire::Address, std::weak_ptr<Question>>> questions;
  std::vector<Answered> answers;

  explicit Shared(Lookup how) : lookup(std::move(how)) {}

  // Under the mutex. Answers all who wait for `address`.
  void answer(const wire::Address& address,
              const Result<std::vector<wire::SocketAddress>>& addresses) {
    std::erase_if(questions, [&](const auto& question) {
      if (question.first != address) return false;
      answers.push_back({question.second, addresses});
      return true;
    });
    const std::uint64_t one = 1;
    // Fails only when the count is full, and then it is readable anyway.
    [[maybe_unused]] const ssize_t written = ::write(wake.get(), &one, sizeof one);
  }
};

Resolver::Resolver(const EventLoop& loop, Lookup lookup)
    : shared_(std::make_shared<Shared>(std::move(lookup))) {
  DSSM_CHECK(shared_->wake);  // fails only without a descriptor left at start
  answered_ = EventSource::readable(loop, shared_->wake.get(), [this] { deliver(); });
  answered_.enable();
}

Resolver::~Resolver() {
  const std::lock_guard guard(shared_->mutex);
  shared_->ended = true;
  shared_->asked_or_ended.notify_one();
}

Resolver::Ticket Resolver::resolve(const wire::Address& address, Then then) {
  auto question = std::make_shared<Question>(Question{address, std::move(then)});
  const std::lock_guard guard(shared_->mutex);
  shared_->questions.emplace_back(address, question);
  if (std::vector<wire::SocketAddress> number = wire::resolve_number(address); !number.empty()) {
    shared_->answer(address, number);
    return question;
  }
  if (!started_) {
    Result<std::thread> thread = quiet_thread("the resolver", [shared = shared_] { work(shared); });
    if (!thread) {
      shared_->answer(address, std::move(thread).error());
      return question;
    }
    thread->detach();  // to join it would mean to wait for getaddrinfo()
    started_ = true;
  }
  shared_->asked_or_ended.notify_one();
  return question;
}

// The thread.
void Resolver::work(const std::shared_ptr<Shared>& shared) {
  std::unique_lock lock(shared->mutex);
  for (;;) {
    shared->asked_or_ended.wait(lock, [&] { return shared->ended || !shared->questions.empty(); });
    if (shared->ended) return;
    if (shared->questions.front().second.expired()) {
      shared->questions.pop_front();
      continue;
    }
    const wire::Address address = shared->questions.front().first;
    lock.unlock();
    Result<std::vector<wire::SocketAddress>> found = shared->lookup(address);
    if (found && found->empty()) {
      found = Error{Errc::not_found, "look up '" + address.host + "': it has no address"};
    }
    lock.lock();
    shared->answer(address, found);
  }
}

void Resolver::deliver() {
  std::uint64_t count = 0;
  [[maybe_unused]] const ssize_t got = ::read(shared_->wake.get(), &count, sizeof count);
  std::vector<Shared::Answered> answers;
  {
    const std::lock_guard guard(shared_->mutex);
    answers = std::exchange(shared_->answers, {});
  }
  for (Shared::Answered& answer : answers) {
    // Held here, because `then` may give up its ticket.
    if (const std::shared_ptr<Question> question = answer.question.lock()) {
      question->then(std::move(answer.addresses));
    }
  }
}

}  // namespace dssm::daemon
