// SPDX-License-Identifier: Apache-2.0
//
// A HostInfo as `dssmctl hosts` shows it.
#pragma once

#include <dssm/session.hpp>
#include <string>
#include <vector>

#include "client/dssmctl/json.hpp"
#include "client/dssmctl/table.hpp"

namespace dssm::ctl {

std::vector<Table::Column> host_columns();
std::vector<std::string> host_row(const HostInfo& host);  // a cell for each column

Json host_json(const HostInfo& host);

}  // namespace dssm::ctl
