// SPDX-License-Identifier: Apache-2.0
#include "client/recording/ros2_schema.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <span>
#include <utility>

#include "core/base/text.hpp"

namespace dssm::recording {
namespace {

constexpr std::uint64_t kMaxAlignment = 8;  // of CDR
constexpr int kMaxTypeNesting = 16;         // of nested types; deeper ones are bytes

char upper(char c) { return c >= 'a' && c <= 'z' ? static_cast<char>(c - 'a' + 'A') : c; }
char lower(char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; }

// As ROS 2 wants names of types: "nav_pose" -> "NavPose".
std::string type_name(std::string_view name) {
  std::string result;
  bool begins_word = true;
  for (const char c : name) {
    if (is_letter_or_digit(c)) result += begins_word ? upper(c) : c;
    begins_word = !is_letter_or_digit(c);
  }
  if (result.empty() || result[0] < 'A' || result[0] > 'Z') result.insert(0, "Type");
  return result;
}

// As ROS 2 wants names of fields: lower case, single '_' between letters and digits.
std::string field_name(std::string_view name) {
  std::string result;
  for (const char c : name) {
    if (is_letter_or_digit(c)) {
      result += lower(c);
    } else if (!result.empty() && result.back() != '_') {
      result += '_';
    }
  }
  while (!result.empty() && result.back() == '_') result.pop_back();
  if (result.empty() || result[0] < 'a' || result[0] > 'z') result.insert(0, "f");
  return result;
}

// `name`, or with the first number that makes it differ from all in `taken`.
std::string unique(std::set<std::string>& taken, const std::string& name) {
  std::string result = name;
  for (int i = 2; !taken.insert(result).second; ++i) result = name + std::to_string(i);
  return result;
}

std::string_view ros_name_of(Scalar kind) {
  return kind == Scalar::character ? "uint8" : name_of(kind);
}

// Of a field, without the names of the structs that it is in.
struct Member {
  std::string name;
  Scalar kind;
  std::uint64_t offset, count, stride;  // the offset in the message that holds it
  // Of an array in an array of structs; the others are the structs' then.
  std::uint64_t inner_count = 1, inner_stride = 0;
  bool is_bit_field = false;  // it has only some of its bits

  std::uint64_t scalar() const { return scalar_bytes(kind); }
  std::uint64_t first_end() const { return offset + (inner_count - 1) * inner_stride + scalar(); }
  std::uint64_t end() const { return first_end() + (count - 1) * stride; }
  bool is_packed() const {
    return !is_bit_field && inner_count == 1 && (count == 1 || stride == scalar());
  }
};

// An array in an array of structs is a field for each struct, "points[0].tag", "points[1].tag" ...
// Makes one of them, "points.tag".
std::vector<Member> with_joined_arrays(std::vector<Member> members) {
  std::map<std::string, std::size_t> by_name;
  for (std::size_t i = 0; i < members.size(); ++i) by_name.emplace(members[i].name, i);
  std::vector<bool> is_joined(members.size());
  std::vector<Member> result;
  for (std::size_t i = 0; i < members.size(); ++i) {
    Member member = members[i];
    const std::size_t at = member.name.find("[0].");
    if (is_joined[i]) continue;
    if (at != std::string::npos && at < member.name.find('.') && member.inner_count == 1) {
      const std::string base = member.name.substr(0, at), rest = member.name.substr(at + 3);
      std::vector<std::size_t> others;
      while (true) {
        const auto next = by_name.find(fmt::format("{}[{}]{}", base, others.size() + 1, rest));
        if (next == by_name.end() || is_joined[next->second]) break;
        const Member& other = members[next->second];
        const std::uint64_t before = others.empty() ? member.offset : members[others.back()].offset;
        const std::uint64_t stride =
            others.empty() ? other.offset - before : members[others[0]].offset - member.offset;
        if (other.kind != member.kind || other.count != member.count ||
            other.stride != member.stride || other.offset <= before ||
            other.offset - before != stride) {
          break;
        }
        others.push_back(next->second);
      }
      if (!others.empty()) {
        for (const std::size_t other : others) is_joined[other] = true;
        member.name = base + rest;
        member.inner_count = member.count;
        member.inner_stride = member.stride;
        member.count = others.size() + 1;
        member.stride = members[others[0]].offset - member.offset;
      }
    }
    result.push_back(std::move(member));
  }
  std::stable_sort(result.begin(), result.end(),
                   [](const Member& one, const Member& two) { return one.offset < two.offset; });
  return result;
}

class Generator {
 public:
  std::string run(const TypeInfo& type) {
    std::vector<Member> members;
    for (const Field& field : type.fields) {
      members.push_back({field.name, field.kind, field.offset_bytes, field.count,
                         field.stride_bytes, 1, 0, field.bits > 0});
    }
    const std::string name = type_name(type.name);
    types_.insert(name);
    std::string text = message(name, std::move(members), type.payload_bytes, kMaxAlignment, 0);
    return text + nested_;
  }

 private:
  // One message, and what it needs, which goes to nested_.
  struct Message {
    std::string text;
    std::set<std::string> names;
    std::uint64_t cursor = 0;  // where CDR is

    void add(std::string_view type, std::uint64_t count, std::string_view name) {
      const std::string ros = unique(names, field_name(name));
      text += fmt::format("{}{} {}{}\n", type, count == 1 ? "" : fmt::format("[{}]", count), ros,
                          ros == name ? "" : fmt::format("  # {}", printable(name)));
    }
    void add_bytes(std::uint64_t end, std::string_view name) {
      text += fmt::format("uint8[{}] {}  # {}\n", end - cursor, unique(names, field_name(name)),
                          printable(name));
      cursor = end;
    }
    void pad_to(std::uint64_t offset) {
      if (offset == cursor) return;
      text += fmt::format("uint8[{}] {}\n", offset - cursor, unique(names, "pad"));
      cursor = offset;
    }
  };

  //   bytes      of the message, to which it is padded unless it is the outermost one
  //   alignment  that each place has where it is
  std::string message(const std::string& name, std::vector<Member> members, std::uint64_t bytes,
                      std::uint64_t alignment, int depth) {
    members = with_joined_arrays(std::move(members));
    Message out;
    for (std::size_t i = 0; i < members.size();) {
      const std::string& first = members[i].name;
      const std::size_t dot = first.find('.');
      std::size_t end = i + 1;
      if (dot != first.npos) {
        while (end < members.size() &&
               members[end].name.compare(0, dot + 1, first, 0, dot + 1) == 0) {
          ++end;
        }
      }
      const std::span<const Member> group = std::span(members).subspan(i, end - i);
      // What follows, but for other names of the same bytes (a union).
      const std::uint64_t used = std::ranges::max_element(group, {}, &Member::end)->end();
      const auto next =
          std::ranges::find_if(members.begin() + static_cast<std::ptrdiff_t>(end), members.end(),
                               [&](const Member& member) { return member.offset >= used; });
      const std::uint64_t limit = next == members.end() ? bytes : next->offset;
      if (members[i].offset < out.cursor) {
        out.text += fmt::format("# {}: in the same bytes as another field\n", printable(first));
      } else if (dot == first.npos) {
        add_scalars(out, members[i], alignment);
      } else {
        add_struct(out, name, group, first.substr(0, dot), limit, alignment, depth);
      }
      i = end;
    }
    if (depth > 0) out.pad_to(bytes);
    return out.text;
  }

  static void add_scalars(Message& out, const Member& member, std::uint64_t alignment) {
    out.pad_to(member.offset);
    if (member.is_packed() && std::gcd(member.offset, alignment) % member.scalar() == 0) {
      out.add(ros_name_of(member.kind), member.count, member.name);
      out.cursor = member.end();
    } else {
      out.add_bytes(member.end(), member.name);
    }
  }

  // The fields of a struct, or of an array of structs: the bytes up to `limit` at most.
  void add_struct(Message& out, const std::string& parent, std::span<const Member> group,
                  const std::string& name, std::uint64_t limit, std::uint64_t alignment,
                  int depth) {
    std::uint64_t base = group.front().offset, count = group.front().count;
    const std::uint64_t stride = group.front().stride;
    std::uint64_t end = 0, element_end = 0;
    bool is_array = count > 1;
    for (const Member& member : group) {
      is_array = is_array && member.count == count && member.stride == stride;
      element_end = std::max(element_end, member.first_end());
      end = std::max(end, member.end());
    }
    is_array = is_array && element_end - base <= stride;
    std::uint64_t bytes = limit > base ? limit - base : 0;
    if (is_array) {
      bytes = stride;
      // The first field may not be the first member: then the structs begin earlier.
      if (base + count * bytes > limit && count * bytes <= limit) {
        base = std::min(base, limit - count * bytes);
      }
    } else {
      count = 1;
    }
    if (depth == kMaxTypeNesting || base < out.cursor || end > limit ||
        base + count * bytes > limit || (is_array && element_end - base > bytes)) {
      out.pad_to(group.front().offset);
      out.add_bytes(end, name);
      return;
    }
    std::vector<Member> inner;
    for (Member member : group) {
      member.name.erase(0, name.size() + 1);
      member.offset -= base;
      if (is_array) {
        member.count = std::exchange(member.inner_count, 1);
        member.stride = member.inner_stride;
      }
      inner.push_back(member);
    }
    alignment = std::gcd(base, alignment);
    if (is_array) alignment = std::gcd(bytes, alignment);
    const std::string type = unique(types_, parent + type_name(name));
    const std::string text = message(type, std::move(inner), bytes, alignment, depth + 1);
    nested_ += fmt::format("{:=<80}\nMSG: dssm/{}\n{}", "", type, text);
    out.pad_to(base);
    out.add("dssm/" + type, count, name);
    out.cursor = base + count * bytes;
  }

  std::set<std::string> types_;
  std::string nested_;
};

}  // namespace

Ros2Schema ros2_schema(const TypeInfo& type) {
  if (type.fields.empty()) return {"dssm/msg/Bytes", "uint8[] data\n"};
  return {"dssm/msg/" + type_name(type.name), Generator().run(type)};
}

}  // namespace dssm::recording
