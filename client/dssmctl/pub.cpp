// SPDX-License-Identifier: Apache-2.0
//
// dssmctl pub: writes samples whose fields come from the command line or from standard input.
#include <fmt/format.h>

#include <iostream>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/sample_input.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Writes samples, not faster than it is to.
class Publisher {
 public:
  Publisher(const PubOptions& options, RawWriter writer, Output& out)
      : options_(options), writer_(std::move(writer)), out_(out) {}

  const TypeInfo& type() const { return writer_.type(); }

  bool is_done() const {
    return (options_.count && written_ == *options_.count) || out_.must_stop();
  }

  // Waits until it is due. False: it must stop.
  bool await_turn() {
    if (!options_.period || written_ == 0) {
      due_ = MonoClock::now();
      return !out_.must_stop();
    }
    due_ += *options_.period;
    return out_.sleep_until(due_);
  }

  Result<void> write(const SampleInput& sample) {
    if (options_.times && !sample.time) {
      return Error{Errc::invalid_argument,
                   "--times: the input has no time_ns; `dssmctl echo --json` prints it"};
    }
    const Tid tid = options_.times ? writer_.write(sample.payload(), *sample.time,
                                                   sample.clock_error.value_or(kOwnClockError))
                                   : writer_.write(sample.payload());
    if (tid == kNoTid) {
      return Error{Errc::unavailable,
                   "another writer has held the stream's lock for 2 s; is a "
                   "program stopped that writes it? `dssmctl info` names them"};
    }
    newest_ = tid;
    ++written_;
    return {};
  }

  // `failed`: what ended it; what was written before stays.
  Result<void> report(Result<void> failed) const {
    if (!failed) {
      Error error = std::move(failed).error();
      if (written_ > 0) error.message += fmt::format("; written before: {}", written_);
      return error;
    }
    if (options_.json) {
      out_.add(json_document({{"stream", writer_.id().str()},
                              {"samples", written_},
                              {"newest_tid", written_ > 0 ? Json(newest_) : Json()}}));
    } else {
      out_.add(fmt::format("{}: {} {} written{}\n", escaped(writer_.id().str()), written_,
                           written_ == 1 ? "sample" : "samples",
                           written_ > 0 ? fmt::format(", up to tid {}", newest_) : ""));
    }
    return {};
  }

 private:
  const PubOptions& options_;
  RawWriter writer_;
  Output& out_;
  std::uint64_t written_ = 0;
  Tid newest_ = kNoTid;
  MonoTime due_{};
};

Result<void> publish_assignments(const PubOptions& options, Publisher& publisher) {
  SampleInput sample(publisher.type());
  for (const std::string& assignment : options.assignments) {
    const std::size_t equals = assignment.find('=');
    DSSM_TRY(sample.set_text(assignment.substr(0, equals), assignment.substr(equals + 1)));
  }
  while (!publisher.is_done() && publisher.await_turn()) DSSM_TRY(publisher.write(sample));
  return {};
}

Result<void> publish_lines(Publisher& publisher) {
  SampleLines lines(publisher.type(), std::cin);
  while (!publisher.is_done()) {
    const std::optional<SampleInput> sample = DSSM_TRY(lines.next());
    if (!sample || !publisher.await_turn()) break;
    DSSM_TRY(publisher.write(*sample));
  }
  return {};
}

}  // namespace

Result<void> run(const PubOptions& options, Output& out) {
  const StreamId id = DSSM_TRY(StreamId::parse(options.stream));
  Session session = DSSM_TRY(connect(options));
  Result<RawWriter> writer = session.open_raw_writer(id);
  if (!writer) return with_similar_names(std::move(writer).error(), session, id);
  Publisher publisher(options, *std::move(writer), out);
  // A read of standard input ends by Ctrl-C only if that ends the program.
  if (!options.from_stdin) catch_stop_signals();
  return publisher.report(options.from_stdin ? publish_lines(publisher)
                                             : publish_assignments(options, publisher));
}

}  // namespace dssm::ctl
