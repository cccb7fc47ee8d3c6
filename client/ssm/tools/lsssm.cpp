// SPDX-License-Identifier: Apache-2.0
//
// lsssm: the table of this PC's streams, as SSM prints it.
//
// Exit status: 0, or 1 without dssmd.
#include "tool.hpp"

using namespace dssm::ssm_tools;

int main(int argc, char** argv) {
  if (prints_help(argc, argv, "prints a table of the streams of this PC")) return 0;
  if (!connect()) return 1;
  const auto streams = list_streams();
  if (!streams) return 1;
  constexpr const char* kRule =
      "----+----------------+------+---------+-------+----------+-------------|";
  std::printf("No. |  sensor name   | suid | size[B] |  num  | cycle[s] | property[B] |\n%s\n",
              kRule);
  int count = 0;
  for (const StreamName& stream : *streams) {
    size_t bytes = 0, property_bytes = 0;
    int num = 0;
    double cycle = 0;
    if (getSSM_info(stream.name.c_str(), stream.id, &bytes, &num, &cycle, &property_bytes) < 0) {
      continue;  // removed meanwhile
    }
    const Scaled size = scale(static_cast<double>(bytes));
    const Scaled property = scale(static_cast<double>(property_bytes));
    std::printf("%03d | %14.14s | %4d | %6.2f%c | %5d | %8.3f | %10.2f%c\n", count++,
                stream.name.c_str(), stream.id, size.value, size.unit, num, cycle, property.value,
                property.unit);
  }
  std::printf("%s\nTotal %d sensors.\n", kRule, count);
  endSSM();
  return 0;
}
