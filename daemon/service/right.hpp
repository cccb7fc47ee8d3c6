// SPDX-License-Identifier: Apache-2.0
//
// One line of the configuration key `rights`, "WHO VERBS STREAMS": who may do what with which
// streams. daemon/streams/rights.hpp decides by all of them.
#pragma once

#include <bit>
#include <cstdint>
#include <dssm/result.hpp>
#include <string>
#include <string_view>

namespace dssm::daemon {

enum class Verb : std::uint8_t { read, write, create, remove, property, clock };

// A set of them.
class Verbs {
 public:
  static constexpr Verbs all() noexcept { return Verbs(0x3f); }

  constexpr Verbs() = default;
  // NOLINTNEXTLINE(google-explicit-constructor): each verb is a set of one
  constexpr Verbs(Verb verb) noexcept : bits_(1U << static_cast<unsigned>(verb)) {}
  constexpr bool has(Verb verb) const noexcept { return (bits_ & Verbs(verb).bits_) != 0; }
  constexpr bool has_any(Verbs of) const noexcept { return (bits_ & of.bits_) != 0; }
  constexpr bool empty() const noexcept { return bits_ == 0; }
  constexpr Verb first() const noexcept { return static_cast<Verb>(std::countr_zero(bits_)); }
  constexpr Verbs& operator|=(Verbs other) noexcept {
    bits_ |= other.bits_;
    return *this;
  }
  std::string str() const;  // "read,write"; "all"; "none"

  friend bool operator==(Verbs a, Verbs b) = default;

 private:
  constexpr explicit Verbs(unsigned bits) noexcept : bits_(bits) {}
  unsigned bits_ = 0;
};

struct Right {
  enum class Who : std::uint8_t {
    everyone,
    local,    // all programs of this PC that use its Unix socket
    user,     // those of the user `number`
    group,    // those of a user in the group `number`
    host,     // dssmd of other hosts, by their certificates' names
    program,  // programs on other PCs, by their certificates' names
  };

  Who who = Who::everyone;
  std::uint32_t number = 0;
  std::string name_pattern;  // of hosts and programs, as in fnmatch(3)
  Verbs verbs;
  std::string streams;  // pattern, as in names_stream()
  std::string line;     // as it was written

  friend bool operator==(const Right& a, const Right& b) = default;
};

// "group:drivers read,write lidar*", "host:pc2 read camera:0", "local all *". `create` comes with
// `write`.
//   fails  invalid_argument, with the reason: also when a user or group does not exist
Result<Right> parse_right(std::string_view text);

}  // namespace dssm::daemon
