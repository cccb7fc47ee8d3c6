// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/history_pace.hpp"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

namespace dssm::daemon {
namespace {

double seconds(Duration duration) { return std::chrono::duration<double>(duration).count(); }

}  // namespace

std::size_t HistoryPace::allowance(MonoTime now, const Connection& connection) {
  if (state_ == State::paced) refill(now);
  if (!is_valid(now)) {
    measure(now, connection);
  } else if (state_ == State::measuring) {
    go_on_measuring(now, connection);
  }
  if (state_ != State::paced) return kUnlimited;
  const double missing = piece_bytes() - tokens_;
  if (missing <= 0) return static_cast<std::size_t>(tokens_);
  const double wait_s = std::min(missing / (kShare * bytes_per_s_), seconds(kPeriod));
  due_ = now + Duration(std::llround(std::ceil(wait_s * 1e9)));
  return 0;
}

void HistoryPace::on_history(std::size_t bytes) noexcept {
  history_bytes_ += bytes;
  tokens_ -= static_cast<double>(bytes);
}

void HistoryPace::on_history_dropped(std::size_t bytes) noexcept {
  history_bytes_ -= bytes;
  tokens_ += static_cast<double>(bytes);
}

void HistoryPace::on_full(const void* connection) noexcept {
  is_full_ = true;
  if (connection == window_.connection) window_.is_full = true;
}

void HistoryPace::forget(const void* connection) noexcept {
  if (state_ == State::measuring && window_.connection == connection) state_ = State::unknown;
}

// A connection that is full for a moment waits for a PC that is busy.
bool HistoryPace::is_valid(MonoTime now) noexcept {
  if (state_ == State::unknown || state_ == State::measuring) return state_ != State::unknown;
  if (now >= valid_until_) return false;
  if (now - period_begin_ < kPeriod) return true;
  const bool is_too_full = seconds(full_for_) > kTooFull * seconds(now - period_begin_);
  period_begin_ = now;
  full_for_ = {};
  return !is_too_full;
}

// --- measuring

void HistoryPace::measure(MonoTime now, const Connection& connection) {
  const std::optional<wire::Progress> progress = connection.transport.progress();
  begun_ = now;
  windows_ = flat_windows_ = void_windows_ = 0;
  last_bytes_per_s_ = 0;
  if (!progress) return set_rate(now, kFastBytesPerS, 0);
  state_ = State::measuring;
  begin_window(now, connection, *progress);
}

void HistoryPace::begin_window(MonoTime now, const Connection& connection,
                               const wire::Progress& progress) {
  const Duration length = std::clamp(progress.round_trip, kWindow, kMaxWindow);
  window_ = {connection.id,
             now,
             now + (is_last_window() ? kLastWindows : 1) * length,
             now,
             {},
             false,
             sent_bytes_,
             connection.sent_bytes,
             progress};
}

void HistoryPace::go_on_measuring(MonoTime now, const Connection& connection) {
  // It has no more history, or the network is interrupted.
  if (now - window_.heard > kMaxWindow) return measure(now, connection);
  if (window_.connection != connection.id) return;
  if (std::exchange(window_.is_full, false)) window_.full_for += now - window_.heard;
  window_.heard = now;
  if (now >= window_.end) end_window(now, connection);
}

void HistoryPace::end_window(MonoTime now, const Connection& connection) {
  const std::optional<wire::Progress> progress = connection.transport.progress();
  if (!progress) return set_rate(now, kFastBytesPerS, 0);
  const wire::Progress& before = window_.progress;
  const std::uint64_t by_others_bytes =
      sent_bytes_ - window_.sent_bytes - (connection.sent_bytes - window_.sent_by_it_bytes);
  const std::uint32_t packets = progress->delivered_packets - before.delivered_packets;
  const std::uint64_t bytes = std::uint64_t{packets} * progress->packet_bytes + by_others_bytes;
  const Duration length = now - window_.begin;
  const std::uint64_t enough = (is_last_window() ? kLastWindows : 1) * kWindowBytes;
  if (bytes < enough && length < kMaxWindow) return;
  // Otherwise this PC is what limits, or there is too little history.
  const Duration carrying = progress->sending - before.sending + kKernelTick;
  if (2 * std::min(window_.full_for, carrying) < length) {
    if (++void_windows_ < kMaxVoidWindows) return begin_window(now, connection, *progress);
    return set_rate(now, kFastBytesPerS, 0);
  }
  ++windows_;
  const double bytes_per_s = static_cast<double>(bytes) / seconds(length);
  // Where packets wait in the network, that is what limits, although the receiver may be slow, too.
  const bool is_receivers = 2 * (progress->waiting_for_peer - before.waiting_for_peer) >
                                progress->sending - before.sending &&
                            progress->round_trip_now < progress->round_trip + kQueued;
  if (is_last_window()) {
    return set_rate(now, is_receivers ? kFastBytesPerS : bytes_per_s, progress->waiting_bytes);
  }
  flat_windows_ = bytes_per_s < kGrows * last_bytes_per_s_ ? flat_windows_ + 1 : 0;
  last_bytes_per_s_ = bytes_per_s;
  begin_window(now, connection, *progress);
}

void HistoryPace::set_rate(MonoTime now, double bytes_per_s, std::uint64_t waiting_bytes) noexcept {
  state_ = bytes_per_s < kFastBytesPerS ? State::paced : State::unlimited;
  valid_until_ = now + std::clamp(kValidTimes * (now - begun_), kMinValid, kMaxValid);
  refilled_ = period_begin_ = now;
  is_full_ = false;
  full_for_ = {};
  bytes_per_s_ = std::max(bytes_per_s, 1.0);
  live_bytes_ = std::max(live_bytes_, live_bytes());
  // What was sent while measuring still waits, partly in the network.
  tokens_ = -static_cast<double>(waiting_bytes);
}

// --- paced

double HistoryPace::piece_bytes() const noexcept {
  return std::max(bytes_per_s_ * seconds(kPiece), static_cast<double>(kMinPieceBytes));
}

// History that waits to be sent counts already.
std::uint64_t HistoryPace::live_bytes() const noexcept {
  return sent_bytes_ - std::min(history_bytes_, sent_bytes_);
}

void HistoryPace::refill(MonoTime now) noexcept {
  const std::uint64_t live = std::max(live_bytes_, live_bytes());
  const double carried = bytes_per_s_ * seconds(now - refilled_);
  const auto by_live = static_cast<double>(live - live_bytes_);
  tokens_ += std::max(kShare * carried - by_live, kLeastShare * carried);
  tokens_ = std::min(tokens_, 3 * piece_bytes());
  if (std::exchange(is_full_, false)) full_for_ += now - refilled_;
  live_bytes_ = live;
  refilled_ = now;
}

// --- one connection's share

std::size_t HistoryShare::allowance(MonoTime now, double carried_bytes_per_s) noexcept {
  due_ = now;
  if (share_ == 1 || carried_bytes_per_s == 0) {
    tokens_ = 0;  // what was sent without a limit does not count
    refilled_ = now;
    return HistoryPace::kUnlimited;
  }
  constexpr auto kPieceBytes = static_cast<double>(HistoryPace::kMinPieceBytes);
  const double bytes_per_s = share_ * carried_bytes_per_s;
  tokens_ = std::min(tokens_ + bytes_per_s * seconds(now - refilled_),
                     std::max(3 * bytes_per_s * seconds(HistoryPace::kPiece), 2 * kPieceBytes));
  refilled_ = now;
  if (tokens_ >= kPieceBytes) return static_cast<std::size_t>(tokens_);
  const double wait_s =
      std::min((kPieceBytes - tokens_) / bytes_per_s, seconds(HistoryPace::kPeriod));
  due_ = now + std::chrono::ceil<Duration>(std::chrono::duration<double>(wait_s));
  return 0;
}

}  // namespace dssm::daemon
