// SPDX-License-Identifier: Apache-2.0
//
// dssmctl echo: samples for people and programs. Without --at or --last it shows what comes from
// now on; a stream that had to be awaited is shown from its first sample.
#include <limits>

#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/follower.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/sample_printer.hpp"
#include "client/dssmctl/stop_signal.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

SampleForm form_of(const Options& options) {
  if (options.json) return SampleForm::json;
  return options.csv ? SampleForm::csv : SampleForm::text;
}

// Prints the samples after the reader's cursor, in order.
class Echo {
 public:
  Echo(RawReader& reader, SamplePrinter& printer, Output& out, std::uint64_t count)
      : reader_(reader),
        printer_(printer),
        out_(out),
        left_(count),
        payload_(reader.payload_bytes()) {}

  // Reads one sample with `read`, as the members of RawReader do, and prints it.
  template <class Read>
  ReadStatus print(Read read) {
    SampleInfo info;
    const ReadStatus status = read(std::span<std::byte>(payload_), info);
    if (status == ReadStatus::ok) {
      printer_.sample(info, payload_, reader_.lost() - lost_);
      lost_ = reader_.lost();
      --left_;
    }
    return status;
  }

  // Prints what is there up to sample `last`. Whether to go on.
  bool print_until(Tid last) {
    while (left_ > 0 && reader_.cursor() < last && !stop_requested()) {
      const ReadStatus status =
          print([&](auto payload, auto& info) { return reader_.next(payload, info); });
      if (status == ReadStatus::lapped) continue;
      if (status != ReadStatus::ok) break;
      if (!out_.flush_some()) return false;
    }
    return out_.flush() && left_ > 0 && !stop_requested();
  }

 private:
  RawReader& reader_;
  SamplePrinter& printer_;
  Output& out_;
  std::uint64_t left_;
  std::uint64_t lost_ = 0;
  std::vector<std::byte> payload_;
};

Error failed_read(const RawReader& reader, const std::string& what, ReadStatus status) {
  const std::string tried = "read " + what + " of '" + reader.id().str() + "': ";
  SampleInfo oldest;
  switch (status) {
    case ReadStatus::too_old:
      if (reader.stamp(reader.oldest(), oldest) == ReadStatus::ok) {
        return {Errc::not_found, tried + "too old, the ring holds samples from " +
                                     seconds_text(to_ns(oldest.time)) + " on"};
      }
      return {Errc::not_found, tried + "too old, the ring holds it no longer"};
    case ReadStatus::lapped:
      return {Errc::system, tried +
                                "the writer overwrites samples faster than they can be read; "
                                "give the stream more depth"};
    default:
      return {Errc::not_found, tried + "nothing was written to it yet"};
  }
}

// The moment that --at means. It counts back from the newest sample, not from now, because the
// stamps of a recording have nothing to do with the time on the wall.
Result<Time> moment(const RawReader& reader, const Options& options) {
  if (!options.at_counts_back) return Time(*options.at);
  SampleInfo newest;
  ReadStatus status = ReadStatus::not_yet;
  do {  // the newest one may be overtaken between the two calls
    status = reader.stamp(reader.newest(), newest);
  } while (status == ReadStatus::too_old && reader.newest() != kNoTid);
  if (status != ReadStatus::ok)
    return failed_read(reader, "the newest sample", ReadStatus::not_yet);
  return saturating_add(newest.time, *options.at);
}

// Prints the sample that --at or --last asks for; without them puts the cursor before the first
// sample to show.
Result<void> begin(const Options& options, bool awaited, RawReader& reader, Echo& echo) {
  if (options.at) {
    const Result<Time> time = moment(reader, options);
    if (!time) return time.error();
    const ReadStatus status =
        echo.print([&](auto payload, auto& info) { return reader.at(*time, payload, info); });
    if (status != ReadStatus::ok) {
      return failed_read(reader, "the sample at " + seconds_text(to_ns(*time)), status);
    }
  } else if (options.last) {
    const ReadStatus status =
        echo.print([&](auto payload, auto& info) { return reader.latest(payload, info); });
    if (status != ReadStatus::ok) return failed_read(reader, "the newest sample", status);
  } else {
    reader.seek(awaited ? kNoTid : reader.newest());
  }
  return {};
}

}  // namespace

Result<void> run_echo(const Options& options, Output& out) {
  catch_stop_signals();
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  Result<std::optional<OpenedStream>> opened = open_stream(*session, options);
  if (!opened) return std::move(opened).error();
  if (!*opened) return {};
  RawReader& reader = (*opened)->reader;
  Result<std::vector<Field>> fields =
      select_fields(readable_fields_untrusted(reader.type()), options.fields);
  if (!fields) return std::move(fields).error().context("show '" + reader.id().str() + "'");

  const bool once = options.at || options.last;
  const std::uint64_t count =
      options.count.value_or(once ? 1 : std::numeric_limits<std::uint64_t>::max());
  SamplePrinter printer(out, form_of(options), options.full, reader.id(), std::move(*fields));
  Echo echo(reader, printer, out, count);
  printer.begin();
  if (Result<void> begun = begin(options, (*opened)->awaited, reader, echo); !begun) return begun;
  if (!echo.print_until(reader.newest())) return {};

  Result<Follower> follower = Follower::open(*session, reader, out);
  if (!follower) return std::move(follower).error();
  while (true) {
    const Follower::Wake wake = follower->wait(kNever);
    if (wake == Follower::Wake::stop) return {};
    const bool go_on = echo.print_until(reader.newest());
    if (!go_on) return {};
    if (wake == Follower::Wake::removed) return removed_error(reader);
  }
}

}  // namespace dssm::ctl
