// SPDX-License-Identifier: Apache-2.0
//
// DSSM_TRY: the value of a Result, or return its error from the enclosing function.
//
//   const Address address = DSSM_TRY(Address::parse(text));
//   DSSM_TRY(check_host_name(text));                                    // Result<void>
//   Stream stream = DSSM_TRY(Stream::open(id), "open '" + id.str() + "'");  // with context
//
// The context is evaluated only on failure. Use it as a statement, or as the whole value of a
// variable or of a single argument: on failure the rest of an expression around it stays half done
// (`new T(DSSM_TRY(...))` leaks the memory of T).
//
// Not for public headers: it is a statement expression,
// an extension of GCC and clang (https://gcc.gnu.org/onlinedocs/gcc/Statement-Exprs.html).
#pragma once

#include <dssm/result.hpp>
#include <string_view>
#include <type_traits>
#include <utility>

namespace dssm::detail {

template <class R>
auto take_value(R& result) {
  if constexpr (!std::is_void_v<typename R::value_type>) return *std::move(result);
}

inline Error try_error(Error error) { return error; }
inline Error try_error(Error error, std::string_view context) {
  return std::move(error).context(context);
}

}  // namespace dssm::detail

#define DSSM_TRY(expression, ...)                                         \
  __extension__({                                                         \
    auto dssm_try_result = (expression);                                  \
    if (!dssm_try_result) {                                               \
      return ::dssm::detail::try_error(                                   \
          std::move(dssm_try_result).error() __VA_OPT__(, ) __VA_ARGS__); \
    }                                                                     \
    ::dssm::detail::take_value(dssm_try_result);                          \
  })
