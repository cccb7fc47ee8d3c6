// SPDX-License-Identifier: Apache-2.0
//
// A folder of a test's own for files.
#pragma once

#include <stdlib.h>

#include <cstdlib>
#include <filesystem>
#include <string>

namespace dssm::test {

class TestFolder {
 public:
  std::string file(const std::string& name) const { return path_ / name; }
  std::string path() const { return path_; }
  TestFolder() {
    std::string name = std::filesystem::temp_directory_path() / "dssm-record-XXXXXX";
    if (!::mkdtemp(name.data())) std::abort();
    path_ = name;
  }
  TestFolder(const TestFolder&) = delete;
  TestFolder& operator=(const TestFolder&) = delete;
  ~TestFolder() { std::filesystem::remove_all(path_); }

 private:
  std::filesystem::path path_;
};

}  // namespace dssm::test
