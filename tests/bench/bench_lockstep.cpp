// SPDX-License-Identifier: Apache-2.0
//
// `dssmctl play --lockstep`: from one sample to the next, with a program that waits for each and
// does nothing else. The player has to notice that the program waits again before it goes on. The
// raw limit is one byte through a pipe to another process, and one back through a second pipe.
#include <unistd.h>

#include <cstdlib>
#include <dssm/dssm.hpp>
#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string_view>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kSamples = 2000;
constexpr int kRounds = 5;

struct Bytes64 {
  std::int64_t number;
  std::byte rest[56];
};

// The program in lockstep: writes a line with the time since the sample before, for each.
void read_in_lockstep(const char* path) {
  Session session = Session::connect().value();
  Reader<Bytes64> reader = session.await_reader<Bytes64>("lockstep").value();
  reader.seek(kNoTid);
  std::vector<std::int64_t> times;
  while (times.size() < kSamples) {
    (void)reader.wait(kNever);
    while (reader.read_next()) times.push_back(now_ns());
  }
  std::ofstream file(path);
  for (std::size_t i = 1; i < times.size(); ++i) file << times[i] - times[i - 1] << '\n';
}

std::vector<double> numbers_in(const std::string& path) {
  std::ifstream file(path);
  return {std::istream_iterator<double>(file), {}};
}

struct Pipe {
  int ends[2];
  Pipe() {
    if (::pipe(ends)) fail("pipe");
  }
  void put() const {
    if (::write(ends[1], "", 1) != 1) fail("write");
  }
  void take() const {
    char byte = 0;
    if (::read(ends[0], &byte, 1) != 1) fail("read");
  }
};

std::vector<double> through_pipes() {
  const Pipe there, back;
  const pid_t child = in_child([&] {
    while (true) there.take(), back.put();
  });
  std::vector<double> times;
  for (int i = 0; i < kSamples; ++i) {
    const std::int64_t began = now_ns();
    there.put(), back.take();
    times.push_back(static_cast<double>(now_ns() - began));
  }
  end_child(child);
  for (const Pipe* pipe : {&there, &back}) ::close(pipe->ends[0]), ::close(pipe->ends[1]);
  return times;
}

// Samples 1 ms apart.
void write_recording(const std::string& path) {
  RecordingWriter writer = RecordingWriter::create(path).value();
  const std::uint32_t stream =
      writer.add_stream({{"lockstep", 0, "pc1"}, type_of<Bytes64>(), kSamples, 1ms, 1, {}}).value();
  for (int i = 0; i < kSamples; ++i) {
    const Bytes64 sample{i, {}};
    const SampleInfo info{i, time_from_ns(1'000'000'000) + i * 1ms, Duration::zero(),
                          sizeof sample};
    (void)writer.write(stream, info, 1us, std::as_bytes(std::span(&sample, 1))).value();
  }
  (void)writer.finish().value();
}

}  // namespace

int main(int argc, char** argv) {
  if (argc == 3 && std::string_view(argv[1]) == "read") {
    read_in_lockstep(argv[2]);
    return 0;
  }
  const char* temporary = std::getenv("TMPDIR");
  std::string folder = std::string(temporary ? temporary : "/tmp") + "/bench-lockstep-XXXXXX";
  if (::mkdtemp(folder.data()) == nullptr) return 1;
  const test::DaemonProcess daemon;
  const std::string recording = folder + "/a.mcap", times = folder + "/times";
  write_recording(recording);
  std::vector<double> raw, ours;
  for (int round = 0; round < kRounds; ++round) {
    for (const double ns : through_pipes()) raw.push_back(ns);
    const pid_t player =
        test::start({test::built("client/dssmctl/dssmctl"), "play", recording, "--lockstep",
                     std::string("exec ") + argv[0] + " read " + times},
                    {daemon.environment()});
    if (test::wait_for(player) != 0) fail("dssmctl play");
    for (const double ns : numbers_in(times)) ours.push_back(ns);
  }
  print_head();
  print_pair("there and back through pipes", "play --lockstep, each sample",
             {figures_of(raw), figures_of(ours)}, "-");
  std::filesystem::remove_all(folder);
  return 0;
}
