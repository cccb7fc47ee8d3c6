// SPDX-License-Identifier: Apache-2.0
//
// dssmctl echo: samples for people and programs. Without --at or --last it shows what comes from
// now on; a stream that had to be awaited is shown from its first sample.
#include <fmt/format.h>

#include <limits>
#include <optional>

#include "client/dssmctl/describe_stream.hpp"
#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/sample_printer.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

SampleForm form_of(const EchoOptions& options) {
  if (options.json) return SampleForm::json;
  return options.csv ? SampleForm::csv : SampleForm::text;
}

// The fields to show of the reader's stream, whose type is `own`: those, else those of `obvious`,
// the type that its programs have.
Result<std::vector<Field>> wanted_fields(const RawReader& reader, const TypeInfo& own,
                                         const TypeInfo& obvious, const EchoOptions& options) {
  return DSSM_TRY(
      select_fields(readable_fields_untrusted(type_to_show(own, obvious)), options.fields),
      fmt::format("show '{}'", reader.id().str()));
}

// Prints the samples after the reader's cursor, in order.
class Echo {
 public:
  // obvious: as for wanted_fields()
  Echo(RawReader& reader, Follower& follower, TypeInfo obvious, SamplePrinter& printer, Output& out,
       const EchoOptions& options)
      : reader_(reader),
        follower_(follower),
        obvious_(std::move(obvious)),
        printer_(printer),
        out_(out),
        options_(options),
        left_(options.count.value_or(
            options.at || options.last ? 1 : std::numeric_limits<std::uint64_t>::max())),
        payload_(reader.payload_bytes()) {}

  // Reads one sample with `read`, as the members of RawReader do, and prints it; after a
  // restart of the stream it continues with the new ring. `restarted` only with a failed result().
  template <class Read>
  ReadStatus print(Read read) {
    SampleInfo info;
    ReadStatus status = ReadStatus::restarted;
    while (status == ReadStatus::restarted && result_) {
      status = read(std::span<std::byte>(payload_), info);
      if (status == ReadStatus::restarted) reopen();
    }
    if (status == ReadStatus::ok) {
      printer_.sample(info, std::span(payload_).first(info.payload_bytes),
                      {reader_.lost_samples() - lost_, reader_.restarts()});
      lost_ = reader_.lost_samples();
      --left_;
    }
    return status;
  }

  // Prints what is there at this moment. Returns whether to continue.
  bool print_new() {
    take_description();
    const Tid last = reader_.newest_tid();
    const std::uint64_t restarts = reader_.restarts();
    bool more = true;  // at least one read: only a read reports a restart
    while (more && continues()) {
      const ReadStatus status =
          print([&](auto payload, auto& info) { return reader_.read_next(payload, info); });
      if (status == ReadStatus::not_yet || !out_.flush_some()) break;
      more = reader_.cursor() < last || reader_.restarts() != restarts;
    }
    return out_.flush() && continues();
  }

  // The reason why the stream cannot be shown any longer.
  const Result<void>& result() const { return result_; }

 private:
  bool continues() const { return left_ > 0 && result_ && !stop_requested(); }

  void reopen() {
    out_.flush();  // so that the lines come in order where both outputs go to one place
    report_restart(reader_);
    const bool had_fields = !printer_.fields().empty();
    Result<std::vector<Field>> fields = wanted_fields(reader_, type(), obvious_, options_);
    if (!fields) {
      result_ = std::move(fields).error();
    } else if (!options_.csv && had_fields == fields->empty()) {
      printer_.set_fields(*std::move(fields));  // it was described, or is not any more
    } else if (had_fields && *fields != printer_.fields()) {
      result_ = Error{Errc::type_mismatch,
                      fmt::format("continue with '{}': it restarted with other fields; start again "
                                  "to see them",
                                  reader_.id().str())};
    }
  }

  // The stream may have been described since it was opened: `dssmctl describe`.
  void take_description() {
    std::optional<StreamInfo> stream = follower_.take_described();
    if (!stream) return;
    described_ = *std::move(stream);
    if (described_.incarnation != reader_.incarnation()) return;  // reopen() comes to it
    Result<std::vector<Field>> fields = wanted_fields(reader_, type(), obvious_, options_);
    if (fields && *fields == printer_.fields()) return;
    if (fields && !options_.csv) return printer_.set_fields(*std::move(fields));
    out_.flush();
    print_error(fmt::format(
        "dssmctl: echo: '{}' was described, but its samples are shown as before, {}; "
        "start again to see its fields\n",
        escaped(reader_.id().str()),
        fields ? "because CSV has one header" : "because they lack what --field names"));
  }

  // Of the ring that is being read, as it is described now.
  const TypeInfo& type() const {
    const TypeInfo& opened = reader_.type();
    const bool is_newer = described_.incarnation == reader_.incarnation() &&
                          described_.type.payload_bytes == opened.payload_bytes;
    return is_newer ? described_.type : opened;
  }

  RawReader& reader_;
  Follower& follower_;
  const TypeInfo obvious_;
  SamplePrinter& printer_;
  Output& out_;
  const EchoOptions& options_;
  std::uint64_t left_;
  std::uint64_t lost_ = 0;
  std::vector<std::byte> payload_;
  StreamInfo described_;  // as it was announced with fields; first: nothing
  Result<void> result_;
};

Error failed_read(const RawReader& reader, const std::string& what, ReadStatus status, bool iso) {
  const auto error = [&](Errc code, std::string_view reason) {
    return Error{code, fmt::format("read {} of '{}': {}", what, reader.id().str(), reason)};
  };
  SampleInfo oldest;
  switch (status) {
    case ReadStatus::too_old:
      if (reader.read_info(reader.oldest_tid(), oldest) == ReadStatus::ok) {
        return error(Errc::not_found, fmt::format("too old, the ring holds samples from {} on",
                                                  time_text(oldest.time, iso)));
      }
      return error(Errc::not_found, "too old, the ring holds it no longer");
    case ReadStatus::arriving:
      return error(Errc::unavailable,
                   "its host has not sent it yet, because newer samples go first; try again");
    case ReadStatus::lost:
      return error(Errc::not_found,
                   "lost, because the network could not carry all of the stream's samples");
    case ReadStatus::lapped:
      return error(Errc::system,
                   "the writer overwrites samples faster than they can be read; give the stream "
                   "more depth");
    case ReadStatus::clock_out_of_bounds:
      return error(Errc::clock_out_of_bounds,
                   "the clocks of its host and of this PC may be too far apart, or were when the "
                   "sample was written; see `dssmctl clock`");
    default:
      return error(Errc::not_found, "nothing was written to it yet");
  }
}

// The moment that --at means. It counts back from the newest sample, not from now, because the
// stamps of a recording have nothing to do with the time on the wall.
Result<Time> moment(const RawReader& reader, const EchoOptions& options) {
  if (!options.at->back) return options.at->time;
  SampleInfo newest;
  ReadStatus status = ReadStatus::not_yet;
  do {  // the newest one may be overtaken between the two calls
    status = reader.read_info(reader.newest_tid(), newest);
  } while (status == ReadStatus::too_old && reader.newest_tid() != kNoTid);
  if (status != ReadStatus::ok)
    return failed_read(reader, "the newest sample", ReadStatus::not_yet, options.iso);
  return saturating_add(newest.time, *options.at->back);
}

// Prints the sample that --at or --last asks for; without them puts the cursor before the first
// sample to show.
Result<void> begin(const EchoOptions& options, bool awaited, RawReader& reader, Echo& echo) {
  if (options.at) {
    const Time time = DSSM_TRY(moment(reader, options));
    const ReadStatus status = echo.print([&](auto payload, auto& info) {
      const ReadStatus read = reader.read_at(time, payload, info);
      if (read == ReadStatus::ok) reader.seek(info.tid);  // print_new() continues after it
      return read;
    });
    if (!echo.result()) return echo.result();
    if (status != ReadStatus::ok) {
      return failed_read(reader, "the sample at " + time_text(time, options.iso), status,
                         options.iso);
    }
  } else if (options.last) {
    const ReadStatus status =
        echo.print([&](auto payload, auto& info) { return reader.read_newest(payload, info); });
    if (!echo.result()) return echo.result();
    if (status != ReadStatus::ok)
      return failed_read(reader, "the newest sample", status, options.iso);
  } else {
    reader.seek(awaited ? kNoTid : reader.newest_tid());
  }
  return {};
}

}  // namespace

Result<void> run(const EchoOptions& options, Output& out) {
  const FetchHistory history = options.at ? FetchHistory::at_once : FetchHistory::when_read;
  std::vector<OpenedStream> all = DSSM_TRY(open_streams(options, {options.stream}, history));
  if (all.empty()) return {};
  OpenedStream& opened = all.front();
  RawReader& reader = opened.reader;
  TypeInfo obvious = obvious_type(opened.session, reader, "echo");
  std::vector<Field> fields = DSSM_TRY(wanted_fields(reader, reader.type(), obvious, options));
  // Before the first sample is shown: after it the next ones must come too, whatever happens to
  // dssmd.
  Follower follower = DSSM_TRY(Follower::open(opened.session, reader, out));
  SamplePrinter printer(out, {form_of(options), options.full, options.iso}, reader.id(),
                        std::move(fields));
  Echo echo(reader, follower, std::move(obvious), printer, out, options);
  printer.begin();
  DSSM_TRY(begin(options, opened.awaited, reader, echo));
  if (!echo.print_new()) return echo.result();
  while (true) {
    const Follower::Wake wake = follower.wait(kNever);
    if (wake == Follower::Wake::stop) return {};
    if (!echo.print_new()) return echo.result();
    if (wake == Follower::Wake::ended) return end_of(reader);
  }
}

}  // namespace dssm::ctl
