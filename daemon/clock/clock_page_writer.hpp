// SPDX-License-Identifier: Apache-2.0
//
// dssmd's end of the shared clock page (core/clock/clock_page.hpp): the file RUNTIME_DIR/clock. It
// survives dssmd, so that the next one detects a step of the clock while none ran.
#pragma once

#include <dssm/result.hpp>
#include <string>

#include "core/base/unique_fd.hpp"
#include "core/clock/clock_page.hpp"

namespace dssm::clock {

class ClockPageWriter {
 public:
  // Opens the page file `path`, or creates a new one where there is none, or one of another boot or
  // layout. Programs that have the old one mapped keep it.
  //   fails  os errors
  static Result<ClockPageWriter> open(const std::string& path);
  ClockPageWriter(ClockPageWriter&& other) noexcept;
  ClockPageWriter& operator=(ClockPageWriter&&) = delete;
  ~ClockPageWriter();

  // Whether another dssmd of this boot wrote it before.
  bool has_history() const noexcept { return has_history_; }
  const ClockPage& page() const noexcept { return *page_; }

  void store(const ClockPageState& state) noexcept { page_->state.store(state); }

  // A descriptor for a program: read-only.
  Result<UniqueFd> for_reading() const;

 private:
  ClockPageWriter(std::string path, ClockPage* page, bool has_history) noexcept
      : path_(std::move(path)), page_(page), has_history_(has_history) {}

  std::string path_;
  ClockPage* page_;
  bool has_history_;
};

}  // namespace dssm::clock
