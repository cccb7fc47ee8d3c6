// SPDX-License-Identifier: Apache-2.0
//
// From a C++ struct to a TypeInfo. Name, size and alignment of a type are known by themselves; one
// line adds its fields, for `dssmctl echo` and other tools:
//
//   struct Odometry { double x, y, theta; float v[2]; };
//   DSSM_DESCRIBE(Odometry, x, y, theta, v)
//
// Write the line in the struct's namespace, after the struct; it lists up to 64 members. The type's
// name is the first argument without namespaces, so that programs which have the struct in
// different namespaces use one name. A member may be an arithmetic type, an enum, an array or
// std::array of them, or another described struct. For a class with private members write what the
// macro generates: a function `dssm::TypeInfo dssm_describe(const T*)` in the class's namespace.
//
//   threads  any
#pragma once

#include <array>
#include <cstddef>
#include <dssm/stream.hpp>
#include <type_traits>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// A type that a sample may have: trivially copyable, aligned to at most 64 bytes (a cache line).
template <class T>
concept Payload = std::is_trivially_copyable_v<T> && !std::is_const_v<T> && alignof(T) <= 64;

template <class T>
concept Described = requires(const T* null) {
  { dssm_describe(null) } -> std::same_as<TypeInfo>;
};

namespace detail {

// T's name as the compiler prints it, e.g. "nav::Odometry".
template <class T>
std::string spelled_name() {
  std::string_view text =
      __PRETTY_FUNCTION__;  // "... [with T = nav::Odometry; ...]" or "[T = nav::Odometry]"
  text.remove_prefix(text.find("T = ") + 4);
  return std::string(text.substr(0, text.find_first_of(";]")));
}

template <class T>
consteval Scalar scalar_of() {
  if constexpr (std::is_enum_v<T>) {
    return scalar_of<std::underlying_type_t<T>>();
  } else if constexpr (std::is_same_v<T, bool>) {
    return Scalar::boolean;
  } else if constexpr (std::is_same_v<T, char>) {
    return Scalar::character;
  } else if constexpr (std::is_floating_point_v<T>) {
    static_assert(sizeof(T) == 4 || sizeof(T) == 8, "long double cannot be described: use double");
    return sizeof(T) == 4 ? Scalar::float32 : Scalar::float64;
  } else {
    constexpr bool kSigned = std::is_signed_v<T>;
    switch (sizeof(T)) {
      case 1:
        return kSigned ? Scalar::int8 : Scalar::uint8;
      case 2:
        return kSigned ? Scalar::int16 : Scalar::uint16;
      case 4:
        return kSigned ? Scalar::int32 : Scalar::uint32;
      default:
        return kSigned ? Scalar::int64 : Scalar::uint64;
    }
  }
}

// The number of macro arguments whose text this is: names, so no comma is inside of one.
consteval std::size_t arguments_in(std::string_view text) {
  std::size_t count = text.empty() ? 0 : 1;
  for (const char c : text) count += c == ',';
  return count;
}

template <class T>
struct ArrayOf {
  using Element = std::remove_cv_t<T>;
  static constexpr std::uint64_t kCount = 1;
};
template <class T, std::size_t N>
struct ArrayOf<T[N]> {
  using Element = typename ArrayOf<T>::Element;
  static constexpr std::uint64_t kCount = N * ArrayOf<T>::kCount;
};
template <class T, std::size_t N>
struct ArrayOf<std::array<T, N>> {
  using Element = typename ArrayOf<T>::Element;
  static constexpr std::uint64_t kCount = N * ArrayOf<T>::kCount;
};

// Appends member `name` of type Member at `offset_bytes` to `fields`.
template <class Member>
void append_field(std::vector<Field>& fields, const std::string& name, std::uint64_t offset_bytes) {
  using Element = typename ArrayOf<Member>::Element;
  constexpr std::uint64_t kCount = ArrayOf<Member>::kCount;
  if constexpr (std::is_arithmetic_v<Element> || std::is_enum_v<Element>) {
    fields.push_back({name, scalar_of<Element>(), offset_bytes, kCount, sizeof(Element)});
  } else {
    static_assert(Described<Element>, "this member's type needs a DSSM_DESCRIBE line of its own");
    const TypeInfo inner = dssm_describe(static_cast<const Element*>(nullptr));
    for (const Field& field : inner.fields) {
      if (kCount == 1) {
        fields.push_back({name + "." + field.name, field.kind, offset_bytes + field.offset_bytes,
                          field.count, field.stride_bytes, field.bits, field.first_bit});
      } else if (field.count == 1) {
        fields.push_back({name + "." + field.name, field.kind, offset_bytes + field.offset_bytes,
                          kCount, sizeof(Element), field.bits, field.first_bit});
      } else {  // arrays inside an array of structs have two strides: one field per struct
        for (std::uint64_t i = 0; i < kCount; ++i) {
          fields.push_back({name + "[" + std::to_string(i) + "]." + field.name, field.kind,
                            offset_bytes + i * sizeof(Element) + field.offset_bytes, field.count,
                            field.stride_bytes});
        }
      }
    }
  }
}

}  // namespace detail

// The TypeInfo of T: with the fields of its DSSM_DESCRIBE line, with one field "value" for an
// arithmetic type or an array of one, otherwise without fields.
template <Payload T>
TypeInfo type_of() {
  if constexpr (Described<T>) {
    return dssm_describe(static_cast<const T*>(nullptr));
  } else {
    TypeInfo type{detail::spelled_name<T>(), sizeof(T), alignof(T), {}};
    using Element = typename detail::ArrayOf<T>::Element;
    if constexpr (std::is_arithmetic_v<Element>) detail::append_field<T>(type.fields, "value", 0);
    return type;
  }
}

}  // namespace dssm
#pragma GCC visibility pop

// A loop over macro arguments: each rescan of its text expands one more step, and these are 85.
#define DSSM_DETAIL_PARENS ()
#define DSSM_DETAIL_EXPAND(...) \
  DSSM_DETAIL_EXPAND3(DSSM_DETAIL_EXPAND3(DSSM_DETAIL_EXPAND3(DSSM_DETAIL_EXPAND3(__VA_ARGS__))))
#define DSSM_DETAIL_EXPAND3(...) \
  DSSM_DETAIL_EXPAND2(DSSM_DETAIL_EXPAND2(DSSM_DETAIL_EXPAND2(DSSM_DETAIL_EXPAND2(__VA_ARGS__))))
#define DSSM_DETAIL_EXPAND2(...) \
  DSSM_DETAIL_EXPAND1(DSSM_DETAIL_EXPAND1(DSSM_DETAIL_EXPAND1(DSSM_DETAIL_EXPAND1(__VA_ARGS__))))
#define DSSM_DETAIL_EXPAND1(...) __VA_ARGS__
#define DSSM_DETAIL_FIELDS(...) __VA_OPT__(DSSM_DETAIL_EXPAND(DSSM_DETAIL_FIELD(__VA_ARGS__)))
#define DSSM_DETAIL_FIELD(member, ...)                                                  \
  ::dssm::detail::append_field<decltype(DssmSelf::member)>(dssm_type.fields, #member,   \
                                                           offsetof(DssmSelf, member)); \
  __VA_OPT__(DSSM_DETAIL_FIELD_AGAIN DSSM_DETAIL_PARENS(__VA_ARGS__))
#define DSSM_DETAIL_FIELD_AGAIN() DSSM_DETAIL_FIELD

#define DSSM_DESCRIBE(Type, ...)                                                              \
  [[maybe_unused]] inline ::dssm::TypeInfo dssm_describe(const Type*) {                       \
    static_assert(::dssm::detail::arguments_in(#__VA_ARGS__) <= 64,                           \
                  "DSSM_DESCRIBE takes up to 64 members: group some in a struct of its own"); \
    using DssmSelf = Type;                                                                    \
    ::dssm::TypeInfo dssm_type{#Type, sizeof(Type), alignof(Type), {}};                       \
    DSSM_DETAIL_FIELDS(__VA_ARGS__)                                                           \
    return dssm_type;                                                                         \
  }
