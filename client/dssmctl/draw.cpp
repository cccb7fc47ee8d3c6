// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/draw.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>

#include "core/base/unique_fd.hpp"

namespace dssm::ctl {

Result<void> draw(const std::string& file, std::vector<std::string> command,
                  const std::string& text, const std::string& install_hint) {
  int ends[2];
  if (::pipe2(ends, O_CLOEXEC)) return os_error("pipe2");
  UniqueFd from(ends[0]), to(ends[1]);
  std::vector<char*> argv;
  argv.reserve(command.size() + 1);
  for (std::string& word : command) argv.push_back(word.data());
  argv.push_back(nullptr);
  posix_spawn_file_actions_t actions;
  ::posix_spawn_file_actions_init(&actions);
  ::posix_spawn_file_actions_adddup2(&actions, from.get(), STDIN_FILENO);
  pid_t pid = -1;
  const int failed = ::posix_spawnp(&pid, argv[0], &actions, nullptr, argv.data(), environ);
  ::posix_spawn_file_actions_destroy(&actions);
  if (failed == ENOENT) {
    return Error{Errc::not_found, fmt::format("draw '{}': there is no program '{}' here; {}", file,
                                              command.front(), install_hint)};
  }
  if (failed) return os_error(fmt::format("run '{}'", command.front()), failed);
  from = UniqueFd();
  for (std::size_t done = 0; done < text.size();) {
    const ssize_t wrote = ::write(to.get(), text.data() + done, text.size() - done);
    if (wrote < 0 && errno != EINTR) break;  // it has ended
    if (wrote > 0) done += static_cast<std::size_t>(wrote);
  }
  to = UniqueFd();
  int status = 0;
  while (::waitpid(pid, &status, 0) < 0 && errno == EINTR) {
  }
  if (WIFEXITED(status) && WEXITSTATUS(status) == 0) return {};
  return Error{Errc::system,
               fmt::format("draw '{}': '{}' failed; see its message above", file, command.front())};
}

}  // namespace dssm::ctl
