// SPDX-License-Identifier: Apache-2.0
//
// ssm-logger: records one stream of any type in SSM's log format, until SIGINT, SIGTERM or SIGHUP.
//
// The first sample in the log is the one after the newest at its start; of a stream without samples
// it is the very first. Samples that the program was too slow for, or that the network lost, are
// counted by their numbers and reported at the end. After a signal it records what was written
// until then; after a second one it ends at once.
//
// Exit status: 0; 255 for bad arguments, without dssmd, when the stream does not appear within
// 60 s, and when the log cannot be written.
#include <getopt.h>

#include <ssm-log.hpp>

#include "tool.hpp"

using namespace dssm::ssm_tools;

namespace {

constexpr int kFailed = 255;
constexpr double kMaxWaitSeconds = 60;

void print_help() {
  std::fprintf(stderr,
               "SSM-LOGGER\n"
               "  records a stream in a log\n"
               "USAGE\n"
               "  ssm-logger -l FILE -n NAME [-i ID]\n"
               "OPTIONS\n"
               "  -l | --log-name FILE    : the log; an existing file is replaced\n"
               "  -n | --stream-name NAME : the stream\n"
               "  -i | --stream-id ID     : its number; without it 0\n"
               "  -v | --verbose          : report gaps at once, not only at the end\n"
               "  -q | --quiet            : no output but errors and lost samples\n"
               "  -h | --help             : print this help\n");
}

struct Options {
  const char* log_name = nullptr;
  const char* stream_name = nullptr;
  int stream_id = 0;
  bool verbose = false, quiet = false;
};

bool parse(int argc, char** argv, Options& options) {
  const option known[] = {{"log-name", required_argument, nullptr, 'l'},
                          {"stream-name", required_argument, nullptr, 'n'},
                          {"stream-id", required_argument, nullptr, 'i'},
                          {"verbose", no_argument, nullptr, 'v'},
                          {"quiet", no_argument, nullptr, 'q'},
                          {"help", no_argument, nullptr, 'h'},
                          {nullptr, 0, nullptr, 0}};
  // NOLINTNEXTLINE(concurrency-mt-unsafe): one thread
  for (int option; (option = ::getopt_long(argc, argv, "l:n:i:vqh", known, nullptr)) != -1;) {
    switch (option) {
      case 'l':
        options.log_name = optarg;
        break;
      case 'n':
        options.stream_name = optarg;
        break;
      case 'i': {
        const std::optional<int> id = parse_stream_id(optarg);
        if (!id) return false;
        options.stream_id = *id;
        break;
      }
      case 'v':
        options.verbose = true;
        break;
      case 'q':
        options.quiet = true;
        break;
      default:
        return print_help(), false;
    }
  }
  if (optind < argc) return print_error("'%s' is not an option; see --help", argv[optind]), false;
  if (!options.log_name || !options.stream_name) {
    print_error("give the log's name and the stream's: ssm-logger -l FILE -n NAME");
    return false;
  }
  if (!std::strchr(options.stream_name, ':')) return true;
  print_error("'%s' is not a stream's name, which has no ':' : give the number with -i",
              options.stream_name);
  return false;
}

// One recording.
class Recorder {
 public:
  explicit Recorder(const Options& options)
      : options_(options), stream_(options.stream_name, options.stream_id) {}

  // Opens the stream and creates the log.
  bool start() {
    stream_.setVerbose(false);
    if (dssm_ssm_wait_stream(options_.stream_name, options_.stream_id, kMaxWaitSeconds) != 1) {
      if (!end_requested) {
        // lsssm lists this PC's alone.
        const bool has_host = std::strchr(options_.stream_name, '@') != nullptr;
        print_error(
            "cannot get ssm info of '%s' [%d] : there is no such stream; %s lists them, and "
            "-i gives the number",
            options_.stream_name, options_.stream_id, has_host ? "dssmctl ls" : "lsssm");
      }
      return false;
    }
    size_t data_bytes = 0, property_bytes = 0;
    int num = 0;
    double cycle = 0;
    if (getSSM_info(options_.stream_name, options_.stream_id, &data_bytes, &num, &cycle,
                    &property_bytes) < 0) {
      print_error("cannot get ssm info of '%s' [%d]", options_.stream_name, options_.stream_id);
      return false;
    }
    data_.resize(data_bytes + 1);  // an address also for samples of 0 bytes
    property_.resize(property_bytes + 1);
    stream_.setBuffer(data_.data(), data_bytes, property_.data(), property_bytes);
    log_.setBuffer(data_.data(), data_bytes, property_.data(), property_bytes);
    if (property_bytes > 0 && !stream_.getProperty()) return false;
    if (!stream_.open()) return false;
    stream_.setBlocking(true);
    // What is written from here on belongs to the log.
    stream_.timeId = getTID_top(stream_.getSSMId());
    const std::string name = options_.stream_name;  // a log names no host
    if (!log_.create(name.substr(0, name.find('@')).c_str(), options_.stream_id, num, cycle,
                     options_.log_name)) {
      return false;
    }
    return true;
  }

  // Until a signal; false when the log cannot be written.
  bool record() {
    while (!end_requested) {
      if (!record_next()) return false;
    }
    stream_.setBlocking(false);
    for (const int last = getTID_top(stream_.getSSMId());
         end_requested < 2 && is_before(stream_.timeId, last);) {
      const int before = stream_.timeId;
      if (!record_next()) return false;
      if (stream_.timeId == before) break;
    }
    return true;
  }

  // Closes the log and reports what is in it.
  bool finish() {
    const bool stored = log_.close();
    if (!options_.quiet) std::printf("%lld samples recorded.\n", recorded_);
    if (lost_ > 0) {
      std::fprintf(
          stderr,
          "WARNING : %lld samples are missing in '%s' : the stream was written faster than "
          "they could be recorded\n",
          lost_, options_.log_name);
    }
    return stored;
  }

 private:
  // Tids are 31 bits of a counter without end.
  static int distance(int from, int to) { return (to - from) & 0x7fffffff; }
  static bool is_before(int tid, int last) {
    return last >= 0 && tid != last && (tid < 0 || distance(tid, last) < 0x40000000);
  }

  // Records the next sample, if there is one; false when the log cannot be written.
  bool record_next() {
    const int before = stream_.timeId;
    if (!read_next()) return true;
    const int lost = distance(before + 1, stream_.timeId);
    lost_ += lost;
    if (lost > 0 && options_.verbose) {
      std::fprintf(stderr, "%d samples before TID %d are lost\n", lost, stream_.timeId);
    }
    if (!log_.write(stream_.time)) return false;
    ++recorded_;
    return true;
  }

  bool read_next() {
    // readNext() takes the newest of a stream of which nothing was read; here the first is wanted.
    if (stream_.timeId >= 0) return stream_.readNext();
    if (waitTID(stream_.getSSMId(), 0) != 1) return false;
    const int oldest = getTID_bottom(stream_.getSSMId());
    return stream_.read(oldest);
  }

  const Options& options_;
  SSMApiBase stream_;
  SSMLogBase log_;
  std::vector<char> data_, property_;
  long long recorded_ = 0, lost_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  Options options;
  if (!parse(argc, argv, options)) return kFailed;
  end_on_signals();
  if (!connect()) return kFailed;
  if (!options.quiet) {
    std::printf("open stream '%s' [%d].\n", options.stream_name, options.stream_id);
    std::fflush(stdout);
  }
  Recorder recorder(options);
  if (!recorder.start()) return kFailed;
  const bool recorded = recorder.record();
  const bool stored = recorder.finish();
  endSSM();
  return recorded && stored ? 0 : kFailed;
}
