// SPDX-License-Identifier: Apache-2.0
//
// The one file that uses numpy's C interface: to make an array and a record from it takes a quarter
// of the time that it takes by pybind11.
#define NPY_NO_DEPRECATED_API NPY_1_7_API_VERSION
#include "client/python/values.hpp"

#include <numpy/arrayobject.h>
#include <numpy/arrayscalars.h>
#include <pybind11/stl.h>

#include <algorithm>

namespace dssm::python {
namespace {

py::object types(const char* function) { return py::module_::import("dssm._types").attr(function); }

PyArrayObject* array_of(const py::object& object) {
  return reinterpret_cast<PyArrayObject*>(object.ptr());
}
PyArray_Descr* descr_of(const py::object& dtype) {
  return reinterpret_cast<PyArray_Descr*>(dtype.ptr());
}

// A new array of `dtype`, with dimensions of its own or of a dtype that is an array.
py::object make_array(const py::object& dtype, int dimensions, npy_intp* shape, void* data,
                      int flags) {
  Py_INCREF(dtype.ptr());  // which this function takes over
  PyObject* const array = PyArray_NewFromDescr(&PyArray_Type, descr_of(dtype), dimensions, shape,
                                               nullptr, data, flags, nullptr);
  if (!array) throw py::error_already_set();
  return py::reinterpret_steal<py::object>(array);
}

// A read-only array of the memory at `payload`, which `owner` keeps mapped.
py::object make_view(const py::object& dtype, int dimensions, npy_intp* shape,
                     std::span<const std::byte> payload, const py::object& owner) {
  void* const data = const_cast<std::byte*>(payload.data());
  py::object view = make_array(dtype, dimensions, shape, data, NPY_ARRAY_C_CONTIGUOUS);
  PyArray_UpdateFlags(array_of(view), NPY_ARRAY_ALIGNED);
  Py_INCREF(owner.ptr());
  if (PyArray_SetBaseObject(array_of(view), owner.ptr()) != 0) throw py::error_already_set();
  return view;
}

}  // namespace

ValueType::ValueType(const TypeInfo& type) : ValueType(type, types("dtype_of")(type)) {}

ValueType::ValueType(const TypeInfo& type, py::object dtype)
    : payload_bytes_(type.payload_bytes),
      is_described_(!type.fields.empty()),
      dtype_(std::move(dtype)),
      row_dtype_(py::none()) {
  const PyArray_Descr* const descr = descr_of(dtype_);
  kind_ = PyDataType_HASSUBARRAY(descr) ? Kind::array
          : PyDataType_HASFIELDS(descr) ? Kind::record
                                        : Kind::scalar;
  is_bytes_ =
      !is_described_ && kind_ == Kind::array && descr->subarray->base->type_num == NPY_UINT8;
}

py::object ValueType::new_array() const { return make_array(dtype_, 0, nullptr, nullptr, 0); }

std::span<std::byte> ValueType::bytes_of(const py::object& array) {
  return {data_of(array), static_cast<std::size_t>(PyArray_NBYTES(array_of(array)))};
}

std::byte* ValueType::data_of(const py::object& array) {
  return static_cast<std::byte*>(PyArray_DATA(array_of(array)));
}

py::object ValueType::value_of(const py::object& array, const SampleInfo& info) const {
  if (info.payload_bytes < payload_bytes_) {
    if (is_bytes_) {
      return array[py::slice(0, static_cast<py::ssize_t>(info.payload_bytes), 1)];
    }
    zero_rest(bytes_of(array), info);
  }
  if (kind_ == Kind::array) return array;
  // A record has the array's memory; other scalars have a copy of these few bytes.
  PyObject* const scalar = PyArray_Scalar(data_of(array), descr_of(dtype_), array.ptr());
  if (!scalar) throw py::error_already_set();
  return py::reinterpret_steal<py::object>(scalar);
}

py::object ValueType::view(std::span<const std::byte> payload, const py::object& owner) const {
  py::object array = make_view(dtype_, 0, nullptr, payload, owner);
  if (kind_ != Kind::record) return array;
  PyObject* const record = PyArray_Scalar(data_of(array), descr_of(dtype_), array.ptr());
  if (!record) throw py::error_already_set();
  return py::reinterpret_steal<py::object>(record);
}

py::object ValueType::bytes_view(std::span<const std::byte> payload, const py::object& owner) {
  const auto uint8 = py::reinterpret_steal<py::object>(
      reinterpret_cast<PyObject*>(PyArray_DescrFromType(NPY_UINT8)));
  npy_intp size = static_cast<npy_intp>(payload.size());
  return make_view(uint8, 1, &size, payload, owner);
}

py::object ValueType::new_rows(std::size_t count) const {
  if (row_dtype_.is_none()) row_dtype_ = types("row_dtype")(dtype_);
  npy_intp shape = static_cast<npy_intp>(count);
  return make_array(row_dtype_, 1, &shape, nullptr, 0);
}

bool ValueType::has_shape(PyObject* object) const {
  auto* const array = reinterpret_cast<PyArrayObject*>(object);
  const PyArray_ArrayDescr* const wanted = descr_of(dtype_)->subarray;
  if (!PyArray_EquivTypes(PyArray_DESCR(array), wanted->base)) return false;
  if (is_bytes_)
    return PyArray_NDIM(array) == 1 &&
           static_cast<std::size_t>(PyArray_NBYTES(array)) <= payload_bytes_;
  const auto shape = py::reinterpret_borrow<py::tuple>(wanted->shape);
  if (static_cast<std::size_t>(PyArray_NDIM(array)) != shape.size()) return false;
  for (int i = 0; i < PyArray_NDIM(array); ++i) {
    if (PyArray_DIM(array, i) != shape[static_cast<std::size_t>(i)].cast<npy_intp>()) return false;
  }
  return true;
}

std::span<const std::byte> ValueType::payload_of(py::handle value, py::object& keeper) const {
  const auto is_same = [&](PyArray_Descr* descr) {
    return descr == descr_of(dtype_) || PyArray_EquivTypes(descr, descr_of(dtype_));
  };
  // A record as reads return it, or an array without dimensions of its own.
  if (PyArray_IsScalar(value.ptr(), Void)) {
    const auto* const scalar = reinterpret_cast<const PyVoidScalarObject*>(value.ptr());
    if (is_same(scalar->descr)) {
      keeper = py::reinterpret_borrow<py::object>(value);
      return {reinterpret_cast<const std::byte*>(scalar->obval), payload_bytes_};
    }
  }
  if (PyArray_Check(value.ptr())) {
    keeper = py::reinterpret_borrow<py::object>(value);
    PyArrayObject* const array = array_of(keeper);
    if (kind_ != Kind::array && PyArray_NDIM(array) == 0 && is_same(PyArray_DESCR(array))) {
      return {data_of(keeper), payload_bytes_};
    }
    if (kind_ == Kind::array && PyArray_IS_C_CONTIGUOUS(array) && has_shape(keeper.ptr()))
      return bytes_of(keeper);
  }
  keeper = types("pack")(value, dtype_, is_described_);
  return bytes_of(keeper);
}

WantedType wanted_type(py::handle value) {
  if (value.is_none()) return {std::nullopt, py::none()};
  const py::tuple both = types("type_and_dtype")(value);
  return {both[0].cast<TypeInfo>(), both[1]};
}

namespace {

std::string shown(const TypeInfo& type) {
  return type.name.empty() ? "a type without a name" : "'" + type.name + "'";
}

void replace(std::string& text, const std::string& what, const std::string& by) {
  if (const std::size_t at = text.find(what); at != text.npos) text.replace(at, what.size(), by);
}

}  // namespace

void check_type(const StreamId& id, const TypeInfo& type, const WantedType& wanted) {
  if (!wanted.type) return;
  TypeInfo has = type, wants = *wanted.type;
  if (has.name.empty() || wants.name.empty()) {
    // Only types with names are compared by their fields and alignments.
    const std::string name = !has.name.empty()     ? has.name
                             : !wants.name.empty() ? wants.name
                                                   : "unnamed";
    has.name = wants.name = name;
    wants.alignment_bytes = has.alignment_bytes;
  }
  if (const Result<void> usable = has.check_usable_as(wants); !usable) {
    Error error = usable.error();
    // Under their own names.
    replace(error.message, "the stream carries '" + has.name + "'",
            "the stream carries " + shown(type));
    std::string name = shown(*wanted.type);
    if (wanted.type->name.empty() && wanted.dtype.attr("names").is_none()) {
      name = "dtype " + std::string(py::str(wanted.dtype));
    }
    replace(error.message, "this program wants '" + wants.name + "'", "this program wants " + name);
    raise(std::move(error).context("open '" + id.str() + "'"));
  }
}

namespace {

// --- Sample

struct SampleObject {
  PyObject_HEAD SampleInfo info;
  PyObject* value;  // owned
};

SampleObject& sample_of(PyObject* self) { return *reinterpret_cast<SampleObject*>(self); }

std::string repr_of(const SampleInfo& info) {
  return "tid=" + std::to_string(info.tid) + ", time_ns=" + std::to_string(to_ns(info.time));
}

void define_types(py::module_& module) {
  py::class_<Field>(module, "Field", "One field of a type; of nested structs the name has dots.")
      .def(py::init([](std::string name, const std::string& kind, std::uint64_t offset_bytes,
                       std::uint64_t count, std::uint64_t stride_bytes) {
             for (int each = 1; each <= static_cast<int>(Scalar::float64); ++each) {
               const auto scalar = static_cast<Scalar>(each);
               if (name_of(scalar) == kind) {
                 return Field{std::move(name), scalar, offset_bytes, count, stride_bytes};
               }
             }
             throw py::value_error("'" + kind + "' is not a kind of a field, such as 'float64'");
           }),
           py::arg("name"), py::arg("kind"), py::arg("offset_bytes"), py::arg("count") = 1,
           py::arg("stride_bytes") = 0, "A field; kind: 'float64', 'uint8', 'bool', 'char' ...")
      .def_readonly("name", &Field::name, "Its name, such as 'pose.x'.")
      .def_property_readonly(
          "kind", [](const Field& field) { return std::string(name_of(field.kind)); },
          "The type of its elements, such as 'float64'.")
      .def_readonly("offset_bytes", &Field::offset_bytes, "Where it begins in the payload.")
      .def_readonly("count", &Field::count, "The number of its elements.")
      .def_readonly("stride_bytes", &Field::stride_bytes, "The distance between two elements.")
      .def_readonly("bits", &Field::bits, "Of a bit field: how many bits it has; else 0.")
      .def_readonly("first_bit", &Field::first_bit, "Of a bit field: its least significant bit.");
  py::class_<TypeInfo>(module, "TypeInfo", "The description of a payload, as a stream has it.")
      .def(py::init([](std::string name, std::uint64_t payload_bytes, std::uint32_t alignment_bytes,
                       std::vector<Field> fields) {
             TypeInfo type{std::move(name), payload_bytes, alignment_bytes, std::move(fields)};
             python::value_of(type.check());
             return type;
           }),
           py::arg("name"), py::arg("payload_bytes"), py::arg("alignment_bytes") = 1,
           py::arg("fields") = std::vector<Field>(), "A description; raises InvalidArgument.")
      .def_readonly("name", &TypeInfo::name, "Its name; empty: it matches each name.")
      .def_readonly("payload_bytes", &TypeInfo::payload_bytes, "Of a sample, at most.")
      .def_readonly("alignment_bytes", &TypeInfo::alignment_bytes, "Its alignment in C++.")
      .def_readonly("fields", &TypeInfo::fields, "Its fields; empty: not described.")
      .def_property_readonly(
          "dtype", [](const TypeInfo& type) { return types("dtype_of")(type); },
          "The numpy.dtype of its values.")
      .def(
          "__eq__", [](const TypeInfo& a, const TypeInfo& b) { return a == b; }, py::arg("other"),
          py::is_operator())
      .def("__str__", &TypeInfo::description)
      .def("__repr__",
           [](const TypeInfo& type) { return "<dssm.TypeInfo " + type.description() + ">"; });
}

PyGetSetDef sample_attributes[] = {
    {"tid", [](PyObject* self, void*) { return PyLong_FromLongLong(sample_of(self).info.tid); },
     nullptr, "Its number in the stream: 0, 1, 2 ...", nullptr},
    {"time_ns",
     [](PyObject* self, void*) { return PyLong_FromLongLong(to_ns(sample_of(self).info.time)); },
     nullptr, "When it was measured, by the writer's clock: ns since 1970.", nullptr},
    {"time",
     [](PyObject* self, void*) -> PyObject* {
       PyArray_DatetimeMetaData metadata{NPY_FR_ns, 1};
       npy_datetime time = to_ns(sample_of(self).info.time);
       PyArray_Descr* const descr = PyArray_DescrNewFromType(NPY_DATETIME);
       if (!descr) return nullptr;
       reinterpret_cast<PyArray_DatetimeDTypeMetaData*>(descr->c_metadata)->meta = metadata;
       PyObject* const scalar = PyArray_Scalar(&time, descr, nullptr);
       Py_DECREF(descr);
       return scalar;
     },
     nullptr, "time_ns as a numpy.datetime64[ns].", nullptr},
    {"clock_error_ns",
     [](PyObject* self, void*) {
       return PyLong_FromLongLong(to_ns(sample_of(self).info.clock_error));
     },
     nullptr, "Bound on the error of time_ns [ns]; UNKNOWN_CLOCK_ERROR, FOREIGN_CLOCK.", nullptr},
    {"payload_bytes",
     [](PyObject* self, void*) {
       return PyLong_FromUnsignedLongLong(sample_of(self).info.payload_bytes);
     },
     nullptr, "The length of its payload; fields beyond it are 0.", nullptr},
    {"info", [](PyObject* self, void*) { return py::cast(sample_of(self).info).release().ptr(); },
     nullptr, "What it has besides its value.", nullptr},
    {"value",
     [](PyObject* self, void*) {
       Py_INCREF(sample_of(self).value);
       return sample_of(self).value;
     },
     nullptr,
     "A numpy.record with the fields, as value['x'] or value.x; a scalar or an array for a stream "
     "of "
     "such; an array of bytes for one without a description.",
     nullptr},
    {},
};

PyObject* sample_repr(PyObject* self) {
  return PyUnicode_FromFormat("Sample(%s, value=%S)", repr_of(sample_of(self).info).c_str(),
                              sample_of(self).value);
}

void sample_dealloc(PyObject* self) {
  PyTypeObject* const type = Py_TYPE(self);
  Py_DECREF(sample_of(self).value);
  PyObject_Free(self);
  Py_DECREF(type);
}

char sample_doc[] = "A sample: a copy, with its time.";
PyType_Slot sample_slots[] = {
    {Py_tp_doc, sample_doc},
    {Py_tp_getset, sample_attributes},
    {Py_tp_repr, reinterpret_cast<void*>(&sample_repr)},
    {Py_tp_dealloc, reinterpret_cast<void*>(&sample_dealloc)},
    {},
};
PyType_Spec sample_spec = {"dssm.Sample", sizeof(SampleObject), 0,
                           Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, sample_slots};
PyTypeObject* sample_type = nullptr;  // of the module, which is never unloaded

void define_sample(py::module_& module) {
  sample_type = reinterpret_cast<PyTypeObject*>(PyType_FromSpec(&sample_spec));
  if (!sample_type) throw py::error_already_set();
  module.add_object("Sample", py::handle(reinterpret_cast<PyObject*>(sample_type)));
}

}  // namespace

py::object make_sample(const SampleInfo& info, py::object value) {
  auto* const sample = PyObject_New(SampleObject, sample_type);
  if (!sample) throw py::error_already_set();
  sample->info = info;
  sample->value = value.release().ptr();
  return py::reinterpret_steal<py::object>(reinterpret_cast<PyObject*>(sample));
}

bool is_sample(py::handle object) { return Py_IS_TYPE(object.ptr(), sample_type); }
const SampleInfo& info_of(py::handle sample) { return sample_of(sample.ptr()).info; }
py::object value_of(py::handle sample) {
  return py::reinterpret_borrow<py::object>(sample_of(sample.ptr()).value);
}

void define_values(py::module_& module) {
  if (_import_array() < 0) throw py::error_already_set();
  define_types(module);
  py::class_<SampleInfo>(module, "SampleInfo", "What a sample has besides its value.")
      .def_readonly("tid", &SampleInfo::tid, "Its number in the stream: 0, 1, 2 ...")
      .def_property_readonly(
          "time_ns", [](const SampleInfo& info) { return to_ns(info.time); },
          "When it was measured, by the writer's clock: ns since 1970.")
      .def_property_readonly(
          "clock_error_ns", [](const SampleInfo& info) { return to_ns(info.clock_error); },
          "Bound on the error of time_ns [ns]; UNKNOWN_CLOCK_ERROR, FOREIGN_CLOCK.")
      .def_readonly("payload_bytes", &SampleInfo::payload_bytes, "The length of its payload.")
      .def("__repr__", [](const SampleInfo& info) { return "SampleInfo(" + repr_of(info) + ")"; });
  define_sample(module);
}

}  // namespace dssm::python
