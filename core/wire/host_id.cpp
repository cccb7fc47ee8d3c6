// SPDX-License-Identifier: Apache-2.0
#include "core/wire/host_id.hpp"

#include <fcntl.h>
#include <sys/random.h>
#include <unistd.h>

#include <algorithm>
#include <string>

#include "core/base/sha256.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::wire {
namespace {

// Makes the result differ from what other software hashes of the same machine id. Random, made
// once; changing it changes the identity of every host.
constexpr std::string_view kApplicationId = "677a14dda84aa85900164edec47f0e46";
constexpr std::size_t kMachineIdBytes = 32;  // hexadecimal digits, machine-id(5)

// 32 hexadecimal digits, or empty when this machine has no id (yet).
std::string machine_id() {
  const UniqueFd file(::open("/etc/machine-id", O_RDONLY | O_CLOEXEC));
  std::string id(kMachineIdBytes, '\0');
  if (!file || ::read(file.get(), id.data(), id.size()) != static_cast<ssize_t>(id.size())) {
    return {};
  }
  const bool is_id = id.find_first_not_of("0123456789abcdef") == id.npos;
  return is_id ? id : std::string();
}

// In place of a machine id, for as long as this process lives.
std::string random_id() {
  std::array<char, kMachineIdBytes> bytes{};
  // So few bytes never come in part; early in the boot it waits for entropy.
  while (::getrandom(bytes.data(), bytes.size(), 0) != static_cast<ssize_t>(bytes.size())) {
  }
  return {bytes.begin(), bytes.end()};
}

}  // namespace

HostId host_id_for(std::string_view name) {
  static const std::string machine = [] {
    std::string id = machine_id();
    return id.empty() ? random_id() : id;
  }();
  // The first two parts have a fixed length, so no two names give the same bytes. The machine id
  // has 128 random bits: it cannot be found from the digest by trying.
  const Sha256 digest = sha256(std::string(kApplicationId) + machine + std::string(name));
  HostId id{};
  std::copy_n(digest.begin(), id.size(), id.begin());
  return id;
}

bool has_lasting_host_id() { return !machine_id().empty(); }

}  // namespace dssm::wire
