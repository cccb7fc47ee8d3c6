// SPDX-License-Identifier: Apache-2.0
//
// SIGHUP: reads the configuration again. If it has a mistake, all mistakes are logged and nothing
// changes. Otherwise the keys that may change while dssmd runs take effect at once, and those that
// need a restart are logged.
#pragma once

#include <dssm/result.hpp>
#include <functional>

#include "daemon/base/log.hpp"
#include "daemon/service/config.hpp"

namespace dssm::daemon {

class Reloader {
 public:
  using Read = std::function<Result<Config>()>;
  using Apply = std::function<void(const Config&)>;

  // config: what dssmd runs with. apply: takes over the keys that may change at once. logger:
  // outlives it.
  Reloader(const Config& config, Read read, Apply apply, Logger& logger)
      : started_with_(config),
        applied_(config),
        read_(std::move(read)),
        apply_(std::move(apply)),
        logger_(logger) {}

  void reload();

 private:
  const Config started_with_;
  Config applied_;
  Read read_;
  Apply apply_;
  Logger& logger_;
};

}  // namespace dssm::daemon
