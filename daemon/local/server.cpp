// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/server.hpp"

#include <fmt/format.h>
#include <linux/sockios.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <iterator>
#include <new>
#include <span>
#include <utility>

#include "core/base/try.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/streams/memory_files.hpp"

namespace dssm::daemon {
namespace {

// Removes the socket that an earlier dssmd left. Returns whether there was one.
Result<bool> remove_stale(const std::string& path) {
  struct stat file {};
  if (::lstat(path.c_str(), &file)) {
    if (errno == ENOENT) return false;
    return os_error("check for an old socket '" + path + "'");
  }
  if (!S_ISSOCK(file.st_mode)) {
    return Error{Errc::conflict,
                 "listen at '" + path + "': there is a file that is not a socket; move it"};
  }
  if (::unlink(path.c_str())) return os_error("remove the old socket '" + path + "'");
  return true;
}

// Ends the connection for the other side. Whether it has sent what was not received: descriptors,
// perhaps, which close() of the socket would close as well.
bool end_with_unread(int socket) {
  ::shutdown(socket, SHUT_RDWR);  // from now on nothing comes
  int unread = 0;
  return ::ioctl(socket, SIOCINQ, &unread) || unread > 0;
}

Result<ucred> user_of(int socket) {
  ucred peer{};
  socklen_t length = sizeof peer;
  if (::getsockopt(socket, SOL_SOCKET, SO_PEERCRED, &peer, &length)) {
    return os_error("get the credentials of a program");
  }
  return peer;
}

// The groups of the program on the other side, besides that of SO_PEERCRED; when the kernel does
// not tell them (before Linux 4.13), none.
std::vector<std::uint32_t> groups_of(int socket) {
  static_assert(sizeof(gid_t) == sizeof(std::uint32_t));
  std::vector<std::uint32_t> groups(64);
  for (;;) {
    auto bytes = static_cast<socklen_t>(groups.size() * sizeof(gid_t));
    if (!::getsockopt(socket, SOL_SOCKET, SO_PEERGROUPS, groups.data(), &bytes)) {
      groups.resize(bytes / sizeof(gid_t));
      return groups;
    }
    if (errno != ERANGE) return {};
    groups.resize(bytes / sizeof(gid_t));  // as many as there are
  }
}

}  // namespace

// --- the socket

Result<Listener> Listener::open(const std::string& path, std::optional<gid_t> group, mode_t mode,
                                UniqueFd inherited) {
  const std::string what = "listen at '" + path + "'";
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof address.sun_path) {
    return Error{Errc::invalid_argument,
                 what +
                     ": the path is longer than the 107 bytes that a socket's address takes; "
                     "choose a shorter folder with --runtime-dir"};
  }
  std::memcpy(address.sun_path, path.data(), path.size());
  if (inherited) {
    Listener listener(path, std::move(inherited));
    listener.inherited_ = true;
    if (::listen(listener.fd(), kBacklog)) return os_error(what);  // systemd's is longer
    DSSM_TRY(listener.allow(group, mode));
    return listener;
  }
  const bool stale = DSSM_TRY(remove_stale(path));
  UniqueFd fd(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  if (!fd) return os_error(what);
  if (::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address)) {
    return os_error(what);
  }
  Listener listener(path, std::move(fd));
  listener.found_file_ = stale;
  DSSM_TRY(listener.allow(group, mode));
  if (::listen(listener.fd(), kBacklog)) return os_error(what);
  return listener;
}

Result<void> Listener::allow(std::optional<gid_t> group, mode_t mode) const {
  const std::string what = "listen at '" + path_ + "'";
  struct stat file {};
  if (::stat(path_.c_str(), &file)) return os_error(what);
  if (group && *group != file.st_gid && ::chown(path_.c_str(), static_cast<uid_t>(-1), *group)) {
    Error error = os_error(fmt::format("{}: give it to group {}", what, *group));
    error.message +=
        "; dssmd's user has to own the socket (SocketUser=) and be a member of "
        "socket_group";
    return error;
  }
  if (mode != (file.st_mode & 07777) && ::chmod(path_.c_str(), mode)) {
    return os_error(what + ": set its permissions (key socket_mode)");
  }
  return {};
}

Listener::~Listener() {
  if (fd_ && !inherited_ && !leaves_file_) ::unlink(path_.c_str());
}

// --- one connection

Connection::Connection(const EventLoop& loop, UniqueFd socket, const Identity& identity,
                       LocalService& service, TurnQueue& turns, MemoryBudget& messages,
                       UserAccount& user, Logger& logger, std::function<void()> on_closed)
    : socket_(std::move(socket)),
      service_(service),
      logger_(logger),
      on_closed_(std::move(on_closed)),
      number_(service.connect(identity, *this)),
      input_(wire::kMaxLocalRequestBytes),
      messages_(messages),
      user_(user),
      turns_(turns),
      turn_(turns, identity.account(), [this] { guarded([this] { serve_frames(); }); }),
      readable_(EventSource::readable(loop, socket_.get(),
                                      [this] { guarded([this] { on_readable(); }); })),
      writable_(EventSource::writable(loop, socket_.get(), [this] { on_writable(); })),
      greeting_timeout_(EventSource::timer(
          loop,
          [this] {
            if (service_.has_greeted(number_)) return;
            end_with({Errc::protocol, "a program connected and sent no Hello for 10 s"});
          })),
      request_timeout_(EventSource::timer(
          loop,
          [this] {
            end_with(
                {Errc::protocol, "a program began a long request and did not end it for 10 s"});
          })),
      output_timer_(EventSource::timer(loop, [this] { on_output_timeout(); })) {
  readable_.enable();
  greeting_timeout_.enable_in(kLocalHelloTimeout);
}

Connection::~Connection() {
  if (is_open()) leaves_ = service_.disconnect(number_);
  while (leaves_) leaves_ = service_.leave(number_, by_client_);
  if (!is_open()) return;
  readable_.disable();
  writable_.disable();
  close_socket();
}

// An exception that leaves a callback would end dssmd.
template <class Work>
void Connection::guarded(Work work) {
  try {
    work();
  } catch (const std::bad_alloc&) {
    input_ = wire::FrameBuffer(wire::kMaxLocalRequestBytes);  // first, for the memory
    end_with(no_memory_left());
  }
}

void Connection::on_readable() {
  // Looks first: of what is received, the kernel closes here what this process cannot take.
  const std::span<std::byte> space = input_.space();
  const Result<wire::IoResult> got = wire::recv_some(socket_.get(), space, unchecked_, MSG_PEEK);
  if (!got) return end_with(got.error());
  if (got->status == wire::IoStatus::would_block) return;
  if (got->status == wire::IoStatus::end) return close(true);
  if (!std::all_of(unchecked_.begin(), unchecked_.end(),
                   [](const UniqueFd& fd) { return closes_at_once(fd.get()); })) {
    return end_with({Errc::protocol,
                     "descriptors came that are neither memory files nor doorbells; no request "
                     "takes others"});
  }
  std::vector<UniqueFd> descriptors = std::exchange(unchecked_, {});
  ssize_t taken = 0;
  do {
    taken = ::recv(socket_.get(), space.data(), got->bytes, 0);
  } while (taken < 0 && errno == EINTR);
  if (taken < 0) return end_with(os_error("receive from the local socket"));
  input_.commit(static_cast<std::size_t>(taken));
  if (charge_input() && take_descriptors(std::move(descriptors))) serve_frames();
}

// False: so much is not left, and `share` has nothing.
bool Connection::charge(std::size_t bytes, Share& share) {
  if (bytes <= wire::FrameBuffer::kKeptBytes) bytes = 0;
  if (bytes == share.of_all.bytes()) return true;
  share = {};
  std::optional<MemoryShare> of_all = messages_.try_take(bytes);
  std::optional<MemoryShare> of_user = user_.messages.try_take(bytes);
  if (!of_all || !of_user) return false;
  share = {*std::move(of_all), *std::move(of_user)};
  return true;
}

Error Connection::no_memory_for(std::string_view what) const {
  const bool is_users = user_.is_limited && user_.messages.used() * 2 > user_.messages.limit();
  return {Errc::limit_exceeded,
          fmt::format("no memory is left to {}: long requests that programs of {} have begun, and "
                      "answers that they have not received, take up to {} bytes; try again later",
                      what, is_users ? fmt::format("user {}", user_.uid) : "this PC",
                      (is_users ? user_.messages : messages_).limit())};
}

bool Connection::charge_input() {
  const bool was_long = input_share_.of_all.bytes() > 0;
  const bool has_memory = charge(input_.capacity(), input_share_);
  const bool is_long = input_share_.of_all.bytes() > 0;
  if (!is_long) request_timeout_.disable();
  if (is_long && !was_long) request_timeout_.enable_in(kLongRequestTimeout);
  if (!has_memory) end_with(no_memory_for("receive a long request"));
  return has_memory;
}

// Ends the connection when there is no memory for what waits for the program.
bool Connection::charge_output() {
  if (queued_bytes_ <= kMaxQueuedBytes && charge(queued_bytes_, output_share_)) return true;
  logger_.warning(
      fmt::format("close a connection: the program does not read, and {} bytes wait for it",
                  queued_bytes_),
      {.message_id = message_id::kClientRefused});
  close();
  return false;
}

bool Connection::take_descriptors(std::vector<UniqueFd> arrived) {
  if (arrived.empty()) return true;
  std::size_t unclaimed = arrived.size();
  for (const std::vector<UniqueFd>& some : arrived_) unclaimed += some.size();
  if (unclaimed > kMaxUnclaimedDescriptors) {
    end_with({Errc::protocol, fmt::format("more than {} descriptors came that no request takes",
                                          kMaxUnclaimedDescriptors)});
    return false;
  }
  arrived_.push_back(std::move(arrived));
  return true;
}

void Connection::serve_frames() {
  if (leaves_) return leave();
  if (!turn_.may_begin()) return readable_.disable();
  const TurnQueue::Work work(turns_);
  const MonoTime begin = MonoClock::now();
  for (int served = 0; is_open() && !is_paused(); ++served) {
    if (served == kRequestsPerTurn || (served > 0 && MonoClock::now() - begin > kMaxTurn)) {
      readable_.disable();
      return turn_.wait(waits_for_);
    }
    // Events that its requests cause wait for a turn of their own; its next requests do not.
    const bool got_events = !turn_.is_waiting() && service_.go_on(number_);
    waits_for_ = got_events ? TurnQueue::Reason::event : TurnQueue::Reason::request;
    if (got_events || !is_open()) continue;
    const auto frame = input_.next();
    if (!frame) return end_with(frame.error());
    if (!*frame) {
      if (charge_input()) readable_.enable();
      return;
    }
    if (!service_.on_frame_untrusted(number_, **frame, arrived_)) return close();
  }
  if (is_open()) readable_.disable();  // paused: on_writable() continues
}

void Connection::send(std::string bytes, std::vector<UniqueFd> descriptors) {
  if (!is_open() || !has_reader_) return;
  Outgoing outgoing{std::move(bytes), 0, std::move(descriptors)};
  if (output_.empty()) {
    if (!send_some(outgoing)) return;
    if (outgoing.sent == outgoing.bytes.size()) return;
    writable_.enable();
  }
  queued_bytes_ += outgoing.bytes.size();
  queued_descriptors_ += outgoing.descriptors.size();
  try {
    output_.push_back(std::move(outgoing));
  } catch (const std::bad_alloc&) {
    return close();  // a part of it may be sent
  }
  if (charge_output() && !watched_) watch_output();
}

// What the client has read counts when it has read all of a packet, of up to 100 KiB.
Connection::Progress Connection::progress() const noexcept {
  int unread = 0;
  ::ioctl(socket_.get(), SIOCOUTQ, &unread);
  return {sent_bytes_, unread};
}

void Connection::watch_output() {
  watched_ = progress();
  output_timer_.enable_in(kLocalOutputTimeout);
}

void Connection::on_output_timeout() {
  const std::optional<Progress> before = std::exchange(watched_, std::nullopt);
  if (output_.empty()) return;
  if (progress() != before) return watch_output();
  end_with({Errc::limit_exceeded,
            fmt::format("a program has read nothing for {} s of the {} bytes that wait for it",
                        kLocalOutputTimeout / std::chrono::seconds(1), queued_bytes_)});
}

// False when the connection ended over it.
bool Connection::send_some(Outgoing& outgoing) {
  std::vector<int> fds;
  for (const UniqueFd& fd : outgoing.descriptors) fds.push_back(fd.get());
  const auto rest = std::as_bytes(std::span(outgoing.bytes)).subspan(outgoing.sent);
  const Result<wire::IoResult> sent = wire::send_some(socket_.get(), rest, fds);
  if (!sent) {
    logger_.warning("close a connection: " + sent.error().message);
    close();
    return false;
  }
  if (sent->status == wire::IoStatus::end) {
    stop_output();
    return false;
  }
  outgoing.sent += sent->bytes;
  sent_bytes_ += sent->bytes;
  if (sent->bytes > 0) outgoing.descriptors.clear();  // they went with the first byte
  return true;
}

// The client has ended, or does not read any more. What it sent before comes first, then its end.
void Connection::stop_output() {
  has_reader_ = false;
  service_.on_reader_gone(number_);
  writable_.disable();
  output_timer_.disable();
  output_.clear();
  queued_bytes_ = queued_descriptors_ = 0;
  output_share_ = {};
  turn_.wait();
}

void Connection::on_writable() {
  while (!output_.empty()) {
    Outgoing& next = output_.front();
    const std::size_t descriptors = next.descriptors.size();
    if (!send_some(next)) return;
    queued_descriptors_ -= descriptors - next.descriptors.size();
    if (next.sent < next.bytes.size()) break;
    queued_bytes_ -= next.bytes.size();
    output_.pop_front();
  }
  if (output_.empty()) writable_.disable();
  charge(queued_bytes_, output_share_);
  // Whole frames may be waiting in input_; for them the socket does not become readable.
  if (!is_paused()) turn_.wait(waits_for_);
}

// The final failure is sent as far as the socket takes it at once; the connection does not wait for
// a client that does not read.
void Connection::end_with(const Error& error) {
  logger_.warning("close a connection: " + error.message,
                  {.message_id = message_id::kClientRefused});
  send(wire::final_failure(error), {});
  close();
}

void Connection::close_socket() {
  std::vector<UniqueFd> group = std::exchange(unchecked_, {});
  // Freeing a large memory file takes long, too.
  for (std::vector<UniqueFd>& some : std::exchange(arrived_, {})) {
    group.insert(group.end(), std::make_move_iterator(some.begin()),
                 std::make_move_iterator(some.end()));
  }
  UniqueFd socket = std::move(socket_);
  if (end_with_unread(socket.get())) group.push_back(std::move(socket));
  if (!group.empty()) user_.closer.close(std::move(group));
}

void Connection::close(bool by_client) {
  if (!is_open()) return;
  readable_.disable();
  writable_.disable();
  turn_.stop();
  greeting_timeout_.disable();
  request_timeout_.disable();
  output_timer_.disable();
  close_socket();
  output_.clear();
  input_share_ = {};
  output_share_ = {};
  by_client_ = by_client;
  leaves_ = service_.disconnect(number_, by_client);
  if (leaves_) return turn_.wait();
  on_closed_();
}

// Ends the rest of its many opens, some in each turn.
void Connection::leave() {
  const TurnQueue::Work work(turns_);
  leaves_ = service_.leave(number_, by_client_);
  if (leaves_) return turn_.wait();
  on_closed_();
}

// --- all connections

Server::Server(const EventLoop& loop, const Listener& listener, const std::string& host,
               const Limits& limits, LocalService& service, Logger& logger)
    : loop_(loop),
      limits_(limits),
      service_(service),
      logger_(logger),
      turns_(loop),
      sweep_(EventSource::timer(loop, [this] { sweep(); })),
      acceptor_(loop, logger, "a program", host, message_id::kClientRefused,
                [this](UniqueFd& socket) { return accept(socket); }) {
  acceptor_.set_closer({[this](UniqueFd socket) { close_refused(std::move(socket)); },
                        [this] {
                          for (auto& [uid, user] : users_) user.closer.go_on();
                          return unclosed() >= 2 * limits_.max_clients;
                        }});
  acceptor_.listen(listener.fd());
}

void Server::add_limits(LimitUses& out) const {
  std::uint64_t clients = 0, bytes = 0;
  for (const auto& [uid, user] : users_) {
    if (!user.is_limited) continue;
    clients = std::max(clients, user.places());
    bytes = std::max(bytes, user.messages.used());
  }
  const std::uint64_t connected = connections_.size() - ended_.size() + unclosed();
  out.push_back({"max_clients", connected, limits_.max_clients, "programs"});
  out.push_back({"max_clients_per_user", clients, limits_.max_clients_per_user, "programs"});
  out.push_back({"long messages", messages_.used(), messages_.limit(), "bytes"});
  out.push_back({"long messages of one user", bytes, kMaxMessageBytesPerUser, "bytes"});
}

Result<void> Server::accept(UniqueFd& socket) {
  if (connections_.size() - ended_.size() + unclosed() >= limits_.max_clients) {
    return Error{Errc::limit_exceeded,
                 fmt::format("max_clients = {} programs are connected already; end some or raise "
                             "the key max_clients",
                             limits_.max_clients)};
  }
  const ucred peer = DSSM_TRY(user_of(socket.get()));
  UserAccount& user = users_.try_emplace(peer.uid, peer.uid).first->second;
  if (user.is_limited && user.places() >= limits_.max_clients_per_user) {
    return Error{Errc::limit_exceeded,
                 fmt::format("max_clients_per_user = {} programs of user {} are connected already; "
                             "end some or raise the key max_clients_per_user",
                             limits_.max_clients_per_user, user.uid)};
  }
  // Where the kernel drops what is out of band, it closes descriptors here.
  const int is_inline = 1;
  ::setsockopt(socket.get(), SOL_SOCKET, SO_OOBINLINE, &is_inline, sizeof is_inline);
  Identity identity;
  identity.pid = peer.pid;
  identity.uid = peer.uid;
  identity.gid = peer.gid;
  identity.groups = groups_of(socket.get());
  keep(std::move(socket), identity, user);
  return {};
}

void Server::close_refused(UniqueFd socket) {
  if (!end_with_unread(socket.get())) return;
  const Result<ucred> peer = user_of(socket.get());
  const uid_t uid = peer ? peer->uid : static_cast<uid_t>(-1);
  std::vector<UniqueFd> group;
  group.push_back(std::move(socket));
  users_.try_emplace(uid, uid).first->second.closer.close(std::move(group));
}

// Sockets of programs that are gone, and that dssmd still has.
std::uint64_t Server::unclosed() const {
  std::uint64_t all = 0;
  for (const auto& [uid, user] : users_) all += user.closer.unclosed();
  return all;
}

void Server::keep(UniqueFd socket, const Identity& identity, UserAccount& user) {
  const std::uint64_t number = next_++;
  const auto on_closed = [this, number, &user] {
    --user.clients;
    ended_.push_back(number);
    sweep_.enable_in(Duration::zero());
  };
  connections_.emplace(
      number, std::make_unique<Connection>(loop_, std::move(socket), identity, service_, turns_,
                                           messages_, user, logger_, on_closed));
  ++user.clients;
}

void Server::sweep() {
  for (const std::uint64_t number : std::exchange(ended_, {})) connections_.erase(number);
  std::erase_if(users_, [](const auto& entry) { return entry.second.places() == 0; });
}

}  // namespace dssm::daemon
