// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/config_words.hpp"

#include <errno.h>
#include <fmt/format.h>
#include <toml++/toml.h>

#include <algorithm>
#include <fstream>
#include <sstream>
#include <string_view>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

constexpr std::string_view kPositional = "streams";

Error config_error(const std::string& path, const toml::source_region& where,
                   const std::string& what) {
  return {Errc::invalid_argument,
          fmt::format("configuration '{}', line {}: {}", path, where.begin.line, what)};
}

Result<void> add_word(const std::string& path, const std::string& key, const toml::node& value,
                      std::vector<std::string>& words) {
  std::string text;
  if (const auto* string = value.as_string()) {
    text = string->get();
  } else if (const auto* whole = value.as_integer()) {
    text = std::to_string(whole->get());
  } else if (const auto* real = value.as_floating_point()) {
    text = fmt::format("{}", real->get());
  } else {
    return config_error(path, value.source(),
                        fmt::format("the key '{}' takes text, a number, true, false, or an array "
                                    "of texts or numbers",
                                    escaped(key)));
  }
  std::string option = key;
  std::ranges::replace(option, '_', '-');
  words.push_back(key == kPositional ? text : fmt::format("--{}={}", option, text));
  return {};
}

}  // namespace

Result<std::vector<std::string>> config_words(const std::string& path) {
  std::ifstream file(path);
  std::stringstream content;
  if (file) content << file.rdbuf();
  if (!file || content.bad()) {
    const int error = errno;
    const Errc code = error == ENOENT   ? Errc::not_found
                      : error == EACCES ? Errc::no_permission
                                        : Errc::system;
    return Error{code, fmt::format("read configuration '{}': {}", path,
                                   std::generic_category().message(error))};
  }
  toml::table table;
  try {
    table = toml::parse(content.view());
  } catch (const toml::parse_error& error) {
    return config_error(path, error.source(), std::string(error.description()));
  }
  std::vector<std::string> words;
  for (const auto& [name, value] : table) {
    const std::string key(name.str());
    if (const auto* flag = value.as_boolean()) {
      std::string option = key;
      std::ranges::replace(option, '_', '-');
      if (flag->get()) words.push_back("--" + option);
    } else if (const auto* array = value.as_array()) {
      for (const toml::node& element : *array) DSSM_TRY(add_word(path, key, element, words));
    } else {
      DSSM_TRY(add_word(path, key, value, words));
    }
  }
  return words;
}

}  // namespace dssm::ctl
