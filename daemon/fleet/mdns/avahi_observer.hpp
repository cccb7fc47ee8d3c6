// SPDX-License-Identifier: Apache-2.0
//
// What the parts that use an AvahiClient report to the one that owns it.
#pragma once

#include <string>

#include "daemon/base/log.hpp"

namespace dssm::daemon {

class AvahiObserver {
 public:
  // Something that is asked for has changed.
  virtual void on_avahi_change() = 0;
  // The client is of no use any more; it is freed after this, not inside.
  virtual void on_avahi_failure(int error) = 0;
  virtual void log(LogLevel level, std::string text) = 0;
  // Whether to end quickly, without more calls to Avahi.
  virtual bool stopping() const noexcept = 0;

 protected:
  ~AvahiObserver() = default;
};

// Whether that error of a call concerns the connection to Avahi and not what was asked.
bool is_avahi_connection_error(int error) noexcept;

}  // namespace dssm::daemon
