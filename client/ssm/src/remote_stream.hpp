// SPDX-License-Identifier: Apache-2.0
//
// Implements a PConnector of the old interface: a dssm::PConnector, and a SampleCollector after the
// program asked for a ring.
//
// A call that fails prints the reason on stderr, once until a call succeeds again. While the other
// PC or the network is unavailable, each call tries for about two seconds and then fails; the waits
// (connect, open) last until a signal handler runs, or $DSSM_CONNECT_TIMEOUT seconds have passed.
//
//   tids     as in stream.hpp: they keep rising when the stream restarts
//   threads  calls take turns
//   signals  close() at any moment; other calls in a handler that interrupted a call of a remote
//            stream fail, except for reading collected samples
#pragma once

#include <atomic>
#include <dssm/sample_collector.hpp>
#include <optional>
#include <string>
#include <vector>

#include "../include/libssm.h"
#include "signal_safe.hpp"

namespace dssm::ssm {

class RemoteStream {
 public:
  RemoteStream() = default;
  RemoteStream(const RemoteStream&) = delete;
  RemoteStream& operator=(const RemoteStream&) = delete;

  bool connect(const std::string& address);
  bool create(const std::string& address, const StreamId& id, const TypeInfo& type,
              const History& history);
  bool open(const std::string& address, const StreamId& id, std::size_t wanted_bytes);
  bool is_open() const noexcept { return open_.load(); }
  void close() noexcept { open_.store(false); }  // async-signal-safe: frees nothing yet

  enum class Which { newest, tid, newer, next, at };
  struct Request {
    Which which;
    SSM_tid tid;  // tid, newer, next
    int dt;       // next
    double time;  // at
  };
  // The tid that was read, or an SSM_ERROR_...
  SSM_tid read(const Request& request, void* data, std::size_t bytes, double* time);
  SSM_tid read_buffered(const Request& request, void* data, std::size_t bytes, double* time);

  SSM_tid top();
  SSM_tid top_buffered();
  SSM_tid bottom();
  SSM_tid tid_at(double time);
  bool is_newer(SSM_tid tid);

  bool write(const void* data, std::size_t bytes, double time);

  bool set_property(const void* data, std::size_t bytes);
  bool get_property(void* data, std::size_t bytes);

  // Zeroes: what the stream itself has.
  bool buffer(double life, double cycle);

 private:
  class Call;
  class Network;

  PConnectorOptions options(const std::string& address, std::uint64_t payload_bytes) const;
  bool take(Result<PConnector> opened, const std::string& what);
  std::string quoted_name() const;
  std::size_t data_bytes() const noexcept;  // per sample, as the program sees it
  void report_once(const Error& error);
  void follow_restart();

  // In tids as programs get them, of 64 bits.
  template <class Ask>
  ReadStatus fetch(Ask ask, SampleInfo& info);
  template <class Source, class ReportSkip>
  ReadStatus read_from(const Source& source, const Request& request, SampleInfo& info,
                       ReportSkip report_skip);
  Tid ask_newest();
  Tid ask_oldest();
  bool has_size(const char* verb, std::size_t bytes);
  SSM_tid hand_over(ReadStatus status, const Request& request, const SampleInfo& info, void* data,
                    double* time);

  ReentrantLock lock_;
  bool inside_ = false;
  std::atomic<bool> open_{false};
  std::optional<PConnector> connector_;
  std::string address_;
  std::vector<std::byte> sample_;  // read into, before it is the program's; at least 1 byte
  Tid offset_ = 0, seen_ = kNoTid;
  std::uint64_t restarts_ = 0;  // of connector_, that offset_ includes
  std::string reported_;        // the last error, until a call succeeds
  std::optional<SampleCollector> collector_;
};

}  // namespace dssm::ssm
