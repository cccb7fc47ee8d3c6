// SPDX-License-Identifier: Apache-2.0
//
// Types of samples from the debug information (DWARF) of a program, a library, an object file or a
// separate debug file: for streams whose programs do not describe their types.
//
//   structs   nested ones are named with dots; members of base classes and of anonymous structs
//             have no prefix. An array of structs is as DSSM_DESCRIBE describes it
//   unions    all alternatives, which lie in the same bytes
//   enums     their integers
//   left out  what no field can say: pointers, references, long double, virtual base classes. A
//             member that would take more fields than a type may have is an array of bytes
#pragma once

#include <cstdint>
#include <dssm/stream.hpp>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::ctl {

struct DebugType {
  std::string full_name;  // "nav::Odometry"; that of `type` is without namespaces
  TypeInfo type;
  // Members that `type` does not have, each with the reason: "next (a pointer)".
  std::vector<std::string> left_out;
  bool is_stream_type = false;  // the T of an SSMApi<T, P> or of another class for a stream
};

// The types of `payload_bytes` bytes in a file, those that differ; or, with a name, all of that
// name, with or without its namespaces, also of another size. Finds separate debug files by build
// id and debug link, on this PC only.
//   path   of the file; /proc/PID/exe also works after the program's file was deleted
//   fails  not_found, no_permission, invalid_argument (not an ELF file, of another architecture,
//          without debug information or without types in it), protocol (damaged), conflict (more
//          types than it looks at, and none of them a stream's), system
//   threads  one at a time; changes the environment (DEBUGINFOD_URLS)
Result<std::vector<DebugType>> debug_types_untrusted(const std::string& path,
                                                     const std::string& type_name,
                                                     std::uint64_t payload_bytes);

// Whether a type is named like a stream: "spur_odometry" and "SpurOdometry".
bool is_named_alike(std::string_view type_name, std::string_view stream_name);

// The type that samples of `stream` have: the only one of `types`; of several a T of an SSMApi<T,
// P>, then one that is named like the stream ("spur_odometry": Spur_Odometry).
//   fails  not_found, type_mismatch (the named type has another size), conflict (several fit: names
//          them)
Result<DebugType> choose_type(std::vector<DebugType> types, const StreamInfo& stream,
                              const std::string& type_name, const std::string& path);

}  // namespace dssm::ctl
