// SPDX-License-Identifier: Apache-2.0
#include "process.hpp"

#include <pthread.h>
#include <signal.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <new>

#include "core/base/quiet_thread.hpp"
#include "core/base/try.hpp"
#include "signal_safe.hpp"
#include "socket_path.hpp"

struct ssmtime* timecontrol = nullptr;

namespace dssm::ssm {
namespace {

static_assert(sizeof(SSM_sid) == 8, "a sid holds a place and a generation: 46 bits");

// Made when the library is loaded, so before any static object of the program, and there until its
// last thread ends.
Process the_process;
static_assert(std::is_trivially_destructible_v<Process>);

ssmtime shown_clock;  // what timecontrol points to

template <class T>
void store_changed(T& field, T value) noexcept {
  const std::atomic_ref shared(field);  // programs read it from any thread
  if (shared.load(std::memory_order_relaxed) == value) return;
  shared.store(value, std::memory_order_relaxed);
}

Result<Session> connect(const std::string& path) {
  SessionOptions options;
  options.socket_path = path;
  return Session::connect(std::move(options));
}

// Where programs look for dssmd; `path` becomes the place where it was found.
Result<Session> connect_anywhere(std::string& path) {
  Error failure;
  for (const std::string& place : socket_paths()) {
    Result<Session> session = connect(place);
    if (session) {
      path = place;
      return session;
    }
    // The failure at the first path is reported, unless a dssmd refused the program at a later one.
    if (failure.message.empty() || session.error().code != Errc::no_daemon) {
      failure = std::move(session).error();
    }
  }
  return failure;
}

}  // namespace

Process& process() noexcept { return the_process; }

constinit thread_local int kept_thread_id = 0;

int ask_thread_id() noexcept { return kept_thread_id = ::gettid(); }

Process::Process() noexcept : sids_(wake_), clock_(wake_) { ::sem_init(&wake_, 0, 0); }

bool Process::registered_locked() const noexcept {
  return registration_ && registration_->ends == ends_.load();
}

// --- the reaper

void* Process::run_reaper(void* self) {
  auto& process = *static_cast<Process*>(self);
  for (;;) {
    while (::sem_wait(&process.wake_) != 0) continue;
    const std::lock_guard guard(process.mutex_);
    const bool is_last = process.exiting_.load();
    if (!process.ended_.load()) process.reap_locked();
    if (is_last) process.ended_.store(true);
  }
}

// Most programs end right after they have closed their streams. dssmd must hear of that first, or
// the writers count as crashed; and the reaper must not be half-way through while the static
// objects of other libraries are destroyed. Bounded, because programs call exit() from handlers,
// and the interrupted thread may hold what the reaper needs.
void Process::at_exit() {
  Process& process = the_process;
  if (!process.reaper_) return;
  process.exiting_.store(true);
  ::sem_post(&process.wake_);
  const MonoTime deadline = deadline_in(std::chrono::seconds(1));
  while (!process.ended_.load() && MonoClock::now() < deadline) ::usleep(100);
  process.ended_.store(true);
}

void Process::reap_locked() {
  sids_.reap(generation_);
  clock_.reap(generation_);
  if (registration_ && !registered_locked()) delete std::exchange(registration_, nullptr);
}

// What must be there before the first stream or registration.
Result<void> Process::prepare_locked() {
  if (!handlers_) {
    const int error = ::pthread_atfork(nullptr, nullptr, &after_fork_in_child);
    if (error || std::atexit(&at_exit)) return os_error("prepare for fork and exit", ENOMEM);
    handlers_ = true;
  }
  if (!reaper_) {
    const SignalBlock block;
    pthread_t thread;
    const int error = ::pthread_create(&thread, nullptr, &run_reaper, this);
    if (error) return os_error("start libssm's thread", error);
    ::pthread_detach(thread);
    reaper_ = true;
  }
  return {};
}

// Only what is safe between fork and exec, and what other threads of the parent may have held.
void Process::after_fork_in_child() {
  Process& process = the_process;
  const int parents_thread = std::exchange(kept_thread_id, 0);
  new (&process.mutex_) std::mutex;
  ::sem_init(&process.wake_, 0, 0);
  ++process.generation_;
  process.reaper_ = false;
  process.was_registered_.store(false);
  if (Registration* const parents = std::exchange(process.registration_, nullptr)) {
    parents->next = std::exchange(process.abandoned_, parents);
  }
  process.sids_.reset_after_fork(parents_thread, [](Stream& s) { s.reset_after_fork(); });
  process.clock_.reset_after_fork(parents_thread);
}

// --- registration

Result<void> Process::start() {
  const std::lock_guard guard(mutex_);
  const std::uint64_t ends = ends_.load();
  DSSM_TRY(prepare_locked());
  reap_locked();
  if (registered_locked()) {
    if (!registration_->session.is_connected()) {
      return Error{Errc::unavailable, "dssmd is gone; this program goes on when it is back"};
    }
    return attach_clock_locked();
  }
  std::string path;
  Session session = DSSM_TRY(connect_anywhere(path));
  PlaybackClock clock = DSSM_TRY(session.open_playback_clock());
  std::strncpy(socket_path_, path.c_str(), sizeof socket_path_ - 1);
  registration_ = new Registration{std::move(session), ends, nullptr};
  clock_.attach(std::move(clock), generation_);
  was_registered_.store(true);
  if (ends_.load() != ends) clock_.detach(), ::sem_post(&wake_);  // a handler ended it already
  return {};
}

bool Process::end() noexcept {
  const int saved_errno = errno;
  ends_.fetch_add(1);
  clock_.detach();
  ::sem_post(&wake_);
  bool listens = false;
  if (was_registered_.load()) {
    // SSM's result is whether the coordinator was notified. A handler may use only few system calls
    // to find out whether there is one.
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::memcpy(address.sun_path, socket_path_, sizeof address.sun_path);
    const int probe = ::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    listens = ::connect(probe, reinterpret_cast<sockaddr*>(&address), sizeof address) == 0 ||
              errno == EAGAIN;  // busy, so there
    ::close(probe);
  }
  errno = saved_errno;
  return listens;
}

Result<Session> Process::session() {
  const std::lock_guard guard(mutex_);
  reap_locked();
  if (!registered_locked()) {
    return Error{Errc::closed, "this program is not registered; call initSSM first"};
  }
  return registration_->session;
}

Result<Session> Process::any_session() {
  if (Result<Session> registered = session()) return registered;
  std::string path;
  if (was_registered_.load()) return connect(socket_path_);
  return connect_anywhere(path);
}

SSM_sid Process::add(std::unique_ptr<Stream> stream) {
  const std::lock_guard guard(mutex_);
  // NOLINTNEXTLINE(performance-no-int-to-ptr): a number in the type of SSM's API
  return reinterpret_cast<SSM_sid>(sids_.add(std::move(stream), generation_));
}

// --- the clock

Result<void> Process::attach_clock_locked() {
  if (clock_.attached()) return {};
  clock_.attach(DSSM_TRY(registration_->session.open_playback_clock()), generation_);
  return {};
}

bool Process::attach_clock() {
  const std::lock_guard guard(mutex_);
  reap_locked();
  return registered_locked() && attach_clock_locked().has_value();
}

void SharedClock::show(const PlaybackClock::Setting& setting) noexcept {
  store_changed(shown_clock.offset, setting.offset_s);
  store_changed(shown_clock.speed, setting.speed);
  store_changed(shown_clock.is_pause, setting.paused ? 1 : 0);
  store_changed(shown_clock.pausetime, setting.paused_at_s);
}

// In attach() and detach() current_ changes before the old clock is closed: see change().
void SharedClock::attach(PlaybackClock clock, std::uint64_t process_generation) {
  show(clock.setting());
  clocks_.close(current_.exchange(
      clocks_.add(std::make_unique<PlaybackClock>(std::move(clock)), process_generation)));
  std::atomic_ref(timecontrol).store(&shown_clock);
}

void SharedClock::detach() noexcept {
  std::atomic_ref(timecontrol).store(nullptr);
  clocks_.close(current_.exchange(0));
}

}  // namespace dssm::ssm
