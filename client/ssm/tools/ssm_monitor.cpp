// SPDX-License-Identifier: Apache-2.0
//
// ssm-monitor: once per second, how much was written to each stream of this PC.
//
// Exit status: 0, or 1 when there is no dssmd or it ends.
#include <algorithm>
#include <utility>

#include "tool.hpp"

using namespace dssm::ssm_tools;

namespace {

// An open stream, and how far it was in the last round.
class Watched {
 public:
  explicit Watched(StreamName name)
      : name_(std::move(name)), sid_(openSSM(name_.name.c_str(), name_.id, SSM_READ)) {
    if (sid_ != nullptr) last_ = getTID_top(sid_), bytes_ = shm_get_address(sid_)->size;
  }
  Watched(const Watched&) = delete;
  Watched(Watched&& other) noexcept
      : name_(std::move(other.name_)),
        sid_(std::exchange(other.sid_, nullptr)),
        last_(other.last_),
        bytes_(other.bytes_) {}
  Watched& operator=(Watched&&) = delete;
  ~Watched() { closeSSM(&sid_); }

  const StreamName& name() const { return name_; }

  // Prints the row of this round; returns the bytes that were written since the last one.
  double print(int number) {
    const int top = sid_ != nullptr ? getTID_top(sid_) : -1;
    const int count = top < 0 ? 0 : (top - last_) & 0x7fffffff;  // after 2147483647 comes 0
    last_ = std::max(top, -1);
    const double bytes = static_cast<double>(count) * static_cast<double>(bytes_);
    const Scaled rate = scale(bytes);
    std::printf("\033[K%3d | %32.32s |%3d | %5d | %11d | %8.3f%c\n", number, name_.name.c_str(),
                name_.id, count, top, rate.value, rate.unit);
    return bytes;
  }

 private:
  StreamName name_;
  SSM_sid sid_ = nullptr;
  int last_ = -1;
  size_t bytes_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  if (prints_help(argc, argv, "shows what is written to each stream of this PC, until Ctrl-C"))
    return 0;
  if (!connect()) return 1;
  end_on_signals();
  std::vector<Watched> watched;
  bool is_first = true;
  while (!end_requested) {
    const auto streams = list_streams();
    if (!streams) return 1;
    const bool is_same =
        std::equal(watched.begin(), watched.end(), streams->begin(), streams->end(),
                   [](const Watched& one, const StreamName& name) { return one.name() == name; });
    if (!is_same || is_first) {
      std::vector<Watched> now;
      for (const StreamName& name : *streams) {
        const auto known = std::find_if(watched.begin(), watched.end(),
                                        [&](const Watched& one) { return one.name() == name; });
        now.push_back(known != watched.end() ? std::move(*known) : Watched(name));
      }
      watched.swap(now);
      std::fputs("\033[2J", stdout);
      is_first = false;
    }
    constexpr const char* kRule =
        "----+----------------------------------+----+-------+-------------+----------|";
    std::printf(
        "\033[0;0H\033[KNo. |           sensor name            | id | count |    tid      | "
        "data[B/s] \n\033[K%s\n",
        kRule);
    double total = 0;
    int number = 0;
    for (Watched& one : watched) total += one.print(number++);
    const Scaled rate = scale(total);
    std::printf("\033[K%s\n\033[K\n\033[Kssm total wrote size : %.3f %cB/s\n", kRule, rate.value,
                rate.unit);
    std::fflush(stdout);
    const timespec second{1, 0};  // of real time, whatever the playback clock does
    ::nanosleep(&second, nullptr);
  }
  watched.clear();
  endSSM();
  return 0;
}
