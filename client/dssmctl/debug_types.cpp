// SPDX-License-Identifier: Apache-2.0
//
// From DWARF to TypeInfo, with libdw. The file is not trusted: it may have been made to mislead,
// and its entries may refer to each other in circles. So each walk has a limit on its steps and
// depth, no function of libdw is used that follows references until they end (dwarf_peel_type,
// dwarf_aggregate_size), and what comes out passes TypeInfo::check().
//
// A first walk over all entries collects the candidates, by size or name, with all names that a
// type has: its own, and those of typedefs ("typedef struct { ... } Odometry" has no other one).
// Then the fields of these are listed. A program has a copy of a type for each of its sources;
// copies that are equal are one type.
#include "client/dssmctl/debug_types.hpp"

#include <dwarf.h>
#include <elf.h>
#include <elfutils/libdw.h>
#include <elfutils/libdwfl.h>
#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <optional>

#include "client/dssmctl/text.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::ctl {
namespace {

constexpr std::uint64_t kMaxEntries = 1U << 26;  // of a file; some seconds
constexpr std::uint64_t kMaxSteps = 1U << 20;    // to list the fields of a type
constexpr int kMaxTypeNesting = 32;
constexpr int kMaxQualifiers = 64;            // typedefs of typedefs
constexpr std::size_t kMaxCandidates = 4096;  // and as many types of streams
constexpr std::size_t kMaxLeftOut = 100;
constexpr std::size_t kMaxShownTypes = 20;

// --- entries of DWARF

std::string name_of(Dwarf_Die& die) {
  const char* const name = ::dwarf_diename(&die);
  return name != nullptr ? name : "";
}

std::optional<std::uint64_t> number(Dwarf_Die& die, unsigned attribute) {
  Dwarf_Attribute found;
  Dwarf_Word value = 0;
  if (::dwarf_attr_integrate(&die, attribute, &found) == nullptr ||
      ::dwarf_formudata(&found, &value) != 0) {
    return std::nullopt;
  }
  return value;
}

bool has(Dwarf_Die& die, unsigned attribute) {
  return ::dwarf_hasattr_integrate(&die, attribute) != 0;
}

std::optional<Dwarf_Die> reference(Dwarf_Die& die, unsigned attribute) {
  Dwarf_Attribute found;
  Dwarf_Die other;
  if (::dwarf_attr_integrate(&die, attribute, &found) == nullptr ||
      ::dwarf_formref_die(&found, &other) == nullptr) {
    return std::nullopt;
  }
  return other;
}

// What is left of a type without typedefs and qualifiers; nullopt: void, or damaged.
std::optional<Dwarf_Die> peeled(std::optional<Dwarf_Die> die) {
  for (int i = 0; die && i < kMaxQualifiers; ++i) {
    switch (::dwarf_tag(&*die)) {
      case DW_TAG_typedef:
      case DW_TAG_const_type:
      case DW_TAG_volatile_type:
      case DW_TAG_restrict_type:
      case DW_TAG_atomic_type:
        die = reference(*die, DW_AT_type);
        break;
      default:
        // With -fdebug-types-section a declaration refers to the type by its signature.
        if (!has(*die, DW_AT_signature)) return die;
        die = reference(*die, DW_AT_signature);
    }
  }
  return std::nullopt;
}

bool is_record(int tag) {
  return tag == DW_TAG_structure_type || tag == DW_TAG_class_type || tag == DW_TAG_union_type;
}

// Calls visit(child) for each child, until it returns false.
template <class Visit>
void for_each_child(Dwarf_Die& parent, std::uint64_t& steps, const Visit& visit) {
  Dwarf_Die child;
  if (::dwarf_child(&parent, &child) != 0) return;
  while (steps > 0 && visit(child)) {
    --steps;
    Dwarf_Die next;
    if (::dwarf_siblingof(&child, &next) != 0) return;
    child = next;
  }
}

// The elements of an array; nullopt: not known, as of the last member `int rest[]`.
std::optional<std::uint64_t> elements(Dwarf_Die& array, std::uint64_t& steps) {
  std::optional<std::uint64_t> all;
  for_each_child(array, steps, [&](Dwarf_Die& child) {
    if (::dwarf_tag(&child) != DW_TAG_subrange_type) return true;
    std::optional<std::uint64_t> count = number(child, DW_AT_count);
    if (const auto last = number(child, DW_AT_upper_bound); !count && last) count = *last + 1;
    all = count ? std::optional(all.value_or(1) * *count) : std::nullopt;
    if (all && *all > kMaxPayloadBytes) all = std::nullopt;
    return all.has_value();
  });
  return all;
}

// [bytes]; nullopt: not known.
std::optional<std::uint64_t> size_of(const std::optional<Dwarf_Die>& type, std::uint64_t& steps,
                                     int depth = 0) {
  std::optional<Dwarf_Die> die = peeled(type);
  if (!die || depth > kMaxTypeNesting) return std::nullopt;
  std::optional<std::uint64_t> bytes;
  if (::dwarf_tag(&*die) == DW_TAG_array_type) {
    const auto count = elements(*die, steps);
    const auto each = size_of(reference(*die, DW_AT_type), steps, depth + 1);
    if (count && each) bytes = *count * *each;
  } else {
    bytes = number(*die, DW_AT_byte_size);
  }
  return bytes && *bytes <= kMaxPayloadBytes ? bytes : std::nullopt;
}

// --- fields

Scalar integer(std::uint64_t bytes, bool is_signed) {
  const auto at = static_cast<std::size_t>(std::countr_zero(bytes));
  constexpr std::array kSigned = {Scalar::int8, Scalar::int16, Scalar::int32, Scalar::int64};
  constexpr std::array kUnsigned = {Scalar::uint8, Scalar::uint16, Scalar::uint32, Scalar::uint64};
  return is_signed ? kSigned.at(at) : kUnsigned.at(at);
}

bool is_signed(Scalar kind) {
  return kind == Scalar::int8 || kind == Scalar::int16 || kind == Scalar::int32 ||
         kind == Scalar::int64;
}

// "points" and "x" are "points.x"; an index, or the reason in a note, follows without a dot.
std::string joined(const std::string& name, const std::string& inner) {
  const bool needs_dot = !name.empty() && !inner.empty() && inner[0] != '[' && inner[0] != ' ';
  return name + (needs_dot ? "." : "") + inner;
}

// Lists the fields of one type.
class FieldLister {
 public:
  std::vector<std::string> left_out;

  TypeInfo list(Dwarf_Die& die, std::uint64_t bytes) {
    TypeInfo type;
    type.payload_bytes = bytes;
    if (is_record(::dwarf_tag(&die))) {
      add_members(type.fields, "", die, 0, 0);
    } else {
      add(type.fields, "value", die, 0, 0);
    }
    // Alignment is not in DWARF, unless by alignas: a packed struct has members in odd places.
    const bool is_possible = std::has_single_bit(alignment_) && alignment_ <= 64 &&
                             bytes % alignment_ == 0 && !is_packed_;
    type.alignment_bytes = is_possible ? static_cast<std::uint32_t>(alignment_) : 1;
    return type;
  }

 private:
  using Fields = std::vector<Field>;

  void leave_out(const std::string& name, std::string_view why) {
    if (left_out.size() < kMaxLeftOut) left_out.push_back(fmt::format("{} ({})", name, why));
  }

  void push(Fields& out, Field field) {
    is_full_ = is_full_ || out.size() >= kMaxFields;
    if (!is_full_) out.push_back(std::move(field));
  }

  void align(std::uint64_t bytes, std::uint64_t offset) {
    alignment_ = std::max(alignment_, bytes);
    is_packed_ = is_packed_ || (bytes > 0 && offset % bytes != 0);
  }

  static std::optional<Scalar> scalar(Dwarf_Die& type, std::uint64_t bytes) {
    if (!std::has_single_bit(bytes) || bytes > 8) return std::nullopt;
    if (::dwarf_tag(&type) == DW_TAG_enumeration_type) {
      std::optional<Dwarf_Die> underlying = peeled(reference(type, DW_AT_type));
      if (underlying && ::dwarf_tag(&*underlying) == DW_TAG_base_type) {
        return scalar(*underlying, bytes);
      }
      return integer(bytes, number(type, DW_AT_encoding) == std::uint64_t{DW_ATE_signed});
    }
    const std::string name = name_of(type);
    switch (number(type, DW_AT_encoding).value_or(0)) {
      case DW_ATE_boolean:
        return bytes == 1 ? Scalar::boolean : integer(bytes, false);
      case DW_ATE_signed_char:
      case DW_ATE_unsigned_char:
        if (name == "char") return Scalar::character;
        return integer(bytes, number(type, DW_AT_encoding) == std::uint64_t{DW_ATE_signed_char});
      case DW_ATE_signed:
        return integer(bytes, true);
      case DW_ATE_unsigned:
      case DW_ATE_UTF:
        return integer(bytes, false);
      case DW_ATE_float:
        if (bytes == 4) return Scalar::float32;
        return bytes == 8 ? std::optional(Scalar::float64) : std::nullopt;
      default:
        return std::nullopt;
    }
  }

  void add(Fields& out, const std::string& name, const std::optional<Dwarf_Die>& type,
           std::uint64_t offset, int depth) {
    std::optional<Dwarf_Die> die = peeled(type);
    if (!die) return leave_out(name, "its type is not in the debug information");
    if (steps_ == 0 || depth > kMaxTypeNesting) return leave_out(name, "nested too deeply");
    --steps_;
    const std::uint64_t bytes = number(*die, DW_AT_byte_size).value_or(0);
    switch (::dwarf_tag(&*die)) {
      case DW_TAG_base_type:
      case DW_TAG_enumeration_type: {
        align(std::bit_floor(bytes), offset);
        const std::optional<Scalar> kind = scalar(*die, bytes);
        if (!kind)
          return leave_out(name, fmt::format("{} of {}", name_of(*die), bytes_text(bytes)));
        return push(out, {name, *kind, offset, 1, bytes});
      }
      case DW_TAG_array_type:
        return add_array(out, name, *die, offset, depth);
      case DW_TAG_structure_type:
      case DW_TAG_class_type:
      case DW_TAG_union_type:
        return add_members(out, name, *die, offset, depth);
      case DW_TAG_pointer_type:
      case DW_TAG_reference_type:
      case DW_TAG_rvalue_reference_type:
      case DW_TAG_ptr_to_member_type:
        align(sizeof(void*), offset);
        return leave_out(name, "a pointer");
      default:
        return leave_out(name, "a type without fields");
    }
  }

  void add_array(Fields& out, const std::string& name, Dwarf_Die& array, std::uint64_t offset,
                 int depth) {
    const std::optional<std::uint64_t> count = elements(array, steps_);
    const std::optional<Dwarf_Die> element = reference(array, DW_AT_type);
    const std::optional<std::uint64_t> stride = size_of(element, steps_);
    if (!count || *count == 0 || !stride || *stride == 0) {
      return leave_out(name, "an array without a length");
    }
    const std::size_t mark = left_out.size();
    Fields inner;
    add(inner, "", element, 0, depth + 1);
    for (std::size_t i = mark; i < left_out.size(); ++i) left_out[i] = joined(name, left_out[i]);
    for (Field& field : inner) {
      align(scalar_bytes(field.kind), offset + field.offset_bytes);
      const std::string full = joined(name, field.name);
      const bool is_row = field.name.empty() && field.count * field.stride_bytes == *stride;
      field.offset_bytes += offset;
      if (*count == 1 || field.count == 1 || is_row) {
        if (*count > 1 && !is_row) field.stride_bytes = *stride;
        field.count *= *count;
        field.name = full;
        push(out, field);
        continue;
      }
      // Arrays inside an array of structs have two strides: one field per struct.
      for (std::uint64_t i = 0; i < *count && !is_full_; ++i) {
        Field one = field;
        one.name = joined(fmt::format("{}[{}]", name, i), field.name);
        one.offset_bytes += i * *stride;
        push(out, std::move(one));
      }
    }
  }

  // The members of a struct, or those of a base class or an anonymous struct in it.
  void add_members(Fields& out, const std::string& name, Dwarf_Die& record, std::uint64_t offset,
                   int depth) {
    const bool is_array = name_of(record).starts_with("array<");  // std::array
    const std::uint64_t record_bytes = number(record, DW_AT_byte_size).value_or(0);
    alignment_ = std::max(alignment_, number(record, DW_AT_alignment).value_or(1));
    for_each_child(record, steps_, [&](Dwarf_Die& member) {
      const int tag = ::dwarf_tag(&member);
      const bool is_static = has(member, DW_AT_external) || has(member, DW_AT_declaration);
      if ((tag != DW_TAG_member && tag != DW_TAG_inheritance) || is_static) return true;
      const std::string own = name_of(member);
      const bool is_element = is_array && own == "_M_elems";
      const std::string full = is_element ? name : joined(name, own);
      const std::optional<Dwarf_Die> type = reference(member, DW_AT_type);
      const std::optional<std::uint64_t> place = place_of(member);
      alignment_ = std::max(alignment_, number(member, DW_AT_alignment).value_or(1));
      if (tag == DW_TAG_inheritance && has(member, DW_AT_virtuality)) {
        std::optional<Dwarf_Die> base = type;
        leave_out(joined(name, base ? name_of(*base) : ""), "a virtual base class");
      } else if (!place) {
        leave_out(full, "its place is not a number");
      } else if (has(member, DW_AT_artificial)) {
        align(sizeof(void*), offset + *place);  // the pointer to virtual functions
      } else if (has(member, DW_AT_bit_size)) {
        add_bits(out, full, member, type, offset, record_bytes);
      } else {
        const std::size_t mark = out.size();
        add(out, full, type, offset + *place, depth + 1);
        if (is_full_ && depth == 0) replace_by_bytes(out, mark, full, type, offset + *place);
      }
      return !is_full_;
    });
  }

  // What takes more fields than a type may have.
  void replace_by_bytes(Fields& out, std::size_t mark, const std::string& name,
                        const std::optional<Dwarf_Die>& type, std::uint64_t offset) {
    const std::optional<std::uint64_t> bytes = size_of(type, steps_);
    out.resize(std::min(mark, out.size()));
    if (out.size() == kMaxFields || !bytes || *bytes == 0) {
      return leave_out(name, fmt::format("a type has at most {} fields", kMaxFields));
    }
    is_full_ = false;
    out.push_back({name, Scalar::uint8, offset, *bytes, 1});
    leave_out(name, fmt::format("as bytes: a type has at most {} fields", kMaxFields));
  }

  // Of a member or base class in its struct; 0 in a union.
  static std::optional<std::uint64_t> place_of(Dwarf_Die& member) {
    std::optional<std::uint64_t> place = 0;
    if (has(member, DW_AT_data_member_location)) {
      place = number(member, DW_AT_data_member_location);
      Dwarf_Attribute attribute;
      Dwarf_Op* operations = nullptr;
      std::size_t count = 0;
      // Of old compilers.
      if (!place &&
          ::dwarf_attr_integrate(&member, DW_AT_data_member_location, &attribute) != nullptr &&
          ::dwarf_getlocation(&attribute, &operations, &count) == 0 && count == 1 &&
          operations[0].atom == DW_OP_plus_uconst) {
        place = operations[0].number;
      }
    }
    return place && *place <= kMaxPayloadBytes ? place : std::nullopt;
  }

  void add_bits(Fields& out, const std::string& name, Dwarf_Die& member,
                const std::optional<Dwarf_Die>& type, std::uint64_t offset,
                std::uint64_t record_bytes) {
    std::optional<Dwarf_Die> die = peeled(type);
    const std::uint64_t bits = number(member, DW_AT_bit_size).value_or(0);
    const std::uint64_t type_bytes = size_of(die, steps_).value_or(0);
    const Scalar none{};
    const Scalar kind = die ? scalar(*die, type_bytes).value_or(none) : none;
    const std::optional<std::uint64_t> first = first_bit(member, bits, type_bytes);
    if (kind == none || !first || bits == 0 || bits > 64)
      return leave_out(name, "a damaged bit field");
    align(type_bytes, offset);
    // The smallest integer that has them all, inside the struct.
    const std::uint64_t needed = (*first % 8 + bits + 7) / 8;
    const std::uint64_t bytes = std::bit_ceil(needed);
    if (bytes > 8 || bytes > record_bytes) return leave_out(name, "a bit field in nine bytes");
    const std::uint64_t place = std::min(*first / 8, record_bytes - bytes);
    const bool is_bool = kind == Scalar::boolean && bytes == 1;
    push(out,
         {name, is_bool ? Scalar::boolean : integer(bytes, is_signed(kind)), offset + place, 1,
          bytes, static_cast<std::uint8_t>(bits), static_cast<std::uint8_t>(*first - 8 * place)});
  }

  // In its struct, from the least significant bit of its first byte on.
  static std::optional<std::uint64_t> first_bit(Dwarf_Die& member, std::uint64_t bits,
                                                std::uint64_t type_bytes) {
    std::optional<std::uint64_t> first = number(member, DW_AT_data_bit_offset);
    if (!first) {
      const std::optional<std::uint64_t> place = place_of(member);
      first = place ? std::optional(8 * *place) : std::nullopt;
      // Until DWARF 3: from the most significant bit on, of an integer that lies at `place`.
      if (const auto from_top = number(member, DW_AT_bit_offset); first && from_top) {
        const std::uint64_t end =
            8 * (*place + number(member, DW_AT_byte_size).value_or(type_bytes));
        if (*from_top > end || bits > end - *from_top) return std::nullopt;
        first = end - *from_top - bits;
      }
    }
    return first && *first <= 8 * kMaxPayloadBytes ? first : std::nullopt;
  }

  std::uint64_t steps_ = kMaxSteps;
  std::uint64_t alignment_ = 1;
  bool is_packed_ = false;
  bool is_full_ = false;
};

// --- a file

struct Candidate {
  Dwarf_Die die;
  std::vector<std::string> names;  // its own first
  bool is_stream_type = false;
};

// Whether a type `full_name` is what `wanted` means: with or without its namespaces.
bool is_named(std::string_view full_name, std::string_view wanted) {
  if (!full_name.ends_with(wanted) || wanted.empty()) return false;
  full_name.remove_suffix(wanted.size());
  return full_name.empty() || full_name.ends_with("::");
}

// Their first argument is the type of a stream's samples.
bool is_stream_class(std::string_view name) {
  return std::ranges::any_of(std::array{"SSMApi<", "SSMPApi<", "DSSMApi<", "PConnectorClient<"},
                             [&](std::string_view one) { return name.starts_with(one); });
}

class TypeFinder {
 public:
  TypeFinder(const std::string& type_name, std::uint64_t payload_bytes)
      : type_name_(type_name), payload_bytes_(payload_bytes) {}

  bool has_types = false;
  bool has_more = false;  // candidates than are kept
  std::map<const void*, Candidate> candidates;

  void walk(Dwarf_Die& parent, const std::string& scope, int depth) {
    if (depth > kMaxTypeNesting) return;
    for_each_child(parent, steps_, [&](Dwarf_Die& child) {
      const int tag = ::dwarf_tag(&child);
      switch (tag) {
        case DW_TAG_namespace:
        case DW_TAG_subprogram:
        case DW_TAG_lexical_block: {
          const std::string name = tag == DW_TAG_namespace ? name_of(child) : "";
          walk(child, name.empty() ? scope : scope + name + "::", depth + 1);
          break;
        }
        case DW_TAG_structure_type:
        case DW_TAG_class_type:
        case DW_TAG_union_type: {
          const std::string name = name_of(child);
          const std::string full_name = name.empty() ? "" : full_name_of(child, scope + name);
          if (is_stream_class(name)) add_stream_type(child);
          add(child, full_name);
          if (!name.empty()) walk(child, full_name + "::", depth + 1);
          break;
        }
        case DW_TAG_typedef:
          add(child, scope + name_of(child));
          break;
        case DW_TAG_base_type:
          has_types = true;
          if (is_named(name_of(child), type_name_)) add(child, name_of(child));
          break;
        default:
          break;
      }
      return true;
    });
  }

 private:
  // A struct that is declared in one place and defined in another has its scope in the first one.
  std::string full_name_of(Dwarf_Die& record, std::string full_name) {
    if (::dwarf_hasattr(&record, DW_AT_declaration) != 0) declared_[record.addr] = full_name;
    if (const auto declaration = reference(record, DW_AT_specification)) {
      const auto declared = declared_.find(declaration->addr);
      if (declared != declared_.end()) return declared->second;
    }
    return full_name;
  }

  void add(const Dwarf_Die& named, const std::string& name, bool is_stream_type = false) {
    std::optional<Dwarf_Die> die = peeled(named);
    if (!die || ::dwarf_hasattr(&*die, DW_AT_declaration) != 0) return;
    const bool is_typedef = die->addr != named.addr;
    // A typedef is another name of a struct or of an array, not of a number.
    const int tag = ::dwarf_tag(&*die);
    if (is_typedef && !is_record(tag) && tag != DW_TAG_array_type && type_name_.empty()) {
      return;
    }
    has_types = true;
    const bool is_wanted = type_name_.empty()
                               ? size_of(die, steps_) == std::optional(payload_bytes_)
                               : is_named(name, type_name_);
    if (!is_wanted) return;
    const auto [place, is_new] = candidates.try_emplace(die->addr, Candidate{*die, {}});
    if (is_new && candidates.size() > (is_stream_type ? 2 : 1) * kMaxCandidates) {
      candidates.erase(place);
      has_more = true;
      return;
    }
    Candidate& one = place->second;
    one.is_stream_type |= is_stream_type;
    if (!name.empty()) one.names.insert(is_typedef ? one.names.end() : one.names.begin(), name);
  }

  void add_stream_type(Dwarf_Die& record) {
    for_each_child(record, steps_, [&](Dwarf_Die& child) {
      if (::dwarf_tag(&child) != DW_TAG_template_type_parameter) return true;
      if (std::optional<Dwarf_Die> type = reference(child, DW_AT_type);
          type && type_name_.empty()) {
        std::optional<Dwarf_Die> die = peeled(type);
        if (!die) return false;
        // The full name of a struct that is a candidate is known, or comes with its own entry.
        const bool is_known = is_record(::dwarf_tag(&*die)) && candidates.contains(die->addr);
        add(*die, is_known ? "" : name_of(*type), true);
      }
      return false;
    });
  }

  const std::string& type_name_;
  const std::uint64_t payload_bytes_;
  std::uint64_t steps_ = kMaxEntries;
  std::map<const void*, std::string> declared_;
};

// What an ELF file says of the machine that it is for.
struct Machine {
  unsigned char bits = 0, byte_order = 0;
  std::uint16_t number = 0;
  bool operator==(const Machine&) const = default;
};

std::optional<Machine> machine_of(int fd) {
  Elf64_Ehdr head{};  // as far as it is needed here, that of 32 bits is the same
  constexpr std::size_t kNeeded = offsetof(Elf64_Ehdr, e_version);
  if (::pread(fd, &head, kNeeded, 0) != static_cast<ssize_t>(kNeeded) ||
      std::memcmp(head.e_ident, ELFMAG, SELFMAG) != 0) {
    return std::nullopt;
  }
  return Machine{head.e_ident[EI_CLASS], head.e_ident[EI_DATA], head.e_machine};
}

// Its name is what debug links are relative to: of /proc/PID/exe, that of the file.
std::string resolved(const std::string& path) {
  std::error_code error;
  const std::filesystem::path real = std::filesystem::canonical(path, error);
  return error ? path : real.string();
}

struct DwflEnd {
  void operator()(Dwfl* dwfl) const { ::dwfl_end(dwfl); }
};

// The name that people know the type by.
std::string best_name(const Candidate& one, const std::string& wanted) {
  const auto named = std::ranges::find_if(
      one.names, [&](const std::string& name) { return is_named(name, wanted); });
  if (named != one.names.end()) return *named;
  const auto is_public = [](const std::string& name) { return name[0] != '_'; };
  const auto found = std::ranges::find_if(one.names, is_public);
  if (found != one.names.end()) return *found;
  return one.names.empty() ? "" : one.names.front();
}

std::string without_namespaces(const std::string& full_name) {
  const std::size_t end = std::min(full_name.find('<'), full_name.size());
  const std::size_t colons = full_name.rfind("::", end);
  return colons == full_name.npos ? full_name : full_name.substr(colons + 2);
}

// Lower case, without what is neither a letter nor a digit: "spur_odometry" is "SpurOdometry".
std::string for_comparison(std::string_view name) {
  std::string text;
  for (const char c : name) {
    if (is_letter_or_digit(c)) text += static_cast<char>(c >= 'A' && c <= 'Z' ? c - 'A' + 'a' : c);
  }
  return text;
}

std::string names_of(const std::vector<DebugType>& types) {
  std::string text;
  for (std::size_t i = 0; i < std::min(types.size(), kMaxShownTypes); ++i) {
    text += fmt::format("{}'{}'", i == 0 ? "" : ", ", escaped(types[i].full_name));
  }
  if (types.size() > kMaxShownTypes) {
    text += fmt::format(" and {} more", types.size() - kMaxShownTypes);
  }
  return text;
}

}  // namespace

Result<std::vector<DebugType>> debug_types_untrusted(const std::string& path,
                                                     const std::string& type_name,
                                                     std::uint64_t payload_bytes) {
  const std::string what = fmt::format("read the types of '{}'", path);
  const auto failed = [&](Errc code, std::string_view reason) {
    return Error{code, fmt::format("{}: {}", what, reason)};
  };
  UniqueFd fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  if (!fd) {
    const int error = errno;
    Error not_opened = os_error(what, error);
    if (error == ENOENT) not_opened.code = Errc::not_found;
    return not_opened;
  }
  const UniqueFd own(::open("/proc/self/exe", O_RDONLY | O_CLOEXEC));
  const std::optional<Machine> machine = machine_of(fd.get());
  if (!machine) {
    return failed(Errc::invalid_argument,
                  "it is not an ELF file; give a program, a library or an object file");
  }
  if (own && machine != machine_of(own.get())) {
    return failed(Errc::invalid_argument,
                  "it is for another kind of machine, where structs may have another layout; "
                  "compile it for this one");
  }

  // Debug information is not to be fetched from the network.
  ::unsetenv("DEBUGINFOD_URLS");  // NOLINT(concurrency-mt-unsafe): no thread of dssmctl reads it
  const Dwfl_Callbacks callbacks = {.find_elf = ::dwfl_build_id_find_elf,
                                    .find_debuginfo = ::dwfl_standard_find_debuginfo,
                                    .section_address = ::dwfl_offline_section_address,
                                    .debuginfo_path = nullptr};
  const std::unique_ptr<Dwfl, DwflEnd> dwfl(::dwfl_begin(&callbacks));
  if (!dwfl) return failed(Errc::no_memory, ::dwfl_errmsg(-1));
  Dwfl_Module* const module =
      ::dwfl_report_offline(dwfl.get(), "", resolved(path).c_str(), fd.get());
  if (module == nullptr) return failed(Errc::protocol, ::dwfl_errmsg(-1));
  (void)fd.release();  // dwfl_end() closes it
  ::dwfl_report_end(dwfl.get(), nullptr, nullptr);
  Dwarf_Addr bias = 0;
  Dwarf* const dwarf = ::dwfl_module_getdwarf(module, &bias);
  constexpr const char* kNoTypes =
      "; compile it with -g, or install or give its separate debug file";
  if (dwarf == nullptr) {
    return failed(Errc::invalid_argument,
                  fmt::format("it has no debug information ({}){}", ::dwfl_errmsg(-1), kNoTypes));
  }

  TypeFinder finder(type_name, payload_bytes);
  Dwarf_CU *unit = nullptr, *next = nullptr;
  Dwarf_Die unit_die, split_die;
  std::uint8_t unit_type = 0;
  int status = 0;
  while ((status = ::dwarf_get_units(dwarf, unit, &next, nullptr, &unit_type, &unit_die,
                                     &split_die)) == 0) {
    unit = next;
    const bool is_split = unit_type == DW_UT_skeleton && split_die.addr != nullptr;
    finder.walk(is_split ? split_die : unit_die, "", 0);
  }
  if (status < 0 && finder.candidates.empty()) {
    return failed(Errc::protocol,
                  fmt::format("its debug information is damaged: {}", ::dwarf_errmsg(-1)));
  }
  if (!finder.has_types) {
    return failed(Errc::invalid_argument,
                  fmt::format("its debug information has no types (-g1){}", kNoTypes));
  }
  if (finder.has_more && std::ranges::none_of(finder.candidates, [](const auto& one) {
        return one.second.is_stream_type;
      })) {
    return failed(
        Errc::conflict,
        fmt::format("more than {} types in it {}; choose one with --type, and with its "
                    "namespace",
                    kMaxCandidates,
                    type_name.empty() ? fmt::format("have {}", bytes_text(payload_bytes))
                                      : fmt::format("are named '{}'", escaped(type_name))));
  }

  std::vector<DebugType> types;
  for (auto& [key, candidate] : finder.candidates) {
    std::uint64_t steps = kMaxSteps;
    DebugType found;
    found.full_name = best_name(candidate, type_name);
    found.is_stream_type = candidate.is_stream_type;
    FieldLister lister;
    found.type = lister.list(candidate.die, size_of(candidate.die, steps).value_or(0));
    found.type.name = without_namespaces(found.full_name);
    found.left_out = std::move(lister.left_out);
    if (!found.type.check()) continue;  // damaged, or nothing that a sample may be
    const auto same = std::ranges::find_if(types, [&](const DebugType& one) {
      return one.full_name == found.full_name && one.type == found.type;
    });
    if (same == types.end()) {
      types.push_back(std::move(found));
    } else {
      same->is_stream_type = same->is_stream_type || found.is_stream_type;
    }
  }
  std::ranges::sort(types, {}, &DebugType::full_name);
  return types;
}

bool is_named_alike(std::string_view type_name, std::string_view stream_name) {
  return for_comparison(type_name) == for_comparison(stream_name);
}

Result<DebugType> choose_type(std::vector<DebugType> types, const StreamInfo& stream,
                              const std::string& type_name, const std::string& path) {
  const std::string context = fmt::format("describe '{}' from '{}'", stream.id.str(), path);
  const auto failed = [&](Errc code, std::string_view reason) {
    return Error{code, fmt::format("{}: {}", context, reason)};
  };
  const std::uint64_t bytes = stream.type.payload_bytes;
  if (!type_name.empty()) {
    if (types.empty()) {
      return failed(Errc::not_found, fmt::format("it has no type '{}' in its debug information",
                                                 escaped(type_name)));
    }
    const TypeInfo first = types.front().type;
    std::erase_if(types, [&](const DebugType& one) { return one.type.payload_bytes != bytes; });
    if (types.empty()) {
      return failed(
          Errc::type_mismatch,
          fmt::format("'{}' has {} there, and the stream's samples have {}", escaped(type_name),
                      bytes_text(first.payload_bytes), bytes_text(bytes)));
    }
  } else {
    const auto keep_if_any = [&](const auto& is_wanted) {
      if (std::ranges::any_of(types, is_wanted)) std::erase_if(types, std::not_fn(is_wanted));
    };
    std::erase_if(types, [](const DebugType& one) {
      return !one.is_stream_type && (one.full_name.starts_with("std::") || one.full_name.empty() ||
                                     one.full_name.starts_with("__"));
    });
    keep_if_any([](const DebugType& one) { return one.is_stream_type; });
    if (types.size() > 1) {
      keep_if_any(
          [&](const DebugType& one) { return is_named_alike(one.type.name, stream.id.name); });
    }
    if (types.empty()) {
      return failed(Errc::not_found,
                    fmt::format("it has no type of {}, which samples of the stream have; is it "
                                "another program's stream?",
                                bytes_text(bytes)));
    }
  }
  if (types.size() > 1) {
    return failed(Errc::conflict,
                  fmt::format("several types fit: {}; choose one with --type", names_of(types)));
  }
  return std::move(types.front());
}

}  // namespace dssm::ctl
