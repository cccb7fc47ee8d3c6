// SPDX-License-Identifier: Apache-2.0
//
// What the tests of whole vehicles share.
#pragma once

#include <gtest/gtest.h>

#include <cstdio>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/mdns_vehicle.hpp"

namespace dssm::test {

// The promise is 3 s; the rest is for a machine that is busy with other tests.
inline constexpr Duration kSoon = std::chrono::seconds(6);

class Vehicle : public testing::Test, protected MdnsVehicle {
 protected:
  // PCs with a dssmd each.
  //   returns  false: the test is to be skipped, because of why_
  bool make(int pcs, const std::vector<std::string>& flags = {}) {
    if (!possible(open(pcs))) return false;
    for (int pc = 1; pc <= pcs; ++pc) add_dssmd(flags);
    return true;
  }
  bool possible(const Result<void>& done) {
    if (!done) why_ = done.error().message;
    return done.has_value();
  }

  // Looks again and again until `done`, for a minute; how long it took, which is printed too.
  template <class Done>
  Duration await(const std::string& what, Done done) {
    const MonoTime begin = MonoClock::now();
    while (!done()) {
      if (MonoClock::now() - begin > std::chrono::minutes(1)) {
        ADD_FAILURE() << "did not happen in a minute: " << what;
        break;
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    const Duration took = MonoClock::now() - begin;
    std::printf(
        "%6lld ms until %s\n",
        static_cast<long long>(std::chrono::duration_cast<std::chrono::milliseconds>(took).count()),
        what.c_str());
    return took;
  }

  void await_all_up() {
    for (int here = 1; here <= dssmds(); ++here) {
      for (int there = 1; there <= dssmds(); ++there) {
        if (here == there) continue;
        const std::string name = Network::name(there);
        await(name + " is found", [&] { return is_up(session(here), name); });
      }
    }
  }

  std::string why_;
};

}  // namespace dssm::test
