// SPDX-License-Identifier: Apache-2.0
//
// From a payload's bytes and its type's description to values by name. The description came with
// the stream, from a program that may have been wrong: readable_fields() checks every field against
// the payload's size, and the other functions here take only fields that passed.
#pragma once

#include <cstddef>
#include <dssm/stream.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// The fields of `type` when each of them lies inside the payload; none at all otherwise, because a
// description with one wrong field describes something else.
std::vector<Field> readable_fields_untrusted(const TypeInfo& type);

// Those of `fields` that `wanted` asks for, in the order of the payload. "pose" means the
// field pose and for all of pose.*; without any, all are wanted. Fails with invalid_argument,
// naming the fields there are.
Result<std::vector<Field>> select_fields(std::vector<Field> fields,
                                         const std::vector<std::string>& wanted);

// The field that `wanted` names, or the element of it: "pose.x", "ranges[3]". Empty: there is none.
struct FieldElement {
  Field field;
  std::optional<std::uint64_t> element;  // empty: the whole field
};
std::optional<FieldElement> find_field(const std::vector<Field>& fields, std::string_view wanted);

// Whether the field is text: an array of char without holes. It ends at its first zero byte.
bool is_text(const Field& field);
std::string text_of(std::span<const std::byte> payload, const Field& field);

// In these functions `payload` may be shorter than the stream's samples: it has fewer elements
// then.

// For people: 1.5, true, 'a', "text", [1, 2, 3]; of more than `shown` elements the first `shown`
// and how many are left out; "-" for one that the payload does not have.
std::string field_text(std::span<const std::byte> payload, const Field& field, std::size_t shown);

// The same for programs: a number, boolean, string, or an array of them, with all elements; null
// for one that the payload does not have.
Json field_json(std::span<const std::byte> payload, const Field& field);

// One element as in field_text(), but text and characters bare; empty when there is none.
std::string element_text(std::span<const std::byte> payload, const Field& field, std::uint64_t i);

// One element as a number, a boolean as 0 or 1, a character by its code; none when there is none.
std::optional<double> element_number(std::span<const std::byte> payload, const Field& field,
                                     std::uint64_t i);

}  // namespace dssm::ctl
