// SPDX-License-Identifier: Apache-2.0
//
// The connection to dssmd, and what it reports of streams, hosts and processes.
//
// No function of Python is called from a thread of the session: it would wait for the GIL, which a
// thread that destroys the session may hold.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <dssm/session.hpp>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>

#include "client/python/reader.hpp"
#include "client/python/writer.hpp"

namespace dssm::python {
namespace {

using namespace std::chrono_literals;

struct Connection {
  std::optional<Session> session;  // empty: closed
  py::object on_notice;            // None: standard error
  std::string socket_path;         // as shown

  // A copy, which stays usable when another thread closes this one.
  Session get() const {
    if (!session) raise("closed", "the session is closed");
    return *session;
  }
};

// The name of this script, for dssmctl: the process is always called python3.
std::string script_name() {
  const py::object words = py::module_::import("sys").attr("argv");
  if (py::len(words) == 0) return {};
  const auto path = words[py::int_(0)].cast<std::string>();
  const std::string name = path.substr(path.find_last_of('/') + 1);
  return name == "-c" || name == "-" ? std::string() : name;
}

std::string shown_path(const SessionOptions& options) {
  if (!options.socket_path.empty()) return options.socket_path;
  // As Session::connect() has read it. NOLINTNEXTLINE(concurrency-mt-unsafe)
  const char* const path = std::getenv("DSSM_SOCKET");
  return path && *path ? path : "/run/dssm/dssmd.sock";
}

std::unique_ptr<Connection> connect(const std::string& socket_path, const std::string& program,
                                    py::handle request_timeout, const py::object& on_notice) {
  SessionOptions options;
  options.socket_path = socket_path;
  options.program = program.empty() ? script_name() : program;
  options.request_timeout = to_duration(request_timeout);
  auto connection = std::make_unique<Connection>();
  connection->session = value_without_gil([&] { return Session::connect(options); });
  connection->on_notice = on_notice;
  connection->socket_path = shown_path(options);
  return connection;
}

void notify(const Connection& connection, const std::string& text) {
  if (!connection.on_notice.is_none()) {
    connection.on_notice(text);
  } else {
    std::fprintf(stderr, "dssm: %s\n", text.c_str());
  }
}

// Session::await_raw_reader() does the same, but signals do not interrupt it.
RawReader await_reader(Connection& connection, const StreamId& id, MonoTime deadline,
                       FetchHistory history) {
  Session session = connection.get();
  std::mutex mutex;
  std::condition_variable changed;
  bool was_added = false;
  const auto on_event = [&](const StreamEvent& event) {
    if (event.stream.id.name != id.name) return;
    const std::lock_guard guard(mutex);
    was_added = true;
    changed.notify_one();
  };
  const MonoTime notice_at = deadline_in(2s);
  std::optional<Errc> reported;
  auto watch =
      std::make_unique<Session::Watch>(value_without_gil([&] { return session.watch(on_event); }));
  // Its end waits for a running callback.
  const auto end_watch = [](Session::Watch* ended) {
    const GilRelease released;
    delete ended;
  };
  const std::unique_ptr<Session::Watch, decltype(end_watch)> watching(watch.release(), end_watch);
  for (;;) {
    Result<RawReader> reader =
        without_gil([&] { return session.open_raw_reader(id, nullptr, 0, history); });
    if (reader) return *std::move(reader);
    const Error& error = reader.error();
    if (!is_retryable(error.code) || MonoClock::now() >= deadline) raise(error);
    if (MonoClock::now() >= notice_at && reported != error.code) {
      reported = error.code;
      notify(connection, "waiting for '" + id.str() + "': " + error.message);
    }
    wait_in_slices(std::min(deadline, deadline_in(500ms)), [&](MonoTime end) {
      std::unique_lock lock(mutex);
      const bool ready = changed.wait_until(lock, end, [&] { return was_added; });
      was_added = false;
      return ready ? WaitStatus::ready : WaitStatus::timeout;
    });
  }
}

std::shared_ptr<Reader> open_reader(Connection& connection, std::string_view name, py::handle type,
                                    py::handle wait, bool fetch_history) {
  const StreamId id = to_stream_id(name);
  const WantedType wanted = wanted_type(type);
  const auto history = fetch_history ? FetchHistory::at_once : FetchHistory::when_read;
  if (wait.is(py::handle(Py_False))) {
    Session session = connection.get();
    return std::make_shared<Reader>(
        value_without_gil([&] { return session.open_raw_reader(id, nullptr, 0, history); }),
        wanted);
  }
  return std::make_shared<Reader>(await_reader(connection, id, wait_deadline(wait), history),
                                  wanted);
}

// 0 for None.
std::uint64_t to_depth(py::handle depth) {
  if (depth.is_none()) return 0;
  if (!PyIndex_Check(depth.ptr()) || PyBool_Check(depth.ptr())) {
    throw py::type_error("depth is a whole number of slots, not " + std::string(py::repr(depth)));
  }
  const auto number = py::reinterpret_steal<py::object>(PyNumber_Index(depth.ptr()));
  const std::uint64_t slots = PyLong_AsUnsignedLongLong(number.ptr());
  if (PyErr_Occurred()) {  // negative, or too large
    PyErr_Clear();
    throw py::value_error("depth is a number of slots, not " + std::string(py::repr(number)));
  }
  return slots;
}

std::unique_ptr<Writer> create_stream(Connection& connection, std::string_view name,
                                      py::handle type, py::handle cycle, py::handle life,
                                      py::handle depth, bool keep_existing) {
  const StreamId id = to_stream_id(name);
  const WantedType wanted = wanted_type(type);
  const std::string what = "create() of '" + id.str() + "' needs ";
  if (!wanted.type) throw py::type_error(what + "type: of the stream's samples, such as 'f8'");
  if (cycle.is_none()) {
    throw py::type_error(what + "cycle: the expected time between two samples [s], such as 0.1");
  }
  if (life.is_none() == depth.is_none()) {
    throw py::type_error(what + "how much history the stream keeps: either life [s] or depth");
  }
  History history{to_depth(depth), to_duration(cycle)};
  if (!life.is_none()) history = value_of(History::for_life(to_duration(life), history.cycle));
  Session session = connection.get();
  return std::make_unique<Writer>(value_without_gil([&] {
                                    return session.create_raw(id, *wanted.type, history,
                                                              {.keep_existing = keep_existing});
                                  }),
                                  wanted);
}

std::unique_ptr<Writer> open_writer(Connection& connection, std::string_view name,
                                    py::handle type) {
  const StreamId id = to_stream_id(name);
  const WantedType wanted = wanted_type(type);
  Session session = connection.get();
  return std::make_unique<Writer>(
      value_without_gil(
          [&] { return session.open_raw_writer(id, wanted.type ? &*wanted.type : nullptr); }),
      wanted);
}

py::object stream_property(Connection& connection, std::string_view name) {
  const StreamId id = to_stream_id(name);
  Session session = connection.get();
  value_without_gil([&] { return session.stream_info(id); });  // not_found below: there is none
  const auto property = without_gil([&] { return session.property(id); });
  if (!property && property.error().code == Errc::not_found) return py::none();
  if (!property) raise(property.error());
  return py::bytes(reinterpret_cast<const char*>(property->data()), property->size());
}

void set_stream_property(Connection& connection, std::string_view name, std::string_view property) {
  const StreamId id = to_stream_id(name);
  Session session = connection.get();
  value_without_gil([&] {
    return session.set_property(
        id, std::as_bytes(std::span<const char>(property.data(), property.size())));
  });
}

// --- what is only shown

std::optional<std::int64_t> optional_ns(Duration duration) {
  return duration == kUnknownClockError ? std::nullopt : std::optional(to_ns(duration));
}

void define_session_infos(py::module_& module) {
  py::class_<StreamUser>(module, "StreamUser", "A process that has a stream open.")
      .def_readonly("pid", &StreamUser::pid, "Its process id; 0: not known.")
      .def_readonly("program", &StreamUser::program, "Its name.")
      .def_readonly("host", &StreamUser::host, "Where it runs.")
      .def_property_readonly(
          "role", [](const StreamUser& u) { return u.role == Role::writer ? "writer" : "reader"; },
          "'reader' or 'writer'.")
      .def_property_readonly(
          "via", [](const StreamUser& u) { return std::string(name_of(u.via)); },
          "How: 'local', 'mirror', 'remote writer', 'connection'.");
  py::class_<StreamInfo>(module, "StreamInfo", "The present state of a stream.")
      .def_property_readonly(
          "name", [](const StreamInfo& s) { return s.id.str(); }, "'lidar:0@pc1'.")
      .def_property_readonly(
          "host", [](const StreamInfo& s) { return s.id.host; }, "The host that owns it.")
      .def_readonly("type", &StreamInfo::type, "Its description.")
      .def_readonly("depth", &StreamInfo::depth, "The slots of its ring.")
      .def_property_readonly(
          "cycle", [](const StreamInfo& s) { return to_seconds(s.cycle); },
          "The expected time between two samples [s].")
      .def_readonly("memory_bytes", &StreamInfo::memory_bytes, "Of the ring.")
      .def_readonly("property_bytes", &StreamInfo::property_bytes, "Of its property; 0: none.")
      .def_readonly("oldest_tid", &StreamInfo::oldest, "The tid of the oldest sample; NO_TID.")
      .def_readonly("newest_tid", &StreamInfo::newest, "The tid of the newest sample; NO_TID.")
      .def_property_readonly(
          "newest_time_ns",
          [](const StreamInfo& s) {
            return s.newest == kNoTid ? std::nullopt : std::optional(to_ns(s.newest_time));
          },
          "The time of the newest sample; None while nothing is written.")
      .def_readonly("rate_hz", &StreamInfo::rate_hz, "Samples a second; 0: not known.")
      .def_property_readonly(
          "state", [](const StreamInfo& s) { return std::string(name_of(s.state)); },
          "'live', 'stalled', 'no writer', 'empty' or 'unknown'.")
      .def_readonly("writers", &StreamInfo::writers,
                    "How many times it is open for writing, on all hosts.")
      .def_readonly("readers", &StreamInfo::readers,
                    "How many times it is open for reading, on all hosts.")
      .def_readonly("users", &StreamInfo::users, "The processes; from Session.stream() only.")
      .def("__repr__", [](const StreamInfo& s) { return "<dssm.StreamInfo " + s.id.str() + ">"; });
  py::class_<HostInfo>(module, "HostInfo", "A host as this PC's dssmd sees it.")
      .def_readonly("name", &HostInfo::name, "Empty until it has answered.")
      .def_readonly("addresses", &HostInfo::addresses, "As configured and as reached.")
      .def_readonly("version", &HostInfo::version, "Of its dssmd.")
      .def_property_readonly(
          "state", [](const HostInfo& h) { return std::string(name_of(h.state)); },
          "Such as 'up' or 'down'.")
      .def_readonly("error", &HostInfo::error, "Why it is not up; empty: it is.")
      .def_property_readonly(
          "round_trip", [](const HostInfo& h) { return to_seconds(h.round_trip); },
          "Of the last heartbeat [s]; 0: none yet.")
      .def_readonly("streams", &HostInfo::streams, "How many it owns.")
      .def_property_readonly(
          "clock_distance_ns", [](const HostInfo& h) { return optional_ns(h.clock_distance); },
          "Greatest distance of its clock from this PC's [ns]; None: not known.")
      .def_readonly("clock_reason", &HostInfo::clock_reason,
                    "Why its times are not good here; empty: they are.")
      .def("__repr__", [](const HostInfo& h) {
        return "<dssm.HostInfo " + h.name + " " + std::string(name_of(h.state)) + ">";
      });
  py::class_<DaemonInfo>(module, "DaemonInfo", "This PC's dssmd.")
      .def_readonly("host", &DaemonInfo::host, "The name of this PC.")
      .def_readonly("version", &DaemonInfo::version, "Of dssmd.")
      .def_readonly("pid", &DaemonInfo::pid, "Of dssmd.")
      .def_readonly("streams", &DaemonInfo::streams, "How many it has.")
      .def_readonly("memory_bytes", &DaemonInfo::memory_bytes, "Of all rings.")
      .def_readonly("memory_limit_bytes", &DaemonInfo::memory_limit_bytes, "For all rings.");
}

// Rounded up; at most an hour, after which the caller checks again.
Duration to_nanoseconds(double seconds) {
  return std::chrono::ceil<Duration>(std::chrono::duration<double>(std::min(seconds, 3600.0)));
}

// PlaybackClock::sleep_until() does the same, but a signal between two calls does not interrupt it.
void sleep_until(const PlaybackClock& clock, double time_s) {
  for (;;) {
    const PlaybackClock::Setting setting = clock.setting();
    const double left_s = setting.speed < 0 ? clock.now_s() - time_s : time_s - clock.now_s();
    if (left_s <= 0) return;
    constexpr double kMaxSleepS = 0.01;  // follows each change of the clock within this time
    const bool runs = !setting.paused && setting.speed != 0;
    const double real_s =
        runs ? std::min(left_s / std::abs(setting.speed), kMaxSleepS) : kMaxSleepS;
    without_gil([&] {
      if (!sleep_in_lockstep(to_nanoseconds(left_s))) {
        std::this_thread::sleep_for(to_nanoseconds(real_s));
      }
    });
    if (PyErr_CheckSignals() != 0) throw py::error_already_set();
  }
}

void define_playback_clock(py::module_& module) {
  py::class_<PlaybackClock>(
      module, "PlaybackClock",
      "The PC's playback clock: real time, or what a player of recordings sets. "
      "Times are float seconds since 1970.")
      .def("now", &PlaybackClock::now_s, "The time of the clock [s].")
      .def("sleep_until", &sleep_until, py::arg("time"),
           "Waits until now() has reached `time` [s].")
      .def(
          "reset", [](PlaybackClock& clock) { without_gil([&] { clock.reset(); }); },
          "Shows the real time.")
      .def(
          "set_time",
          [](PlaybackClock& clock, double time_s) { without_gil([&] { clock.set_time(time_s); }); },
          py::arg("time"), "Sets now() to `time` [s].")
      .def(
          "set_speed",
          [](PlaybackClock& clock, double speed) { without_gil([&] { clock.set_speed(speed); }); },
          py::arg("speed"), "1: real time; 0: stands still; negative: backwards.")
      .def(
          "set_paused",
          [](PlaybackClock& clock, bool paused) { without_gil([&] { clock.set_paused(paused); }); },
          py::arg("paused"), "Stops it, or continues.")
      .def_property_readonly(
          "speed", [](const PlaybackClock& clock) { return clock.setting().speed; }, "Its speed.")
      .def_property_readonly(
          "paused", [](const PlaybackClock& clock) { return clock.setting().paused; },
          "Whether it is stopped.");
}

}  // namespace

void define_sessions(py::module_& module) {
  define_session_infos(module);
  define_playback_clock(module);
  py::class_<Connection>(module, "Session",
                         "The connection to this PC's dssmd. Any thread may call any function.\n\n"
                         "A process made by fork() needs a session of its own.")
      .def(py::init(&connect), py::arg("socket_path") = "", py::kw_only(), py::arg("program") = "",
           py::arg("request_timeout") = 5.0, py::arg("on_notice") = py::none(),
           "Connects to dssmd.\n\n"
           "socket_path: '' is $DSSM_SOCKET, else /run/dssm/dssmd.sock.\n"
           "program: shown by dssmctl; '' is the name of the script.\n"
           "request_timeout: how long calls wait for dssmd.\n"
           "on_notice: called with a text when reader(wait=...) waits for longer than 2 s; None "
           "prints it.")
      .def("reader", &open_reader, py::arg("name"), py::arg("type") = py::none(), py::kw_only(),
           py::arg("wait") = false, py::arg("fetch_history") = false,
           "Opens a stream for reading.\n\n"
           "type: None takes the stream's own; else a numpy.dtype, what numpy makes one of, a "
           "dataclass "
           "or a TypeInfo, and raises TypeMismatch if the stream has another one.\n"
           "wait: False raises NotFound at once; True waits for the stream, a duration at most so "
           "long.\n"
           "fetch_history: of another host's stream, fetch its history, and return when it is here "
           "or after 1 s. Else it is fetched when it is read, which raises Arriving until it is "
           "here.")
      .def("create", &create_stream, py::arg("name"), py::arg("type") = py::none(), py::kw_only(),
           py::arg("cycle") = py::none(), py::arg("life") = py::none(),
           py::arg("depth") = py::none(), py::arg("keep_existing") = false,
           "Creates a stream, if there is none of that type, and opens it for writing.\n\n"
           "type: as in reader().\n"
           "cycle: the expected time between two samples; needed, as is the type.\n"
           "life: how long samples are kept, at one each cycle; or depth: slots for samples, one "
           "more than "
           "are kept.\n"
           "keep_existing: keeps an existing stream also if it has less history.")
      .def("writer", &open_writer, py::arg("name"), py::arg("type") = py::none(),
           "Opens an existing stream for writing; type: as in reader().")
      .def(
          "remove",
          [](Connection& c, std::string_view name) {
            const StreamId id = to_stream_id(name);
            Session session = c.get();
            value_without_gil([&] { return session.remove(id); });
          },
          py::arg("name"), "Removes a stream. What has it open keeps its samples.")
      .def(
          "streams",
          [](Connection& c) {
            Session session = c.get();
            return value_without_gil([&] { return session.list_streams(); });
          },
          "All streams, of all hosts.")
      .def(
          "stream",
          [](Connection& c, std::string_view name) {
            const StreamId id = to_stream_id(name);
            Session session = c.get();
            return value_without_gil([&] { return session.stream_info(id); });
          },
          py::arg("name"), "One stream, with its users. Raises NotFound.")
      .def(
          "hosts",
          [](Connection& c) {
            Session session = c.get();
            return value_without_gil([&] { return session.list_hosts(); });
          },
          "This PC, and all other hosts.")
      .def("property", &stream_property, py::arg("name"),
           "A stream's property as bytes; None if it has none.")
      .def("set_property", &set_stream_property, py::arg("name"), py::arg("property"),
           "Replaces a stream's property; b'' removes it.")
      .def(
          "playback_clock",
          [](Connection& c) {
            Session session = c.get();
            return value_without_gil([&] { return session.open_playback_clock(); });
          },
          "The PC's playback clock.")
      .def(
          "daemon",
          [](Connection& c) {
            Session session = c.get();
            return value_without_gil([&] { return session.daemon_info(); });
          },
          "This PC's dssmd.")
      .def_property_readonly(
          "is_connected", [](Connection& c) { return c.get().is_connected(); },
          "Whether it is connected now; it reconnects by itself.")
      .def(
          "close", [](Connection& c) { c.session.reset(); },
          "Closes the connection. Readers and writers remain usable.")
      .def("__repr__",
           [](const Connection& c) {
             if (!c.session) return std::string("<dssm.Session closed>");
             const char* const state = c.session->is_connected() ? "connected" : "not connected";
             return "<dssm.Session " + c.socket_path + " " + state + ">";
           })
      .def("__enter__", [](py::object self) { return self; })
      .def("__exit__", [](Connection& c, const py::args&) { c.session.reset(); });
}

}  // namespace dssm::python
