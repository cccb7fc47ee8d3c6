// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/output.hpp"

#include <gtest/gtest.h>

#include "tests/unit/client/dssmctl/printed.hpp"

namespace dssm::ctl {
namespace {

TEST(Table, AlignsColumnsToTheirContentsWithoutTrailingBlanks) {
  Table table({{"NAME"}, {"N", Table::Align::right}, {"TYPE"}});
  table.add_row({"a", "1000", "x"});
  table.add_row({"long name", "7", ""});
  EXPECT_EQ(printed([&](Output& out) { table.print(out); }),
            "NAME          N  TYPE\n"
            "a          1000  x\n"
            "long name     7\n");
}

TEST(Table, PrintsItsHeaderWithoutRows) {
  EXPECT_EQ(printed([&](Output& out) { Table({{"NAME"}, {"N"}}).print(out); }), "NAME  N\n");
}

}  // namespace
}  // namespace dssm::ctl
