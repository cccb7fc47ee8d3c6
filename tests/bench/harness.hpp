// SPDX-License-Identifier: Apache-2.0
//
// Shared by the benchmarks: timing in batches, percentiles, and the line that shows our figure with
// the machine's raw limit.
//
// Our operation and the raw limit alternate, batch by batch, so that other load or a change of the
// clock rate affects both. A figure is the time of one operation: for operations that take
// nanoseconds, a batch's time divided by their number; for longer ones, the time of each.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <dssm/time.hpp>
#include <string>
#include <vector>

namespace dssm::bench {

struct Figures {
  double min = 0, median = 0, p99 = 0, p999 = 0;  // ns
};

inline Figures figures_of(std::vector<double> ns) {
  std::sort(ns.begin(), ns.end());
  const auto at = [&](double share) {
    return ns[std::min(ns.size() - 1,
                       static_cast<std::size_t>(share * static_cast<double>(ns.size())))];
  };
  return {ns.front(), at(0.5), at(0.99), at(0.999)};
}

inline std::int64_t now_ns() { return to_ns(MonoClock::now().time_since_epoch()); }

// The p99 of each of ten parts of a measurement. An external disturbance slows some 50 successive
// operations, which is the whole p99 of the affected side; here it affects only one tenth.
inline std::vector<double> p99_of_parts(const double* begin, const double* end) {
  constexpr std::ptrdiff_t kParts = 10;
  const std::ptrdiff_t count = end - begin;
  std::vector<double> p99s;
  for (std::ptrdiff_t part = 0; part < kParts; ++part) {
    p99s.push_back(
        figures_of({begin + part * count / kParts, begin + (part + 1) * count / kParts}).p99);
  }
  return p99s;
}

// Keeps the compiler from removing the computation of `value`.
template <class T>
inline void keep(const T& value) {
  asm volatile("" : : "r"(&value) : "memory");
}

// Runs `operation` `count` times; returns the time of one, in ns.
template <class Operation>
double time_batch(int count, Operation& operation) {
  const std::int64_t start = now_ns();
  for (int i = 0; i < count; ++i) operation();
  return static_cast<double>(now_ns() - start) / count;
}

struct Pair {
  Figures raw, ours;
};

// Alternates both operations, `batches` times.
template <class Raw, class Ours>
Pair measure(int batches, int count, Raw raw, Ours ours) {
  std::vector<double> raw_ns, ours_ns;
  time_batch(count, raw), time_batch(count, ours);  // warm up
  for (int i = 0; i < batches; ++i) {
    raw_ns.push_back(time_batch(count, raw));
    ours_ns.push_back(time_batch(count, ours));
  }
  return {figures_of(std::move(raw_ns)), figures_of(std::move(ours_ns))};
}

inline void print_head() {
  std::printf("%-44s %9s %9s %9s %9s  %7s  %s\n", "ns per operation", "min", "median", "p99",
              "p99.9", "ratio", "target");
}

inline void print_row(const std::string& name, const Figures& f, const std::string& rest = "") {
  std::printf("%-44s %9.1f %9.1f %9.1f %9.1f  %s\n", name.c_str(), f.min, f.median, f.p99, f.p999,
              rest.c_str());
  std::fflush(stdout);
}

// Prints two rows: the raw limit, and ours with the ratio of medians and the target.
inline void print_pair(const std::string& raw_name, const std::string& our_name, const Pair& pair,
                       const std::string& target) {
  print_row("  " + raw_name, pair.raw);
  char rest[80];
  std::snprintf(rest, sizeof rest, "%7.2f  %s", pair.ours.median / pair.raw.median, target.c_str());
  print_row(our_name, pair.ours, rest);
}

}  // namespace dssm::bench
