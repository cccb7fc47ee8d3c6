// SPDX-License-Identifier: Apache-2.0
//
// What programs say when they create or name a stream, in DSSM's words.
#pragma once

#include <cstddef>
#include <dssm/stream.hpp>
#include <optional>
#include <string>
#include <string_view>

namespace dssm::ssm {

// "'lidar' [0]", as SSM's messages have it.
std::string quoted(std::string_view name, int id);

// "lidar@pc2" names a stream and its host; the limits of names are for what is before the '@'.
std::size_t name_length(const char* name) noexcept;
StreamId stream_id(const char* name, int id);

// Slots of a ring, before truncation.
double slots(double life, double cycle) noexcept;

// What is wrong with the arguments of createSSM; nothing when all is well.
std::optional<std::string> wrong_arguments(const char* name, int id, double life, double cycle);

// Of arguments that are not wrong.
History history_of(double life, double cycle) noexcept;

// The type of a stream of `bytes` per sample. A ring has at least one byte; streams without data
// say so by their type's name.
TypeInfo type_for(std::size_t bytes);

}  // namespace dssm::ssm
