// SPDX-License-Identifier: Apache-2.0
//
// Payloads as values of Python: with fields a numpy.record, of one scalar a scalar of numpy, of an
// array or of a stream without a description a numpy.ndarray.
#pragma once

#include <pybind11/pybind11.h>

#include <cstddef>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <optional>
#include <span>
#include <string>

#include "client/python/python.hpp"

namespace dssm::python {

// A new dssm.Sample: infos and a value that is a copy. Its type is written by Python's C interface,
// because an object of pybind11 and each use of its attributes take 0.2 us more.
py::object make_sample(const SampleInfo& info, py::object value);
bool is_sample(py::handle object);
// Of a Sample.
const SampleInfo& info_of(py::handle sample);
py::object value_of(py::handle sample);

// How the payloads of one stream become values. dssm._types has the conversions between
// descriptions and dtypes.
class ValueType {
 public:
  // For a stream of type `type`, as it is described.
  explicit ValueType(const TypeInfo& type);
  // The same with a dtype that the program has given, of the same size.
  ValueType(const TypeInfo& type, py::object dtype);

  const py::object& dtype() const noexcept { return dtype_; }
  // Whether values are the bytes of the samples, which then may differ in length.
  bool is_bytes() const noexcept { return is_bytes_; }

  // Memory for one payload, which a read fills; then value_of() makes it a value.
  py::object new_array() const;
  static std::span<std::byte> bytes_of(const py::object& array);
  py::object value_of(const py::object& array, const SampleInfo& info) const;

  // A value that is the memory at `payload` itself, read-only, which `owner` keeps mapped.
  py::object view(std::span<const std::byte> payload, const py::object& owner) const;
  // The same as an array of bytes.
  static py::object bytes_view(std::span<const std::byte> payload, const py::object& owner);

  // An array of `count` rows: tid, time_ns, clock_error_ns, payload_bytes and value. The
  // distance between rows, and where a row has its value.
  py::object new_rows(std::size_t count) const;
  static constexpr std::size_t kRowHeaderBytes = 32;
  std::size_t row_bytes() const noexcept { return kRowHeaderBytes + payload_bytes_; }
  static std::byte* data_of(const py::object& array);

  // The payload of `value`, for a write; `keeper` keeps it in memory. May be shorter than the
  // stream's if that is not described.
  //   raises  TypeError, ValueError
  std::span<const std::byte> payload_of(py::handle value, py::object& keeper) const;

 private:
  // Whether an array is of the stream's array type, or of bytes that are not too many.
  bool has_shape(PyObject* array) const;

  std::size_t payload_bytes_;
  bool is_described_, is_bytes_;
  py::object dtype_;
  mutable py::object row_dtype_;  // of new_rows(); made by its first call
  enum class Kind { record, scalar, array } kind_;
};

// `value` is an argument that names a type: None, a dtype or what numpy makes one of, a dataclass,
// or a TypeInfo.
struct WantedType {
  std::optional<TypeInfo> type;
  py::object dtype;  // None: as described
};
WantedType wanted_type(py::handle value);

// Fails with type_mismatch unless `type`, of a stream, is what the program wants. Other than
// TypeInfo::check_usable_as(), also compares the fields of types without a name: numpy's have none.
void check_type(const StreamId& id, const TypeInfo& type, const WantedType& wanted);

// How an open reader or writer is shown: its stream with the host, its type, and the newest tid.
template <class Raw>
std::string repr_of(const std::string& name, const Raw& raw) {
  const Tid newest = raw.newest_tid();
  return "<dssm." + name + " " + raw.id().str() + ": " + raw.type().str() + ", " +
         (newest == kNoTid ? "nothing written" : "newest tid " + std::to_string(newest)) + ">";
}

}  // namespace dssm::python
