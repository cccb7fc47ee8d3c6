// SPDX-License-Identifier: Apache-2.0
//
// The web server of dssm-view, on libwebsockets: files of a folder, texts that are made on request,
// and WebSocket connections, all on one port and in one thread, the one that calls run(). What may
// take long is done by other threads, which post() their results.
//
// Any web page that a person has open may send requests to this PC. So a request must call this
// server by an address or by one of its names (header Host; else a name for which an attacker's DNS
// server gives this PC's address would do), and a WebSocket from the page of another server is
// refused (header Origin). What else such a page sends, its browser does not let it read.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

struct lws;
struct lws_context;

namespace dssm::view {

// Whether that is a numeric address, without brackets: 127.0.0.1, ::1.
bool is_address(const std::string& text);

// A message of a WebSocket; copies share its bytes.
class Message {
 public:
  static Message text(std::string_view text);
  // All `parts`, one after the other.
  static Message binary(const std::vector<std::span<const std::byte>>& parts);

  std::size_t bytes() const;

 private:
  friend class Server;
  Message(std::size_t bytes, bool is_text);
  std::shared_ptr<std::vector<unsigned char>>
      buffer_;  // with libwebsockets' place before the bytes
  bool is_text_;
};

// The other end of a WebSocket. Messages wait here until the network takes them.
class Peer {
 public:
  void send(Message message);
  // The path at which it connected: "/", "/hold".
  const std::string& path() const { return path_; }
  std::size_t waiting() const { return waiting_.size(); }
  std::size_t waiting_bytes() const { return waiting_bytes_; }
  // Ends the connection, at once: what waits is lost.
  //   reason  for people, at most 123 bytes
  void close(std::string_view reason);

 private:
  friend class Server;
  Peer(lws* connection, std::string path) : connection_(connection), path_(std::move(path)) {}
  lws* connection_;
  std::string path_;
  std::deque<Message> waiting_;
  std::size_t waiting_bytes_ = 0;
  bool is_closing_ = false;
};

// What a subprotocol does with a peer, until the connection ends.
class Connection {
 public:
  Connection() = default;
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;
  virtual ~Connection() = default;
  virtual void on_text(std::string_view text) = 0;
  virtual void on_binary(std::string_view /*bytes*/) {}
};

struct ServerOptions {
  std::string address = "127.0.0.1";
  std::uint16_t port = 8765;         // 0: any that is free
  std::filesystem::path pages;       // the folder; index.html is the first page
  std::vector<std::string> hosts;    // further names by which this server may be called
  std::vector<std::string> origins;  // other servers whose pages may connect: "https://example.org"
  // TLS if there is a certificate: files as PEM, read again when one changes. With `authority`
  // clients must have a certificate, of that CA; `revoked` is its list of those that do not count.
  std::filesystem::path certificate, key, authority, revoked;
};

class Server {
 public:
  explicit Server(ServerOptions options);
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;
  ~Server();

  // --- what it serves, before listen()

  // WebSockets of that subprotocol. The peer outlives the connection that `connect` makes.
  using Connect = std::function<std::unique_ptr<Connection>(Peer&)>;
  void serve_websocket(const std::string& subprotocol, Connect connect) {
    endpoints_[subprotocol] = std::move(connect);
  }

  // GET of `path` is answered by what `make` gives to its argument, once, in any thread: a text of
  // that content type, or an error, which becomes a 503.
  using Answer = std::function<void(Result<std::string>)>;
  void serve_text(const std::string& path, std::string content_type,
                  std::function<void(Answer)> make);

  // GET of `path`/FILE is answered by the folder's file, if its name ends with `suffix`.
  void serve_folder(const std::string& path, const std::filesystem::path& folder,
                    std::string suffix, std::string content_type) {
    folders_.push_back({path, folder.string(), std::move(suffix), std::move(content_type)});
  }

  // Calls `call` in the thread of run(), each `period`.
  void repeat(Duration period, std::function<void()> call);

  // --- serving

  //   returns  the port
  //   fails    system (the port is in use, no such address, a file cannot be read)
  Result<std::uint16_t> listen();

  // Calls `call` in the thread of run(), soon. Any thread may call it.
  void post(std::function<void()> call);

  // Serves until stop(), which is async-signal-safe; then ends all connections. After listen().
  void run();
  void stop() noexcept;

 private:
  struct Library;  // what libwebsockets needs as long as its context lives
  class Credentials;
  struct Timer;
  struct WebSocket;
  struct Text {
    std::string content_type;
    std::function<void(Answer)> make;
  };
  struct Folder {
    std::string path, folder, suffix, content_type;
  };
  // A client that waits for a text.
  struct Request {
    lws* connection;
    std::string path;
    bool is_made = false;
    Result<std::string> text = std::string();
  };

  static int on_event(lws* connection, int reason, void* user, void* in, std::size_t length);
  // Of these, the result tells libwebsockets whether to end the connection.
  bool on_http(lws* connection, int reason, std::uint64_t& request);
  bool on_websocket(lws* connection, int reason, WebSocket*& socket, void* in, std::size_t length);
  bool begin_text(lws* connection, std::uint64_t& request, const std::string& path);
  // What a client gets that asks for something else than what is here.
  Error nothing_at(const std::string& path) const;
  bool write_text(lws* connection, Request& request);
  static bool write_message(WebSocket& socket);
  // Why a client's request is refused, for people; empty: it is not.
  std::string refusal(lws* connection) const;
  void follow_credentials();
  void call_posted();
  void end();

  const ServerOptions options_;
  std::unique_ptr<Library> library_;
  std::unique_ptr<Credentials> credentials_;  // with TLS
  lws_context* context_ = nullptr;
  std::map<std::string, Connect> endpoints_;
  std::map<std::string, Text> texts_;
  std::vector<Folder> folders_;
  std::map<std::uint64_t, Request> requests_;  // by their numbers, from 1 on
  std::uint64_t last_request_ = 0;
  std::set<std::string> reported_;  // refusals
  std::set<WebSocket*> websockets_;
  std::vector<std::unique_ptr<Timer>> timers_;
  std::mutex mutex_;
  std::vector<std::function<void()>> posted_;
  bool is_running_ = false;  // context_ may be woken up
  std::atomic<bool> is_stopped_{false};
};

}  // namespace dssm::view
