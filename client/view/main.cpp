// SPDX-License-Identifier: Apache-2.0
//
// dssm-view: shows the streams of all hosts in a web browser, to Foxglove, and their figures to
// Prometheus. It is a reader as any other: what it does, or a browser that hangs, delays no other
// program. Or it shows a recording.
//
// Exit status: 0 ended by a signal, 1 failure, 2 wrong usage.
#include <fmt/format.h>
#include <signal.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdio>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include "client/dssmctl/config_words.hpp"
#include "client/dssmctl/metrics.hpp"
#include "client/dssmctl/text.hpp"
#include "client/view/foxglove.hpp"
#include "client/view/page.hpp"
#include "client/view/saver.hpp"
#include "client/view/server.hpp"
#include "client/view/state.hpp"
#include "client/view/streams.hpp"
#include "client/view/worker.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

constexpr int kSuccess = 0;
constexpr int kFailure = 1;
constexpr int kWrongUsage = 2;

constexpr Duration kClosePeriod = std::chrono::seconds(5);
// How often a recording's state is given to pages, which wait for the next one.
constexpr Duration kStatePeriod = std::chrono::seconds(1);

struct Options {
  std::string listen = "127.0.0.1:8765";
  std::string socket_path;
  std::string recording;  // a file or folder; empty: the vehicle
  bool insecure = false;
  ServerOptions server;
};

Server* running_server = nullptr;
void on_stop_signal(int /*signal*/) { running_server->stop(); }

Error wrong(std::string text) { return {Errc::invalid_argument, std::move(text)}; }

// Address and port of "127.0.0.1:8765", "[::1]:8765".
Result<void> split_listen(Options& options) {
  const std::string& text = options.listen;
  const std::size_t colon = text.rfind(':');
  const Result<std::uint64_t> port = colon == std::string::npos
                                         ? Result<std::uint64_t>(wrong(""))
                                         : ctl::parse_whole(text.substr(colon + 1), 0, 65535);
  std::string address = text.substr(0, colon);
  if (address.size() > 2 && address.front() == '[' && address.back() == ']') {
    address = address.substr(1, address.size() - 2);
  }
  if (!port || address.empty()) {
    return wrong(
        fmt::format("--listen '{}' is not ADDRESS:PORT, as 127.0.0.1:8765", ctl::escaped(text)));
  }
  if (!is_address(address)) {
    return wrong(fmt::format(
        "--listen {}: '{}' is not a numeric address of this PC, as 127.0.0.1:8765 or [::1]:8765",
        ctl::escaped(text), ctl::escaped(address)));
  }
  options.server.address = address;
  options.server.port = static_cast<std::uint16_t>(*port);
  const bool is_loopback = address.starts_with("127.") || address == "::1";
  if (!is_loopback && options.server.certificate.empty() && !options.insecure) {
    return wrong(fmt::format(
        "with --listen {} other PCs could read all streams: give --certificate, --key and "
        "--authority, or --insecure if all who reach that address may read them",
        ctl::escaped(text)));
  }
  return {};
}

constexpr std::string_view kNameCharacters =
    "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_.";
constexpr std::string_view kSchemeCharacters = "abcdefghijklmnopqrstuvwxyz0123456789+-.";
constexpr std::string_view kServerCharacters = "abcdefghijklmnopqrstuvwxyz0123456789-_.:[]";

// Names and origins that a browser would never send.
Result<void> check_names(const ServerOptions& server) {
  const auto has_only = [](std::string_view text, std::string_view characters) {
    return !text.empty() && text.find_first_not_of(characters) == std::string_view::npos;
  };
  for (const std::string& host : server.hosts) {
    if (!has_only(host, kNameCharacters)) {
      return wrong(
          fmt::format("--host '{}' is not a name, as robot.example.org: without scheme "
                      "and port",
                      ctl::escaped(host)));
    }
  }
  for (const std::string& origin : server.origins) {
    const std::size_t colon = origin.find("://");
    const std::string scheme = origin.substr(0, colon);
    const std::string rest = colon == std::string::npos ? "" : origin.substr(colon + 3);
    const bool has_usual_port = (scheme == "http" && rest.ends_with(":80")) ||
                                (scheme == "https" && rest.ends_with(":443"));
    const bool is_server =
        has_only(scheme, kSchemeCharacters) && !has_usual_port && has_only(rest, kServerCharacters);
    // What the pages of a browser's files send.
    if (!is_server && origin != "null" && origin != "file://") {
      return wrong(
          fmt::format("--origin '{}' is not what browsers send, as "
                      "https://app.foxglove.dev or http://robot:8080: scheme and server "
                      "in small letters, a port unless it is the usual one, no path",
                      ctl::escaped(origin)));
    }
  }
  return {};
}

// The vehicle, or the recording.
Result<Source> open_source(const Options& options) {
  if (!options.recording.empty()) return Source(DSSM_TRY(Recording::open(options.recording)));
  SessionOptions session_options;
  session_options.socket_path = options.socket_path;
  session_options.program = "dssm-view";
  session_options.on_notice = [](const std::string&) {};
  return Source(DSSM_TRY(Session::connect(session_options)));
}

Result<void> serve(Options options) {
  DSSM_TRY(split_listen(options));
  DSSM_TRY(check_names(options.server));
  Source source = DSSM_TRY(open_source(options));
  auto* const session = std::get_if<Session>(&source);  // none: a recording is shown
  std::optional<VehicleState> recorded;
  if (!session) recorded = recorded_state(std::get<Recording>(source));
  const std::string shown = session ? DSSM_TRY(session->daemon_info()).host : recorded->host;
  std::variant<PlaybackClock, Recording> played =
      session ? std::variant<PlaybackClock, Recording>(DSSM_TRY(session->open_playback_clock()))
              : std::get<Recording>(source);

  // Signals are for this thread: the others must not stop a server that may have ended.
  sigset_t all, before;
  ::sigfillset(&all);
  ::pthread_sigmask(SIG_SETMASK, &all, &before);
  Server server(options.server);
  Streams streams(source, server);
  std::optional<StateCollector> collector;
  if (session) collector.emplace(*session, options.socket_path);
  const auto want_all = [&] {
    if (collector) collector->want_all();
  };
  std::optional<Saver> saver;
  if (session) saver.emplace(*session, server);
  Pages pages(streams, saver ? &*saver : nullptr, want_all);
  FoxgloveClients foxglove(shown, streams, want_all, std::move(played));
  const auto on_state = [&](const VehicleState& state) {
    foxglove.on_state(state);
    pages.on_state(state);
  };
  Worker scrapes;

  server.serve_websocket("dssm.view.v1", [&](Peer& peer) { return pages.connect(peer); });
  for (const char* name : {"foxglove.sdk.v1", "foxglove.websocket.v1"}) {
    server.serve_websocket(name, [&](Peer& peer) { return foxglove.connect(peer); });
  }
  if (session) {
    server.serve_text("/metrics", "application/openmetrics-text; version=1.0.0; charset=utf-8",
                      [&](const Server::Answer& answer) {
                        scrapes.add([&, answer] { answer(ctl::metrics_text(*session)); });
                      });
  }
  server.repeat(FoxgloveClients::kSendPeriod, [&] { foxglove.send_samples(); });
  server.repeat(kClosePeriod, [&] { streams.close_unused(); });
  if (recorded) {
    server.repeat(kStatePeriod, [&] {
      show_warnings(std::get<Recording>(source), *recorded);
      on_state(*recorded);
    });
  }
  const std::uint16_t port = DSSM_TRY(server.listen());
  if (session) {
    collector->start([&](const VehicleState& state) {
      server.post([&, known = VehicleState(state)]() mutable {
        for (std::size_t i = 0; i < known.streams.size(); ++i) {
          if (const auto oldest = streams.known_oldest(known.streams[i], known.host)) {
            known.set_oldest(i, *oldest);
          }
        }
        show_oldest(known);
        on_state(known);
      });
    });
  } else {
    on_state(*recorded);
  }

  running_server = &server;
  struct sigaction action {};
  action.sa_handler = on_stop_signal;
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) ::sigaction(number, &action, nullptr);
  ::pthread_sigmask(SIG_SETMASK, &before, nullptr);
  const std::string& address = options.server.address;
  const std::string host = address.find(':') == std::string::npos ? address : "[" + address + "]";
  std::puts(fmt::format("dssm-view: http{}://{}:{}/", options.server.certificate.empty() ? "" : "s",
                        host, port)
                .c_str());
  std::fflush(stdout);
  server.run();
  return {};
}

int report(const Error& error) {
  std::fputs(fmt::format("dssm-view: {}\n", ctl::escaped_message(error.message)).c_str(), stderr);
  return error.code == Errc::invalid_argument ? kWrongUsage : kFailure;
}

int main_program(int argc, char** argv) {
  Options options;
  ServerOptions& server = options.server;
  server.pages = DSSM_VIEW_PAGES;
  CLI::App app(
      "Shows the streams of all hosts in a web browser and to Foxglove, and their figures to "
      "Prometheus (/metrics). Or shows a recording (--open).",
      "dssm-view");
  // What is on the command line comes after the file.
  app.option_defaults()->multi_option_policy(CLI::MultiOptionPolicy::TakeLast);
  app.set_version_flag("--version", DSSM_VERSION);
  app.add_option("--listen", options.listen, "Where to listen")
      ->type_name("ADDRESS:PORT")
      ->capture_default_str();
  app.add_option("--socket", options.socket_path,
                 "dssmd's socket (default: $DSSM_SOCKET, else "
                 "/run/dssm/dssmd.sock)")
      ->type_name("PATH");
  app.add_option("--open", options.recording,
                 "Show this recording, or the ones in this folder; no dssmd is needed")
      ->type_name("FILE");
  app.add_option("--certificate", server.certificate, "TLS: this server's certificate (PEM)")
      ->type_name("FILE");
  app.add_option("--key", server.key, "TLS: its private key (PEM)")->type_name("FILE");
  app.add_option("--authority", server.authority,
                 "TLS: clients must have a certificate of this CA (PEM)")
      ->type_name("FILE");
  app.add_option("--revoked", server.revoked,
                 "TLS: this list of that CA has the certificates that do not count any more (PEM)")
      ->type_name("FILE");
  app.add_flag("--insecure", options.insecure,
               "Listen for other PCs without TLS: all who reach the address may read all streams");
  app.add_option("--host", server.hosts, "A further name by which browsers may call this server")
      ->type_name("NAME")
      ->multi_option_policy(CLI::MultiOptionPolicy::Throw);
  app.add_option("--origin", server.origins,
                 "A server whose pages may connect, as https://app.foxglove.dev")
      ->type_name("URL")
      ->multi_option_policy(CLI::MultiOptionPolicy::Throw);
  app.add_option("--pages", server.pages, "The folder with the page")
      ->type_name("FOLDER")
      ->envname("DSSM_VIEW_PAGES");
  std::string config;
  bool is_configured = false;  // what is parsed is from the file, too
  app.add_option("--config", config,
                 "A TOML file with options as keys, before those of the command line")
      ->type_name("FILE");
  try {
    app.parse(argc, argv);
    if (!config.empty()) {
      std::vector<std::string> words(argv + 1, argv + argc);
      const Result<std::vector<std::string>> configured = ctl::config_words(config);
      if (!configured) return report(configured.error());
      words.insert(words.begin(), configured->begin(), configured->end());
      std::ranges::reverse(words);  // as CLI11 takes them
      app.clear();
      is_configured = true;
      app.parse(std::move(words));
    }
  } catch (const CLI::ParseError& error) {
    // The command line alone was right.
    if (is_configured && error.get_exit_code() != 0) {
      return report(wrong(
          fmt::format("configuration '{}', whose keys are options: {}", config, error.what())));
    }
    return app.exit(error) == 0 ? kSuccess : kWrongUsage;
  }
  if (server.certificate.empty() != server.key.empty() ||
      (server.certificate.empty() && !server.authority.empty()) ||
      (server.authority.empty() && !server.revoked.empty())) {
    std::fputs(
        "dssm-view: --certificate and --key belong together, --authority needs both, and "
        "--revoked needs --authority\n",
        stderr);
    return kWrongUsage;
  }
  if (!std::filesystem::exists(server.pages / "index.html")) {
    return report({Errc::not_found, fmt::format("there is no page in '{}'; name its folder by "
                                                "--pages (in the sources: client/view/web)",
                                                server.pages.string())});
  }
  const Result<void> served = serve(std::move(options));
  return served ? kSuccess : report(served.error());
}

}  // namespace
}  // namespace dssm::view

// NOLINTNEXTLINE(bugprone-exception-escape): what is thrown ends the program
int main(int argc, char** argv) { return dssm::view::main_program(argc, argv); }
