# SPDX-License-Identifier: Apache-2.0
"""Running commands on a guest, over one shared connection: a login costs a guest far more."""

import contextlib
import pathlib
import shlex
import subprocess

from lab.image import Image


# ServerAlive: a connection to a guest that lost its power ends by itself.
CONFIG = """\
Host *
  User root
  IdentityFile {key}
  UserKnownHostsFile {known_hosts}
  BatchMode yes
  ConnectTimeout 2
  LogLevel ERROR
  ControlMaster auto
  ControlPersist yes
  ControlPath {folder}/ssh-%h
  ServerAliveInterval 5
  ServerAliveCountMax 12
"""


def write_config(folder: pathlib.Path, image: Image, addresses: dict[str, str]) -> pathlib.Path:
    """A configuration file by which ssh, and whoever uses it, knows the guests by name."""
    config = folder / "ssh_config"
    hosts = "".join(f"Host {name}\n  HostName {address}\n" for name, address in addresses.items())
    config.write_text(hosts + CONFIG.format(key=image.ssh_key, known_hosts=image.known_hosts,
                                            folder=folder))
    return config


class GuestError(AssertionError):
    """A command on a guest ended otherwise than expected; the text holds guest, command, output."""


class Ssh:
    """root's connection to one guest, by its name in the file `config`. Threads may share it."""

    def __init__(self, name: str, config: pathlib.Path) -> None:
        self.name = name
        self._ssh = ["ssh", "-F", str(config)]
        self._started: list[tuple[str, subprocess.Popen[str]]] = []

    def words(self, command: str) -> list[str]:
        """The command line here that runs `command`, for a shell, there."""
        return [*self._ssh, self.name, command]

    def attempt(self, command: str, *, stdin: bytes = b"", timeout: float = 120
                ) -> subprocess.CompletedProcess[bytes]:
        """Runs `command`; whether it succeeded is the caller's to judge."""
        try:
            return subprocess.run(self.words(command), input=stdin, capture_output=True,
                                  timeout=timeout, check=False)
        except subprocess.TimeoutExpired as error:
            output = (error.stdout or b"") + (error.stderr or b"")
            raise GuestError(f"{self.name}: '{command}' did not end within {timeout:.0f} s; it said:\n"
                             f"{output.decode(errors='replace')[-4000:]}") from error

    def run(self, command: str, *, stdin: bytes = b"", timeout: float = 120) -> str:
        """Runs `command` and returns its stdout; anything but status 0 is an error."""
        return self.read(command, stdin=stdin, timeout=timeout).decode(errors="replace")

    def read(self, command: str, *, stdin: bytes = b"", timeout: float = 120) -> bytes:
        """As run(), with stdout as it is."""
        done = self.attempt(command, stdin=stdin, timeout=timeout)
        if done.returncode:
            output = (done.stdout + done.stderr).decode(errors="replace")
            raise GuestError(f"{self.name}: '{command}' ended with {done.returncode}:\n{output[-4000:]}")
        return done.stdout

    def start(self, command: str) -> subprocess.Popen[str]:
        """Starts `command` and returns at once; its stdin ends when the caller closes it."""
        process = subprocess.Popen(self.words(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE, text=True)
        self._started.append((command, process))
        return process

    def abandon(self) -> list[str]:
        """Ends the connections to what start() began and is still running, and returns what that is."""
        running = [(command, process) for command, process in self._started if process.poll() is None]
        for _, process in running:
            process.kill()
            process.wait()
            # Not until their end: the shared connection has them open as long as the command runs there.
            for pipe in (process.stdin, process.stdout, process.stderr):
                with contextlib.suppress(BrokenPipeError):  # of what was not yet sent
                    if pipe:
                        pipe.close()
        self._started.clear()
        return [command for command, _ in running]

    def put(self, files: list[pathlib.Path], folder: str) -> None:
        """Copies files and folders, names and modes kept, into `folder` there."""
        where = shlex.quote(folder)
        pack = ["tar", "--create", "--owner=0", "--group=0"]
        for file in files:
            pack += ["-C", str(file.parent), file.name]
        packed = subprocess.run(pack, stdout=subprocess.PIPE, check=True).stdout
        self.run(f"mkdir -p {where} && tar -xf - -C {where}", stdin=packed)

    def close(self) -> None:
        """Ends the shared connection, as must be after the guest's end; the next command opens one."""
        subprocess.run([*self._ssh, "-O", "exit", self.name], capture_output=True, check=False)
