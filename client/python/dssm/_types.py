# SPDX-License-Identifier: Apache-2.0
"""Conversions between descriptions of streams, numpy's dtypes and Python's dataclasses.

A dtype has the layout of the description, byte for byte. What numpy cannot express is left out: bit
fields, and arrays whose elements are neither adjacent nor parts of structs.
"""

import dataclasses
import math
import numbers
import re
import typing
from typing import Any

import numpy as np

from dssm._dssm import Field, TypeInfo
from dssm._errors import InvalidArgument

_KINDS = {
    "bool": "?", "int8": "<i1", "uint8": "<u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4",
    "uint32": "<u4", "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}
_BY_DTYPE = {np.dtype(spelled): kind for kind, spelled in _KINDS.items()}
_ELEMENT = re.compile(r"(.*)\[(\d+)\]")  # "points[3]" in "points[3].ranges"


# --- from a description to a dtype


def dtype_of(info: TypeInfo) -> np.dtype:
    """The dtype of the payloads of a stream with that description."""
    fields = [(field.name, field) for field in info.fields if not field.bits]
    if len(fields) == 1 and fields[0][0] == "value" and len(info.fields) == 1:
        field = fields[0][1]
        whole = _scalars(field)
        if whole is not None and field.offset_bytes == 0 and whole.itemsize == info.payload_bytes:
            return whole  # a scalar or an array, not a struct
    members = _members(fields, info.payload_bytes)
    if not members:
        return np.dtype(("u1", (info.payload_bytes,)))
    return _record(members, 0, info.payload_bytes)


def row_dtype(value: np.dtype) -> np.dtype:
    """The dtype of the rows of a history."""
    return _as_record(np.dtype({
        "names": ["tid", "time_ns", "clock_error_ns", "payload_bytes", "value"],
        "formats": ["<i8", "<i8", "<i8", "<i8", value],
        "offsets": [0, 8, 16, 24, 32],
        "itemsize": 32 + value.itemsize,
    }))


def _scalars(field: Field) -> np.dtype | None:
    """The dtype of a field that is a scalar or an array; None if numpy has none."""
    if field.kind == "char":
        adjacent = field.count == 1 or field.stride_bytes == 1
        return np.dtype(f"S{field.count}") if adjacent else None
    scalar = np.dtype(_KINDS[field.kind])
    if field.count == 1:
        return scalar
    if field.stride_bytes != scalar.itemsize:
        return None
    return np.dtype((scalar, (field.count,)))


def _size(field: Field) -> int:
    return 1 if field.kind == "char" else np.dtype(_KINDS[field.kind]).itemsize


def _end(field: Field) -> int:
    return field.offset_bytes + (field.count - 1) * field.stride_bytes + _size(field)


def _members(fields: list[tuple[str, Field]], end: int) -> list[tuple[str, int, np.dtype]]:
    """Name, offset and dtype of each member of a struct that ends at `end` in the payload."""
    groups: dict[str, list[tuple[str, Field]]] = {}
    elements: dict[str, dict[int, list[tuple[str, Field]]]] = {}
    for path, field in fields:
        first, dot, rest = path.partition(".")
        element = _ELEMENT.fullmatch(first)
        if element and dot:
            elements.setdefault(element[1], {}).setdefault(int(element[2]), []).append((rest, field))
        else:
            groups.setdefault(first, []).append((rest if dot else "", field))
    members = []
    for name, each in elements.items():
        array = _array_of_structs(each, groups.get(name, []), end)
        if array is not None:
            members.append((name, *array))
            groups.pop(name, None)
        else:
            groups |= {f"{name}[{index}]": inner for index, inner in each.items()}
    for name, inner in groups.items():
        member = _member(inner, end)
        if member is not None:
            members.append((name, *member))
    return members


def _member(inner: list[tuple[str, Field]], end: int) -> tuple[int, np.dtype] | None:
    """Offset and dtype of a member with these fields; "" is the member itself."""
    if inner[0][0] == "":
        field = inner[0][1]
        dtype = _scalars(field)
        return None if dtype is None else (field.offset_bytes, dtype)
    start = min(field.offset_bytes for _, field in inner)
    counts = {(field.count, field.stride_bytes) for _, field in inner}
    count, stride = next(iter(counts))
    span = max(field.offset_bytes + _size(field) for _, field in inner) - start
    if len(counts) == 1 and count > 1 and span <= stride:
        if len(inner) > 1 or stride > _size(inner[0][1]):  # an array of structs
            start = min(start, end - count * stride)
            one = [(path, Field(field.name, field.kind, field.offset_bytes)) for path, field in inner]
            members = _members(one, start + stride)
            return start, np.dtype((_record(members, start, stride), (count,)))
    members = _members(inner, max(_end(field) for _, field in inner))
    if not members:
        return None
    return start, _record(members, start, max(offset + dtype.itemsize for _, offset, dtype in members) - start)


def _array_of_structs(elements: dict[int, list[tuple[str, Field]]], common: list[tuple[str, Field]],
                      end: int) -> tuple[int, np.dtype] | None:
    """Offset and dtype of an array of structs that contain arrays, which are described one by one.

    `common` are the members that are not arrays, as one field for all elements. None if the elements
    are not alike.
    """
    count = len(elements)
    if count < 2 or sorted(elements) != list(range(count)):
        return None
    first = elements[0]
    stride = elements[1][0][1].offset_bytes - first[0][1].offset_bytes

    def layout(index: int) -> list[tuple]:
        return [(path, field.kind, field.count, field.stride_bytes, field.offset_bytes - index * stride)
                for path, field in elements[index]]

    alike = all(layout(index) == layout(0) for index in range(count))
    if not alike or any((field.count, field.stride_bytes) != (count, stride) for _, field in common):
        return None
    one = first + [(path, Field(field.name, field.kind, field.offset_bytes)) for path, field in common]
    start = min(min(field.offset_bytes for _, field in one), end - count * stride)
    if max(_end(field) for _, field in one) > start + stride:
        return None
    members = _members(one, start + stride)
    return start, np.dtype((_record(members, start, stride), (count,)))


def _record(members: list[tuple[str, int, np.dtype]], start: int, size: int) -> np.dtype:
    members = sorted(members, key=lambda member: member[1])
    return _as_record(np.dtype({
        "names": [name for name, _, _ in members],
        "formats": [dtype for _, _, dtype in members],
        "offsets": [offset - start for _, offset, _ in members],
        "itemsize": size,
    }))


# --- from a program's type to a description


def type_and_dtype(wanted: Any) -> tuple[TypeInfo, np.dtype]:
    """The description and the dtype of what a program gives as a type."""
    if isinstance(wanted, TypeInfo):
        return wanted, dtype_of(wanted)
    name = ""
    if dataclasses.is_dataclass(wanted) and isinstance(wanted, type):
        name = wanted.__name__
        dtype = dataclass_dtype(wanted)
    else:
        try:
            dtype = np.dtype(wanted)
        except TypeError as error:
            raise InvalidArgument(
                f"{wanted!r} is not a type of samples: give a numpy.dtype, a dataclass or a TypeInfo"
            ) from error
        if isinstance(wanted, type) and dtype.names is not None:  # a ctypes.Structure
            name = wanted.__name__
    fields: list[Field] = []
    _append(fields, dtype, "", 0)
    alignment = max((_size(field) for field in fields), default=1)
    if dtype.itemsize % alignment or any(field.offset_bytes % _size(field) for field in fields):
        alignment = 1  # packed
    if _is_bytes(dtype):
        return TypeInfo(name, dtype.itemsize, 1, []), np.dtype(("u1", (dtype.itemsize,)))
    return TypeInfo(name, dtype.itemsize, alignment, fields), _as_record(dtype)


def dataclass_dtype(cls: type) -> np.dtype:
    """The dtype of a dataclass, with the layout of the same struct in C.

    A field is annotated with what numpy makes a dtype of (float, int, bool, numpy.float32), with
    another dataclass, or with Annotated[..., dtype], such as Annotated[np.ndarray, ("f4", 3)].
    """
    hints = typing.get_type_hints(cls, include_extras=True)
    members = []
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        if typing.get_origin(hint) is typing.Annotated:
            hint = hint.__metadata__[0]
        try:
            members.append((field.name, _hint_dtype(hint)))
        except TypeError as error:
            raise InvalidArgument(
                f"{cls.__name__}.{field.name}: {hint!r} has no size; annotate it with a type of numpy, or "
                f"with Annotated[..., dtype], such as Annotated[np.ndarray, ('f4', 3)]") from error
    if not members:
        raise InvalidArgument(f"{cls.__name__} has no fields")
    return np.dtype(members, align=True)


def _hint_dtype(hint: Any) -> np.dtype:
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return dataclass_dtype(hint)
    if isinstance(hint, tuple) and len(hint) == 2:
        return np.dtype((_hint_dtype(hint[0]), hint[1]))
    dtype = np.dtype(hint)
    if dtype.hasobject or dtype.itemsize == 0:
        raise TypeError(hint)
    return dtype


def _is_bytes(dtype: np.dtype) -> bool:
    """Whether a program asks for bytes without a description: numpy.void of a length."""
    return dtype.names is None and dtype.subdtype is None and dtype.kind == "V"


def _as_record(dtype: np.dtype) -> np.dtype:
    """The same, whose values also have their fields as attributes."""
    return dtype if dtype.names is None else np.dtype((np.record, dtype))


def _append(fields: list[Field], dtype: np.dtype, path: str, start: int) -> None:
    """Appends the fields of a dtype that is at `start`, as C++'s DSSM_DESCRIBE does."""
    if _is_bytes(dtype) and not path:
        return
    base, shape = dtype.subdtype or (dtype, ())
    count = int(np.prod(shape, dtype=int))
    if count == 0 or base.itemsize == 0:
        raise InvalidArgument(f"{path or dtype!r} has no bytes")
    if base.names is None:
        kind, length = _scalar_kind(base, path)
        total = count * length
        fields.append(Field(path or "value", kind, start, total, base.itemsize // length))
        return
    inner: list[Field] = []
    prefix = path + "." if path else ""
    if count == 1:
        for name in base.names:
            member, offset = base.fields[name][:2]  # type: ignore[index]
            _append(fields, member, prefix + name, start + offset)
        return
    if not path:
        raise InvalidArgument(f"{dtype!r}: an array of structs must be a field of a struct")
    for name in base.names:
        member, offset = base.fields[name][:2]  # type: ignore[index]
        _append(inner, member, name, offset)
    for field in inner:
        if field.count == 1:
            fields.append(Field(prefix + field.name, field.kind, start + field.offset_bytes, count, base.itemsize))
        else:  # two strides: one field for each struct
            for i in range(count):
                fields.append(Field(f"{path}[{i}].{field.name}", field.kind,
                                    start + i * base.itemsize + field.offset_bytes, field.count,
                                    field.stride_bytes))


def _scalar_kind(dtype: np.dtype, path: str) -> tuple[str, int]:
    """The kind of a scalar, and how many elements it has."""
    if dtype.kind == "S":
        return "char", dtype.itemsize
    if dtype.kind == "V":
        return "uint8", dtype.itemsize
    kind = _BY_DTYPE.get(dtype)
    if kind is None:
        raise InvalidArgument(
            f"{path or 'the type'}: numpy's {dtype} cannot be a field of a stream; possible are bool, "
            f"integers, float32, float64 and bytes of a fixed length (S), all little endian")
    return kind, 1


# --- from a value to a payload


def pack(value: Any, dtype: np.dtype, is_described: bool) -> np.ndarray:
    """A new array, adjacent in memory, with the bytes of `value`.

    Raises ValueError for a number that the dtype cannot hold, and for a text that is too long: numpy
    would write other ones in their place.
    """
    base, shape = dtype.subdtype or (dtype, ())
    if not is_described and base == np.uint8:
        return _pack_bytes(value, dtype)
    array = np.zeros(shape, base)
    if isinstance(value, np.ndarray) and value.shape == () and value.dtype.names is not None:
        value = value[()]
    if base.names is None:
        array[...] = _fitting(value, base, shape, "")
    elif shape:
        _assign_array(array, value, shape, "the sample")
    else:
        _assign(array[()], value, "")
    return array


def _pack_bytes(value: Any, dtype: np.dtype) -> np.ndarray:
    array = np.frombuffer(value.tobytes() if isinstance(value, np.generic | np.ndarray) else value, np.uint8)
    if array.size > dtype.itemsize:
        raise ValueError(f"a sample of this stream has at most {dtype.itemsize} bytes, not {array.size}")
    return array


def _assign(record: Any, value: Any, path: str) -> None:
    """Sets all fields of a record from a dict, a dataclass, another record or a tuple."""
    names = record.dtype.names
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif isinstance(value, np.void) and value.dtype.names is not None:
        value = {name: value[name] for name in value.dtype.names}
    elif isinstance(value, tuple | list):
        if len(value) != len(names):
            raise ValueError(f"{path or 'the sample'} has {len(names)} fields {names}, not {len(value)}")
        value = dict(zip(names, value))
    if not isinstance(value, dict):
        raise TypeError(f"{path or 'the sample'} is a dict, a tuple, a dataclass or a record with the fields "
                        f"{names}, not {type(value).__name__}")
    if set(value) != set(names):
        missing, unknown = sorted(set(names) - set(value)), sorted(set(value) - set(names))
        raise ValueError(f"{path or 'the sample'} has the fields {names}; "
                         f"missing: {missing}, unknown: {unknown}")
    for name in names:
        member = record.dtype.fields[name][0]
        base, shape = member.subdtype or (member, ())
        inner = f"{path}.{name}" if path else name
        if base.names is None:
            record[name] = _fitting(value[name], base, shape, inner)
        elif not shape:
            _assign(record[name], value[name], inner)
        else:
            _assign_array(record[name], value[name], shape, inner)


def _assign_array(target: np.ndarray, value: Any, shape: tuple[int, ...], path: str) -> None:
    """The same for each struct of an array of structs."""
    if isinstance(value, np.ndarray) and value.shape == shape and value.dtype == target.dtype:
        target[...] = value
        return
    if len(value) != shape[0]:
        raise ValueError(f"{path} has {shape[0]} elements, not {len(value)}")
    for i in range(shape[0]):
        if len(shape) > 1:
            _assign_array(target[i], value[i], shape[1:], f"{path}[{i}]")
        else:
            _assign(target[i], value[i], f"{path}[{i}]")


# --- what fits


_RANGES = {dtype: (int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)) for dtype in _BY_DTYPE if dtype.kind in "iu"}


def _fitting(value: Any, base: np.dtype, shape: tuple[int, ...], path: str) -> Any:
    """`value`, which can be assigned to an array of that dtype and shape without a change."""
    if not shape:  # the most frequent ones need no array
        if type(value) is float and base == np.float64:
            return value
        if type(value) is int and base.kind in "iu":
            low, high = _RANGES[base]
            if low <= value <= high:
                return value
            raise _does_not_fit(value, base, path)
    try:
        given = np.asarray(value)
        if base.kind in "iu" and given.dtype.kind == "f" and not isinstance(value, np.ndarray | np.generic | float):
            given = np.asarray(value, object)  # a float cannot hold each integer of a list
    except ValueError as error:
        raise ValueError(f"{_named(path)}: {error}") from error
    if given.shape != shape:
        raise ValueError(f"{_named(path)} has the shape {shape}, not {given.shape}")
    if given.dtype == base or np.can_cast(given.dtype, base, "safe") and given.dtype.kind in "biuf":
        return given
    if base.kind in "SV":
        return _fitting_bytes(given, base, path)
    if given.dtype.kind == "O":
        return _fitting_objects(given, base, path)
    if given.dtype.kind not in "biuf":
        raise TypeError(f"{_named(path)} is {base}, and {_first(given)!r} is not a number")
    with np.errstate(all="ignore"):  # the comparisons below find what does not fit
        if base.kind == "b":
            fits = (given == 0) | (given == 1)
        elif base.kind == "f":
            result = given.astype(base)
            fits = ~np.isinf(result) | np.isinf(given)
            given = result if fits.all() else given
        elif given.dtype.kind == "f":
            low, high = _RANGES[base]
            wide = given.astype(np.float64)
            # float(high + 1) is exact, float(high) of 64 bits is not.
            fits = (wide == np.floor(wide)) & (wide >= float(low)) & (wide < float(high + 1))
        else:
            low, high = _RANGES[base]
            # numpy compares integers of two kinds as floats; Python does not.
            if low <= int(given.min()) and int(given.max()) <= high:
                return given
            fits = np.reshape([low <= int(each) <= high for each in given.flat], shape)
    if not fits.all():
        raise _first_that_does_not_fit(given, ~fits, base, path)
    return given


def _fitting_objects(given: np.ndarray, base: np.dtype, path: str) -> np.ndarray:
    """The same for numbers that numpy has no type for, such as large integers and decimal.Decimal."""
    result = np.zeros(given.shape, base)
    for index in np.ndindex(given.shape):
        value = given[index]
        inner = path + "".join(f"[{i}]" for i in index)
        if not isinstance(value, numbers.Number):
            raise TypeError(f"{_named(inner)} is {base}, and {value!r} is not a number")
        if base.kind in "iu":
            low, high = _RANGES[base]
            # Comparisons with NaN and infinity are false, so that int() gets neither.
            if not low <= value <= high or int(value) != value:  # type: ignore[operator, call-overload]
                raise _does_not_fit(value, base, inner)
            result[index] = int(value)  # type: ignore[call-overload]
        else:
            try:
                number = float(value)  # type: ignore[arg-type]
            except OverflowError:
                raise _does_not_fit(value, base, inner) from None
            # Of a Decimal that is too large, Python makes an infinite float.
            if math.isinf(number) and number != value:
                raise _does_not_fit(value, base, inner)
            result[index] = _fitting(number, base, (), inner)
    return result


def _fitting_bytes(given: np.ndarray, base: np.dtype, path: str) -> np.ndarray:
    """The same for texts and bytes of a fixed length; a str has ASCII characters only."""
    if given.dtype.kind == "V" and given.dtype.names is None:
        given = given.view(f"S{given.itemsize}")
    if given.dtype.kind not in "SU":
        raise TypeError(f"{_named(path)} has {base.itemsize} bytes, and {_first(given)!r} is neither bytes nor a text")
    lengths = np.char.str_len(given)  # without zeros at the end, which fill a field anyway
    if (lengths > base.itemsize).any():
        raise _first_that_does_not_fit(given, lengths > base.itemsize, base, path)
    try:
        return given.astype(f"S{base.itemsize}").astype(base)
    except UnicodeEncodeError as error:
        raise ValueError(f"{_named(path)}: a text is of ASCII characters; encode others to bytes: {error}") from error


def _named(path: str) -> str:
    return path if path and not path.startswith("[") else "the sample" + path


def _first(given: np.ndarray) -> Any:
    return given.flat[0]


def _first_that_does_not_fit(given: np.ndarray, wrong: np.ndarray, base: np.dtype, path: str) -> ValueError:
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    return _does_not_fit(given[index].item(), base, path + "".join(f"[{i}]" for i in index))


def _does_not_fit(value: Any, base: np.dtype, path: str) -> ValueError:
    if base.kind in "SV":
        return ValueError(f"{_named(path)}: {value!r} has {len(value)} bytes, and there is space for {base.itemsize}")
    if base.kind in "iu":
        low, high = _RANGES[base]
        holds = f"which holds whole numbers from {low} to {high}"
    elif base.kind == "b":
        holds = "which holds True and False"
    else:
        high = np.finfo(base).max
        holds = f"which holds numbers from {-high} to {high}"
    return ValueError(f"{_named(path)}: {value} does not fit into {base}, {holds}")
