// SPDX-License-Identifier: Apache-2.0
//
// A writer of a stream for Python.
#pragma once

#include <dssm/writer.hpp>
#include <optional>

#include "client/python/values.hpp"

namespace dssm::python {

struct Writer {
  Writer(RawWriter writer, const WantedType& wanted)
      : raw(std::move(writer)),
        values(wanted.dtype.is_none() ? ValueType(raw->type())
                                      : ValueType(raw->type(), wanted.dtype)) {
    check_type(raw->id(), raw->type(), wanted);
  }
  std::optional<RawWriter> raw;  // empty: closed
  ValueType values;
  bool in_use = false;

  // The writer, if it is neither closed nor in use.
  RawWriter& checked() {
    Use::check(in_use);
    if (!raw) raise("closed", "the writer is closed");
    return *raw;
  }
};

}  // namespace dssm::python
