// SPDX-License-Identifier: Apache-2.0
//
// Reads and writes by the Python package, compared with the same by C++ on the same streams. Both
// alternate: bench_python.py measures a batch in an interpreter when it is asked to.
#include <fcntl.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstdlib>
#include <dssm/dssm.hpp>

#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

// The interpreter with bench_python.py; ends when its input is closed.
class Interpreter {
 public:
  explicit Interpreter(const std::string& socket) {
    int to[2], from[2];
    if (::pipe2(to, O_CLOEXEC) || ::pipe2(from, O_CLOEXEC)) std::abort();
    pid_ = ::fork();
    if (pid_ == 0) {
      ::prctl(PR_SET_PDEATHSIG, SIGKILL);
      ::dup2(to[0], 0), ::dup2(from[1], 1);
      const char* const source = std::getenv("DSSM_SOURCE_ROOT");
      const std::string script =
          std::string(source ? source : ".") + "/tests/bench/bench_python.py";
      ::setenv("DSSM_SOCKET", socket.c_str(), 1);
      ::setenv("PYTHONPATH", test::built("client/python").c_str(), 1);
      ::execl("/usr/bin/python3", "python3", script.c_str(), nullptr);
      ::_exit(127);
    }
    ::close(to[0]), ::close(from[1]);
    requests_ = ::fdopen(to[1], "w");
    answers_ = ::fdopen(from[0], "r");
  }
  Interpreter(const Interpreter&) = delete;
  Interpreter& operator=(const Interpreter&) = delete;
  ~Interpreter() {
    std::fclose(requests_), std::fclose(answers_);
    ::waitpid(pid_, nullptr, 0);
  }

  // Time of one operation, in ns.
  double time(const std::string& operation, int count) {
    std::fprintf(requests_, "%s %d\n", operation.c_str(), count);
    std::fflush(requests_);
    double ns = 0;
    if (std::fscanf(answers_, "%lf", &ns) != 1) std::abort();
    return ns;
  }

 private:
  pid_t pid_ = -1;
  std::FILE* requests_ = nullptr;
  std::FILE* answers_ = nullptr;
};

template <class InCpp>
void compare(Interpreter& python, const std::string& what, const std::string& operation,
             int batches, int count, InCpp in_cpp, const std::string& target) {
  std::vector<double> cpp_ns, python_ns;
  time_batch(count, in_cpp), python.time(operation, count);  // warm up
  for (int i = 0; i < batches; ++i) {
    cpp_ns.push_back(time_batch(count, in_cpp));
    python_ns.push_back(python.time(operation, count));
  }
  const Pair pair{figures_of(std::move(cpp_ns)), figures_of(std::move(python_ns))};
  char text[80];
  std::snprintf(text, sizeof text, "%s (%+.0f ns)", target.c_str(),
                pair.ours.median - pair.raw.median);
  print_pair("C++", "Python: " + what, pair, text);
}

}  // namespace

int main() {
  const test::DaemonProcess daemon;
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  const TypeInfo type{"", 64, 8, {{"values", Scalar::float64, 0, 8, 8}}};
  RawWriter writer = session.create_raw({"small", 0, ""}, type, {1000, 1ms}).value();
  RawReader reader = session.open_raw_reader({"small", 0, ""}).value();
  RawWriter large_writer =
      session.create_raw({"large", 0, ""}, {"", 1U << 20, 1, {}}, {4, 1ms}).value();
  RawReader large = session.open_raw_reader({"large", 0, ""}).value();
  std::vector<std::byte> payload(64), large_payload(1U << 20);
  const Time now = WallClock::now();
  writer.write(payload, now);
  large_writer.write(large_payload, now);
  SampleInfo info;
  BorrowedSample borrowed;

  Interpreter python(daemon.socket_path());
  print_head();
  const auto read = [&] { keep(reader.read_newest(payload, info)); };
  compare(python, "newest(), 64 B", "read", 200, 1000, read, "<= 1 us more");
  compare(python, "newest().value, 64 B", "read_value", 200, 1000, read, "<= 1 us more");
  compare(
      python, "at(t), 64 B", "at", 200, 1000, [&] { keep(reader.read_at(now, payload, info)); },
      "<= 1 us more");
  compare(
      python, "newest(), 1 MiB", "read_large", 100, 50,
      [&] { keep(large.read_newest(large_payload, info)); }, "one memcpy, as C++");
  compare(
      python, "borrow() and its value, 1 MiB", "borrow", 100, 1000,
      [&] { keep(large.borrow(large.newest_tid(), borrowed)); }, "none");
  compare(
      python, "write(record, t), 64 B", "write", 200, 1000, [&] { writer.write(payload, now); },
      "");
}
