// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/status_line.hpp"

#include <utility>

namespace dssm::daemon {

StatusLine::StatusLine(const EventLoop& loop, ServiceManager& manager,
                       std::function<std::string()> text)
    : manager_(manager),
      text_(std::move(text)),
      timer_(EventSource::timer(loop, [this] { update(); })) {}

std::string StatusLine::now() { return sent_ = text_(); }

void StatusLine::touch() {
  if (manager_.is_there() && !std::exchange(due_, true)) timer_.enable_in(kPause);
}

void StatusLine::update() {
  due_ = false;
  std::string text = text_();
  if (text == sent_) return;
  sent_ = std::move(text);
  manager_.status(sent_);
}

}  // namespace dssm::daemon
