// SPDX-License-Identifier: Apache-2.0
//
// dssmctl metrics: what this PC's dssmd knows, as OpenMetrics text, which Prometheus reads
// (https://github.com/prometheus/OpenMetrics, version 1.0). Nothing is counted for it: what is not
// asked for costs nothing.
//
// Labels are names of hosts, streams and limits only, so that the number of series is bounded by
// that of the streams. What is not known has no sample, as the streams of a host that does not
// answer.
#include "client/dssmctl/metrics.hpp"

#include <fmt/format.h>
#include <unistd.h>

#include <dssm/session.hpp>
#include <fstream>
#include <functional>
#include <optional>
#include <set>
#include <sstream>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

using Number = std::optional<double>;  // empty: not known

double seconds(Duration duration) { return std::chrono::duration<double>(duration).count(); }

Number known_bound(Duration bound) {
  return bound == kUnknownClockError ? Number() : Number(seconds(bound));
}

std::string label(std::string_view name, std::string_view value) {
  std::string text;
  for (const char c : value) {
    if (c == '\n') {
      text += "\\n";
      continue;
    }
    if (c == '"' || c == '\\') text += '\\';
    text += c;
  }
  return fmt::format("{}=\"{}\"", name, text);
}

// One metric with all its samples, which must follow each other.
class Family {
 public:
  // type: "gauge" or "counter"
  Family(std::string& text, std::string_view name, std::string_view type, std::string_view help)
      : text_(text), name_(name), type_(type), help_(help) {}

  void add(const std::string& labels, Number value) {
    if (!value) return;
    if (!std::exchange(has_head_, true)) {
      text_ += fmt::format("# TYPE {} {}\n", name_, type_);
      for (const std::string_view unit : {"seconds", "bytes", "hertz"}) {
        if (name_.ends_with(fmt::format("_{}", unit))) {
          text_ += fmt::format("# UNIT {} {}\n", name_, unit);
        }
      }
      text_ += fmt::format("# HELP {} {}\n", name_, help_);
    }
    text_ += fmt::format("{}{}{} {}\n", name_, type_ == "counter" ? "_total" : "",
                         labels.empty() ? "" : "{" + labels + "}", *value);
  }

 private:
  std::string& text_;
  std::string_view name_, type_, help_;
  bool has_head_ = false;
};

// A family with a sample for each of `items`.
template <class Item>
void add_each(std::string& text, const std::vector<Item>& items, std::string_view name,
              std::string_view type, std::string_view help,
              const std::function<std::string(const Item&)>& labels,
              const std::function<Number(const Item&)>& value) {
  Family family(text, name, type, help);
  for (const Item& item : items) family.add(labels(item), value(item));
}

// --- dssmd

// What the kernel knows of dssmd: nothing where this program does not see its process.
void add_process(std::string& text, std::int32_t pid) {
  std::string name, stat;
  std::getline(std::ifstream(fmt::format("/proc/{}/comm", pid)), name);
  std::getline(std::ifstream(fmt::format("/proc/{}/stat", pid)), stat);
  const std::size_t name_end = stat.rfind(')');
  if (name != "dssmd" || name_end == std::string::npos) return;
  // proc(5): what follows the name is field 3.
  std::istringstream fields(stat.substr(name_end + 1));
  std::vector<std::string> field(3);
  for (std::string one; fields >> one;) field.push_back(one);
  if (field.size() <= 24) return;
  const auto ticks = [&](std::size_t number) {
    return std::stod(field[number]) / static_cast<double>(::sysconf(_SC_CLK_TCK));
  };
  Family(text, "dssm_daemon_cpu_seconds", "counter", "Processor time that dssmd has used.")
      .add("", ticks(14) + ticks(15));
  Family(text, "dssm_daemon_resident_memory_bytes", "gauge", "Memory of dssmd, rings included.")
      .add("", std::stod(field[24]) * static_cast<double>(::sysconf(_SC_PAGESIZE)));
  std::ifstream system("/proc/stat");
  for (std::string line; std::getline(system, line);) {
    constexpr std::string_view kBoot = "btime ";
    if (!line.starts_with(kBoot)) continue;
    Family(text, "dssm_daemon_start_time_seconds", "gauge", "When dssmd was started, since 1970.")
        .add("", std::stod(line.substr(kBoot.size())) + ticks(22));
  }
}

void add_daemon(std::string& text, const DaemonInfo& daemon) {
  Family(text, "dssm_build_info", "gauge", "The version of dssmd; always 1.")
      .add(label("version", daemon.version), 1);
  Family(text, "dssm_ring_memory_bytes", "gauge",
         "Memory of all rings here: of own streams, and of others that are read here.")
      .add("", static_cast<double>(daemon.memory_bytes));
  Family(text, "dssm_ring_memory_limit_bytes", "gauge", "What they may take together.")
      .add("", static_cast<double>(daemon.memory_limit_bytes));
  const std::function labels = [](const LimitInfo& limit) {
    return label("limit", limit.name) + "," + label("unit", limit.unit);
  };
  add_each<LimitInfo>(text, daemon.limits, "dssm_limit", "gauge",
                      "The limits of dssmd (docs/limits.md).", labels,
                      [](const LimitInfo& limit) { return static_cast<double>(limit.limit); });
  add_each<LimitInfo>(text, daemon.limits, "dssm_limit_used", "gauge",
                      "How much of each limit is used, by the one that uses most of it.", labels,
                      [](const LimitInfo& limit) { return static_cast<double>(limit.used); });
  add_process(text, daemon.pid);
}

// --- hosts

void add_hosts(std::string& text, const std::vector<HostInfo>& hosts) {
  const auto add = [&](std::string_view name, std::string_view help,
                       const std::function<Number(const HostInfo&)>& value) {
    add_each<HostInfo>(
        text, hosts, name, "gauge", help,
        [](const HostInfo& host) { return label("host", host.name); }, value);
  };
  add("dssm_host_up", "1: this host, or one that is connected; 0: one that is known, but is not.",
      [&](const HostInfo& host) { return is_up(host.state) ? 1 : 0; });
  add("dssm_host_streams", "Streams that the host owns.",
      [&](const HostInfo& host) { return is_up(host.state) ? Number(host.streams) : Number(); });
  add("dssm_host_round_trip_seconds", "Of the last heartbeat from this host.",
      [](const HostInfo& host) {
        return host.round_trip > Duration::zero() ? Number(seconds(host.round_trip)) : Number();
      });
  add("dssm_clock_bound_seconds", "How far the host's clock may be from the reference's.",
      [&](const HostInfo& host) { return known_bound(host.clock_bound()); });
  add("dssm_clock_distance_seconds", "How far the host's clock may be from this host's.",
      [&](const HostInfo& host) {
        return is_up(host.state) ? known_bound(host.clock_distance) : Number();
      });
  add("dssm_clock_refused", "1: reads by time refuse the host's samples here, for its clock.",
      [&](const HostInfo& host) {
        return is_up(host.state) ? Number(host.clock_refused ? 1 : 0) : Number();
      });
}

// --- streams

std::string stream_labels(const StreamInfo& stream) {
  return label("stream", stream.id.name) + fmt::format(",id=\"{}\",", stream.id.id) +
         label("host", stream.id.host);
}

void add_streams(std::string& text, const std::vector<StreamInfo>& streams) {
  const auto add = [&](std::string_view name, std::string_view type, std::string_view help,
                       const std::function<Number(const StreamInfo&)>& value) {
    add_each<StreamInfo>(text, streams, name, type, help, stream_labels, value);
  };
  add("dssm_stream_samples", "counter", "Samples written since the stream was created.",
      [](const StreamInfo& stream) { return static_cast<double>(stream.newest + 1); });
  add("dssm_stream_sample_bytes", "gauge", "Payload of a sample, at most.",
      [](const StreamInfo& stream) { return static_cast<double>(stream.type.payload_bytes); });
  add("dssm_stream_ring_memory_bytes", "gauge", "Memory of the stream's ring.",
      [](const StreamInfo& stream) { return static_cast<double>(stream.memory_bytes); });
  add("dssm_stream_rate_hertz", "gauge", "Samples a second, by the stamps of the newest ones.",
      [](const StreamInfo& stream) {
        return stream.rate_hz > 0 ? Number(stream.rate_hz) : Number();
      });
  add("dssm_stream_age_seconds", "gauge", "How old the newest sample is.",
      [&](const StreamInfo& stream) {
        return is_age_known(stream) ? Number(seconds(stream.age)) : Number();
      });
  add("dssm_stream_last_sample_timestamp_seconds", "gauge",
      "The time of the newest sample, since 1970.", [](const StreamInfo& stream) {
        return stream.newest == kNoTid
                   ? Number()
                   : Number(static_cast<double>(to_ns(stream.newest_time)) * 1e-9);
      });
  add("dssm_stream_stalled", "gauge",
      "1: no sample came for longer than the stream ever pauses, or nothing can write to it.",
      [&](const StreamInfo& stream) {
        return is_age_known(stream) ? Number(is_silent(stream) ? 1 : 0) : Number();
      });
  add("dssm_stream_readers", "gauge",
      "How many times the stream is open for reading, on all hosts.",
      [](const StreamInfo& stream) { return stream.readers; });
  add("dssm_stream_writers", "gauge",
      "How many times the stream is open for writing, on all hosts.",
      [](const StreamInfo& stream) { return stream.writers; });
  add("dssm_stream_crashed_writers", "counter",
      "Programs that had the stream open to write and ended without closing it.",
      [](const StreamInfo& stream) { return stream.crashed_writers; });
  add("dssm_stream_crashed_readers", "counter",
      "Programs that had the stream open to read and ended without closing it.",
      [](const StreamInfo& stream) { return stream.crashed_readers; });
}

// Of other hosts' streams that are read here.
void add_mirrors(std::string& text, const std::vector<StreamInfo>& mirrored) {
  const auto add = [&](std::string_view name, std::string_view help,
                       const std::function<std::uint64_t(const MirrorInfo&)>& value) {
    add_each<StreamInfo>(
        text, mirrored, name, "counter", help, stream_labels,
        [&](const StreamInfo& stream) { return static_cast<double>(value(*stream.mirror)); });
  };
  add("dssm_mirror_received_samples", "Samples of another host's stream that came here.",
      [](const MirrorInfo& mirror) { return mirror.received_samples; });
  add("dssm_mirror_received_bytes", "Payloads of another host's stream that came here.",
      [](const MirrorInfo& mirror) { return mirror.received_bytes; });
  add("dssm_mirror_lost_samples", "Samples of another host's stream that did not come here.",
      [](const MirrorInfo& mirror) { return mirror.gap_samples; });
  add("dssm_mirror_reconnects",
      "How often the connection that carries the stream was replaced by a new one.",
      [](const MirrorInfo& mirror) { return mirror.reconnects; });
}

}  // namespace

Result<std::string> metrics_text(Session& session) {
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  std::vector<HostInfo> hosts = DSSM_TRY(session.list_hosts());
  // One that never answered has no name; one with several addresses is listed with each.
  std::set<std::string> names;
  std::erase_if(hosts, [&](const HostInfo& host) {
    return host.name.empty() || host.reason == HostReason::spare_address ||
           !names.insert(host.name).second;
  });
  std::vector<StreamInfo> streams = DSSM_TRY(session.list_streams());
  // Of a host that does not answer: a count of 0 would be taken for a new stream.
  std::erase_if(streams, [](const StreamInfo& stream) {
    return stream.state == StreamState::unknown && stream.newest == kNoTid;
  });
  std::vector<StreamInfo> mirrored;
  for (const StreamInfo& stream : streams) {
    if (stream.id.host == daemon.host) continue;
    // It may be gone by now.
    Result<StreamInfo> info = session.stream_info(stream.id);
    if (info && info->mirror) mirrored.push_back(*std::move(info));
  }
  std::string text;
  add_daemon(text, daemon);
  add_hosts(text, hosts);
  add_streams(text, streams);
  add_mirrors(text, mirrored);
  return text + "# EOF\n";
}

Result<void> run(const MetricsOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  out.add(DSSM_TRY(metrics_text(session)));
  return {};
}

}  // namespace dssm::ctl
