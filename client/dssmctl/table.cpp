// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/table.hpp"

#include <algorithm>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

void Table::print(Output& out) const {
  std::vector<std::size_t> widths;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    std::size_t width = columns_[i].title.size();
    for (const auto& row : rows_) width = std::max(width, row[i].size());
    widths.push_back(width);
  }
  std::string line;
  const auto add_cell = [&](std::size_t i, const std::string& cell) {
    const std::size_t blanks = widths[i] - cell.size();
    if (i > 0) line += "  ";
    if (columns_[i].align == Align::right) line.append(blanks, ' ');
    line += cell;
    if (columns_[i].align == Align::left) line.append(blanks, ' ');
  };
  const auto end_line = [&] { line.erase(line.find_last_not_of(' ') + 1); };

  for (std::size_t i = 0; i < columns_.size(); ++i) add_cell(i, columns_[i].title);
  end_line();
  out.add(out.bold(line));
  out.add("\n");
  for (const auto& row : rows_) {
    line.clear();
    for (std::size_t i = 0; i < columns_.size(); ++i) add_cell(i, row[i]);
    end_line();
    out.add(line);
    out.add("\n");
  }
}

}  // namespace dssm::ctl
