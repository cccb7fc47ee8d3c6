// SPDX-License-Identifier: Apache-2.0
#include "tests/fuzz/fuzzer.hpp"

#include <google/protobuf/stubs/logging.h>

extern "C" int LLVMFuzzerInitialize(int*, char***) {
  google::protobuf::SetLogHandler(nullptr);  // it would print each message that it refuses
  return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  dssm::fuzz::run_input({data, size});
  return 0;
}
