// SPDX-License-Identifier: Apache-2.0
//
// Rows of cells as aligned columns, two spaces apart, as wide as their contents. Cells are ASCII
// (see text.hpp), so bytes are columns on the screen.
#pragma once

#include <string>
#include <vector>

namespace dssm::ctl {

class Output;

class Table {
 public:
  enum class Align : unsigned char { left, right };
  struct Column {
    std::string title;
    Align align = Align::left;
  };

  explicit Table(std::vector<Column> columns) : columns_(std::move(columns)) {}

  // One cell per column.
  void add_row(std::vector<std::string> cells) { rows_.push_back(std::move(cells)); }

  // Header (bold on a terminal) and rows, without blanks at the ends of lines.
  void print(Output& out) const;

 private:
  std::vector<Column> columns_;
  std::vector<std::vector<std::string>> rows_;
};

}  // namespace dssm::ctl
