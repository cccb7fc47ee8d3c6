// SPDX-License-Identifier: Apache-2.0
//
// What the tests of whole vehicles share.
#pragma once

#include <gtest/gtest.h>

#include <string>
#include <thread>

#include "tests/support/mdns_vehicle.hpp"

namespace dssm::test {

class Vehicle : public testing::Test, protected MdnsVehicle {
 protected:
  // PCs with a dssmd each.
  //   returns  false: the test is to be skipped, because of why_
  bool make(int pcs) {
    if (Result<void> opened = open(pcs); !opened) return why_ = opened.error().message, false;
    for (int pc = 1; pc <= pcs; ++pc) add_dssmd();
    return true;
  }

  // Looks again and again until `done`, for a minute; how long it took.
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
    return MonoClock::now() - begin;
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
