// SPDX-License-Identifier: Apache-2.0
//
// The checks of dssmctl doctor that concern streams. Names are used as they came; doctor.cpp
// escapes them when it prints.
#include <fmt/format.h>

#include <algorithm>
#include <map>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/doctor.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

using Status = Finding::Status;

constexpr std::size_t kMaxNamed = 5;  // of streams in one text
// A ring that holds less than this part of the time that it was created for is too short.
constexpr double kMinPartOfHistory = 0.8;

// As one word of a shell's command.
std::string shell_word(const std::string& name) {
  std::string text = "'";
  for (const char c : name) text += c == '\'' ? std::string("'\\''") : std::string(1, c);
  return text + "'";
}

// "a, b, and 3 more".
std::string first_of(std::vector<std::string> texts) {
  std::string more;
  if (texts.size() > kMaxNamed) {
    more = fmt::format(", and {} more", texts.size() - kMaxNamed);
    texts.resize(kMaxNamed);
  }
  return fmt::format("{}{}", fmt::join(texts, ", "), more);
}

Finding check_stream_names(const Facts& facts) {
  const Duplicates duplicates(facts.streams);
  if (duplicates.owners().empty()) {
    return {"stream names", Status::ok,
            facts.streams.empty() ? "there are no streams"
                                  : "each can be opened without its host's name"};
  }
  std::vector<std::string> named;
  std::string example;
  for (const auto& [key, hosts] : duplicates.owners()) {
    const std::string name = fmt::format("{}:{}", key.first, key.second);
    named.push_back(fmt::format("'{}' (on {})", name, list_text(hosts)));
    if (example.empty()) example = fmt::format("{}@{}", name, hosts.front());
  }
  return {"stream names", Status::warn,
          "several hosts have a stream of the same name: " + first_of(std::move(named)),
          "the same program runs on several hosts; a name without a host opens only a host's own "
          "stream",
          fmt::format("dssmctl info {}  # and so in programs", shell_word(example))};
}

// Streams that should have samples and do not, on all hosts.
Finding check_stalled(const Facts& facts) {
  std::vector<std::string> named;
  std::string example;
  bool has_writer = false;
  for (const StreamInfo& stream : facts.streams) {
    if (!is_silent(stream)) continue;
    const bool is_open = stream.state == StreamState::stalled;
    if (example.empty() || (is_open && !has_writer)) example = shell_word(stream.id.str());
    has_writer |= is_open;
    named.push_back(fmt::format("'{}' for {} ({})", stream.id.str(), age_text(stream),
                                is_open ? "its writer is connected" : "no writer is connected"));
  }
  if (named.empty()) return {"streams", Status::ok, "none is stalled"};
  return {"streams", Status::warn, "no samples of " + first_of(std::move(named)),
          has_writer ? "the sensor gives nothing, or the program that writes hangs"
                     : "the program that wrote it has ended",
          has_writer ? fmt::format("dssmctl info {}  # shows the program that writes", example)
                     : fmt::format("dssmctl info {0}  # then start its program, or remove the "
                                   "stream: dssmctl rm {0}",
                                   example)};
}

// The mirrors of this PC: whether what programs read here is what their owners have now.
Finding check_mirrors(const Facts& facts) {
  std::size_t mirrors = 0;
  std::vector<std::string> behind;
  std::string example;
  for (const StreamInfo& stream : facts.streams) {
    if (!stream.mirror) continue;
    mirrors += gets_samples(*stream.mirror) && stream.mirror->max_rate_hz == 0 ? 1 : 0;
    std::string what = carried_text(stream);
    if (!what.empty()) {
      what = fmt::format("the network {}", what);
    } else if (const Duration late = behind_owner(stream); late > Duration()) {
      what = duration_text(late) + " behind its owner";
    }
    if (what.empty()) continue;
    if (example.empty()) example = stream.id.str();
    behind.push_back(fmt::format("'{}': {}", stream.id.str(), what));
  }
  if (behind.empty()) {
    return {"mirrors", Status::ok,
            mirrors == 0
                ? "no stream of another host that answers is read here"
                : fmt::format("the network carries all that programs here read of {}",
                              mirrors == 1 ? "a stream of another host"
                                           : fmt::format("{} streams of other hosts", mirrors))};
  }
  return {"mirrors", Status::warn, first_of(std::move(behind)),
          "they write more than the network to their hosts carries, or it was just interrupted",
          fmt::format("dssmctl info {}  # then write less or shorter samples, limit its rate "
                      "here (key mirror_streams), or use a faster network",
                      shell_word(example))};
}

// Streams of hosts whose clocks are good, whose times are not: other hosts write to them, or a
// stricter limit is set for them.
Finding check_times(const Facts& facts) {
  std::vector<std::string> reasons;
  bool refuses = false;
  for (const StreamInfo& stream : facts.streams) {
    if (!stream.mirror || !gets_samples(*stream.mirror) || stream.mirror->clock.empty()) continue;
    // One that is down, or whose clock is not good, is another finding.
    const bool is_good = std::ranges::any_of(facts.hosts, [&](const HostInfo& host) {
      return host.name == stream.id.host && host.state == HostState::up &&
             host.clock_reason.empty();
    });
    if (!is_good) continue;
    reasons.push_back(stream.mirror->clock);
    refuses |= stream.mirror->clock_refused;
  }
  if (reasons.empty()) {
    return {"times", Status::ok,
            "those of all streams that are read here are as good as their hosts' clocks"};
  }
  return {"times", refuses ? Status::fail : Status::warn,
          "not good here: " + first_of(std::move(reasons)),
          refuses ? "reads by time refuse their samples, except where clock_policy is \"mark\""
                  : "reads by time deliver their samples, marked",
          "dssmctl clock  # on this PC, on the streams' hosts and where their writers run"};
}

// Rings that hold less of the past than their creators asked for: they are written more often than
// with the cycle that was stated.
Finding check_histories(const Facts& facts) {
  std::vector<std::string> shorter;
  std::string example;
  for (const StreamInfo& stream : facts.streams) {
    const double cycle_s = std::chrono::duration<double>(stream.cycle).count();
    if (stream.rate_hz <= 0 || stream.rate_hz * cycle_s * kMinPartOfHistory < 1) continue;
    const double slots = static_cast<double>(stream.depth - 1);
    if (example.empty()) example = stream.id.str();
    shorter.push_back(fmt::format("'{}' keeps {}, not {}: {:.1f} samples a second, not {:.1f}",
                                  stream.id.str(), ns_text(slots / stream.rate_hz * 1e9),
                                  ns_text(slots * cycle_s * 1e9), stream.rate_hz, 1 / cycle_s));
  }
  if (shorter.empty()) {
    return {"histories", Status::ok, "each stream keeps the past that it was created for"};
  }
  return {"histories", Status::warn, first_of(std::move(shorter)),
          "their writers are faster than the cycle that they give to create()",
          fmt::format("dssmctl hz {}  # then correct the cycle in the program that creates it",
                      shell_word(example))};
}

// Types that were compiled from several definitions.
Finding check_types(const Facts& facts) {
  std::map<std::string, const StreamInfo*> first;  // with a description, by the type's name
  std::vector<std::string> conflicts;
  std::string example;
  for (const StreamInfo& stream : facts.streams) {
    if (stream.type.name.empty()) continue;
    const auto [entry, is_new] = first.try_emplace(stream.type.name, &stream);
    const StreamInfo*& other = entry->second;
    // Lists leave out the fields of many types.
    if (other->type.fields.empty()) other = &stream;
    const Result<void> same = other->type.check_usable_as(stream.type);
    if (same) continue;
    if (example.empty()) example = stream.id.str();
    conflicts.push_back(fmt::format("'{}' of '{}' and of '{}'", stream.type.name, other->id.str(),
                                    stream.id.str()));
  }
  if (conflicts.empty()) {
    return {"types", Status::ok, "each type has one description on all hosts"};
  }
  return {"types", Status::warn, "different types have one name: " + first_of(std::move(conflicts)),
          "their programs were compiled with different versions of a definition, and cannot read "
          "each other's streams",
          fmt::format("dssmctl info {}  # compare the fields; compile both programs again",
                      shell_word(example))};
}

}  // namespace

void check_streams(const Facts& facts, std::vector<Finding>& findings) {
  findings.push_back(check_stream_names(facts));
  findings.push_back(check_stalled(facts));
  findings.push_back(check_mirrors(facts));
  findings.push_back(check_times(facts));
  findings.push_back(check_histories(facts));
  findings.push_back(check_types(facts));
}

}  // namespace dssm::ctl
