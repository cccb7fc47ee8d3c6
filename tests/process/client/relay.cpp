// SPDX-License-Identifier: Apache-2.0
#include "tests/process/client/relay.hpp"

#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <utility>
#include <vector>

#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

[[noreturn]] void fail(const char* what) {
  std::perror(what);
  std::abort();
}

void raise(int event) {
  const std::uint64_t one = 1;
  if (::write(event, &one, sizeof one) != sizeof one) fail("write eventfd");
}

// One direction: what came, and what of it makes whole messages.
struct Direction {
  wire::FrameBuffer frames{wire::kMaxLocalFrameBytes};
  std::string bytes;
  std::vector<UniqueFd> fds;

  // False: the sender is gone.
  bool receive(int from) {
    char buffer[65536];
    auto got = wire::recv_some(from, std::as_writable_bytes(std::span(buffer)), fds);
    if (!got || got->status != wire::IoStatus::ok) return false;
    bytes.assign(buffer, got->bytes);
    const std::span<std::byte> space = frames.space();
    if (space.size() < bytes.size()) fail("a message that is too large for this relay");
    std::memcpy(space.data(), bytes.data(), bytes.size());
    frames.commit(bytes.size());
    return true;
  }
  template <class Message, class Use>
  void each(Use use) {
    while (auto frame = frames.next().value()) {
      Message message;
      if (!message.ParseFromArray(frame->data(), static_cast<int>(frame->size()))) fail("parse");
      use(message);
    }
  }
  bool send(int to) {
    std::vector<int> numbers;
    for (const UniqueFd& fd : fds) numbers.push_back(fd.get());
    auto rest = std::as_bytes(std::span(bytes));
    while (!rest.empty()) {
      auto sent = wire::send_some(to, rest, numbers);
      if (!sent || sent->status != wire::IoStatus::ok) return false;
      rest = rest.subspan(sent->bytes);
      numbers.clear();
    }
    fds.clear();
    return true;
  }
};

}  // namespace

Relay::Relay(std::string dssmd_socket)
    : dssmd_socket_(std::move(dssmd_socket)),
      folder_(make_temp_dir()),
      path_(folder_ + "/dssmd.sock"),
      listener_(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0)),
      cut_(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)),
      stop_(::eventfd(0, EFD_CLOEXEC)) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  std::strncpy(address.sun_path, path_.c_str(), sizeof address.sun_path - 1);
  if (::bind(listener_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address) ||
      ::listen(listener_.get(), 4)) {
    fail("listen");
  }
  thread_ = std::thread([this] { run(); });
}

Relay::~Relay() {
  raise(stop_.get());
  thread_.join();
  remove_tree(folder_);
}

void Relay::set_behind(Behind behind) {
  const std::lock_guard guard(mutex_);
  behind_ = std::move(behind);
}

void Relay::cut() { raise(cut_.get()); }

void Relay::run() {
  for (;;) {
    pollfd ready[] = {{listener_.get(), POLLIN, 0}, {stop_.get(), POLLIN, 0}};
    if (::poll(ready, 2, -1) < 0) continue;
    if (ready[1].revents) return;
    const UniqueFd program(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC));
    if (program) serve(program.get());
  }
}

void Relay::serve(int program) {
  const UniqueFd dssmd = wire::connect_unix(dssmd_socket_).value();
  Direction up, down;
  std::uint64_t count = 0;
  for (;;) {
    pollfd ready[] = {{program, POLLIN, 0},
                      {dssmd.get(), POLLIN, 0},
                      {stop_.get(), POLLIN, 0},
                      {cut_.get(), POLLIN, 0}};
    if (::poll(ready, 4, -1) < 0) continue;
    if (ready[2].revents) return;
    if (ready[3].revents && ::read(cut_.get(), &count, sizeof count) > 0) return;
    if (ready[0].revents) {
      if (!up.receive(program)) return;
      up.each<local::Request>([&](const local::Request& request) { opens_ += request.has_open(); });
      if (!up.send(dssmd.get())) return;
    }
    if (ready[1].revents) {
      if (!down.receive(dssmd.get())) return;
      std::string more;
      down.each<local::Response>([&](const local::Response& response) {
        const std::lock_guard guard(mutex_);
        if (behind_) more += behind_(response);
      });
      down.bytes += more;
      if (!down.send(program)) return;
    }
  }
}

}  // namespace dssm::test
