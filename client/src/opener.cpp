// SPDX-License-Identifier: Apache-2.0
//
// The opener's thread uses the client only while a request, which keeps it, is at hand; or between
// two requests, while the client's destructor would wait for it. When the thread drops the last
// request of a program that has dropped everything else, it destroys the client, and with it the
// opener, itself: then it ends without touching either.
#include "client/src/opener.hpp"

#include <unistd.h>

#include <algorithm>

#include "client/src/client.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/try.hpp"

namespace dssm::detail {

struct Opener::Shared : std::enable_shared_from_this<Shared> {
  using Lock = std::unique_lock<std::mutex>;

  explicit Shared(Client& owner) : client(owner) {}
  void run();
  void attempt(Lock& lock, std::shared_ptr<Request> request);
  void notify(Lock& lock, MonoTime now);
  void on_event(const StreamEvent& event);

  Client& client;
  const pid_t owner_pid = ::getpid();
  std::optional<std::uint64_t> watch;  // of the thread

  std::mutex mutex;  // guards what follows
  std::condition_variable changed, tried;
  std::list<std::shared_ptr<Request>> requests;
  bool stopping = false;
};

Result<std::unique_ptr<Opener>> Opener::start(Client& client) {
  const auto shared = std::make_shared<Shared>(client);
  std::unique_ptr<Opener> opener(new Opener(shared));
  opener->thread_ = DSSM_TRY(quiet_thread("opening streams", [shared] { shared->run(); }));
  return opener;
}

Opener::~Opener() {
  if (!thread_.joinable()) return;
  if (::getpid() != shared_->owner_pid) {  // the thread runs in the parent only
    thread_.detach();
    return;
  }
  {
    const std::lock_guard guard(shared_->mutex);
    shared_->stopping = true;
  }
  shared_->changed.notify_one();
  if (thread_.get_id() == std::this_thread::get_id()) {
    thread_.detach();
  } else {
    thread_.join();
  }
}

std::optional<Error> Opener::add(const std::shared_ptr<Request>& request, Duration at_most) {
  const std::shared_ptr<Shared> shared = shared_;
  Shared::Lock lock(shared->mutex);
  shared->requests.push_back(request);
  shared->changed.notify_one();
  shared->tried.wait_until(lock, deadline_in(at_most), [&] { return request->was_tried_; });
  request->is_awaited_ = false;
  return request->failure_;
}

void Opener::remove(Request& request) noexcept {
  if (::getpid() != shared_->owner_pid) return;
  std::shared_ptr<Request> removed;  // destroyed without the mutex
  const Shared::Lock lock(shared_->mutex);
  request.is_removed_ = true;
  const auto found = std::ranges::find(shared_->requests, &request, &std::shared_ptr<Request>::get);
  if (found == shared_->requests.end()) return;
  removed = std::move(*found);
  shared_->requests.erase(found);
  shared_->changed.notify_one();
}

void Opener::Shared::run() {
  Lock lock(mutex);
  while (!stopping) {
    if (requests.empty() && watch) {
      lock.unlock();
      client.watches().remove(*std::exchange(watch, std::nullopt));
      lock.lock();
      continue;
    }
    const MonoTime now = MonoClock::now();
    MonoTime next = kNever;
    std::shared_ptr<Request> due;
    for (const auto& request : requests) {
      if (request->wait_.next_attempt() <= now) {
        due = request;
        break;
      }
      next = std::min({next, request->wait_.next_attempt(), request->wait_.next_notice()});
    }
    if (due) {
      attempt(lock, std::move(due));
    } else if (next <= now) {
      notify(lock, now);
    } else if (next == kNever) {
      changed.wait(lock);
    } else {
      changed.wait_until(lock, next);
    }
  }
}

void Opener::Shared::attempt(Lock& lock, std::shared_ptr<Request> request) {
  const bool is_first = !request->was_tried_, was_missing = request->wait_.was_missing();
  request->wait_.begin_attempt();
  lock.unlock();
  // Only what is missing needs a watch. It comes before the next attempt, so that no event is
  // missed.
  if (!is_first && !watch) {
    auto added = client.watches().add(
        [shared = shared_from_this()](const StreamEvent& event) { shared->on_event(event); });
    if (added) watch = *added;
  }
  {
    Result<RawReader> opened = request->open(was_missing);
    const bool again = !opened && is_retryable(opened.error().code);
    bool done = false;
    lock.lock();
    if (!request->is_removed_) {
      const auto place = std::ranges::find(requests, request);
      if (again) {
        request->wait_.failed(opened.error(), watch.has_value(), MonoClock::now());
        if (is_first && request->wait_.was_missing()) request->wait_.added();
        requests.splice(requests.end(), requests, place);  // the others first
      } else {
        requests.erase(place);
        done = opened || !request->is_awaited_;
        if (!done) request->failure_ = opened.error();
      }
    }
    lock.unlock();
    if (done) request->done(std::move(opened));
  }
  if (is_first) {  // after done(): the executor has the reader when subscribe() returns
    lock.lock();
    request->was_tried_ = true;
    tried.notify_all();
    lock.unlock();
  }
  request.reset();
  lock.lock();
}

void Opener::Shared::notify(Lock& lock, MonoTime now) {
  lock.unlock();
  const std::vector<StreamId> known = client.watches().known_ids();
  lock.lock();
  std::vector<std::string> notices;
  for (const auto& request : requests) {
    if (request->wait_.next_notice() <= now)
      notices.push_back(request->wait_.take_notice(now, known));
  }
  lock.unlock();
  for (const std::string& notice : notices) client.notice(notice);
  lock.lock();
}

void Opener::Shared::on_event(const StreamEvent& event) {
  if (event.kind != StreamEvent::Kind::added) return;
  const std::lock_guard guard(mutex);
  for (const auto& request : requests) {
    if (request->wait_.is_about(event.stream.id)) request->wait_.added();
  }
  changed.notify_one();
}

}  // namespace dssm::detail
