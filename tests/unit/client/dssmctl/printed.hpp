// SPDX-License-Identifier: Apache-2.0
//
// What something prints, caught through a pipe.
#pragma once

#include <unistd.h>

#include <string>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// Runs `print(Output&)` and returns what came out; at most a pipe's 64 KiB.
template <class Print>
std::string printed(Print print) {
  int ends[2];
  if (::pipe(ends)) return "no pipe";
  {
    Output out(ends[1]);
    print(out);
    out.flush();
  }
  ::close(ends[1]);
  std::string text(64U << 10, '\0');
  const ssize_t got = ::read(ends[0], text.data(), text.size());
  ::close(ends[0]);
  text.resize(got > 0 ? static_cast<std::size_t>(got) : 0);
  return text;
}

}  // namespace dssm::ctl
