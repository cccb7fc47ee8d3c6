# SPDX-License-Identifier: Apache-2.0
"""Runs commands on a guest, over one shared connection: a login costs a guest much more time."""

import contextlib
import pathlib
import shlex
import subprocess

from lab.image import Image


# ConnectTimeout includes the greeting of a guest that is still booting, on a busy machine. ServerAlive ends
# a connection to a guest that lost its power.
CONFIG = """\
Host *
  User root
  IdentityFile {key}
  UserKnownHostsFile {known_hosts}
  BatchMode yes
  ConnectTimeout 15
  LogLevel ERROR
  ControlMaster auto
  ControlPersist yes
  ControlPath {folder}/ssh-%h
  ServerAliveInterval 5
  ServerAliveCountMax 12
"""


def write_config(folder: pathlib.Path, image: Image, addresses: dict[str, str]) -> pathlib.Path:
    """Writes an ssh configuration file with the names of the guests."""
    config = folder / "ssh_config"
    hosts = "".join(f"Host {name}\n  HostName {address}\n" for name, address in addresses.items())
    config.write_text(hosts + CONFIG.format(key=image.ssh_key, known_hosts=image.known_hosts,
                                            folder=folder))
    return config


class GuestError(AssertionError):
    """A command on a guest failed; the text contains guest, command and output."""


class Ssh:
    """A connection as root to one guest, by its name in the file `config`. Threads may share it."""

    def __init__(self, name: str, config: pathlib.Path) -> None:
        self.name = name
        self._ssh = ["ssh", "-F", str(config)]
        self._started: list[tuple[str, subprocess.Popen[str]]] = []

    def words(self, command: str) -> list[str]:
        """The command line on this machine that runs the shell command `command` there."""
        return [*self._ssh, self.name, command]

    def attempt(self, command: str, *, stdin: bytes = b"", timeout: float = 120
                ) -> subprocess.CompletedProcess[bytes]:
        """Runs `command`; the caller checks the result."""
        try:
            return subprocess.run(self.words(command), input=stdin, capture_output=True,
                                  timeout=timeout, check=False)
        except subprocess.TimeoutExpired as error:
            output = (error.stdout or b"") + (error.stderr or b"")
            raise GuestError(f"{self.name}: '{command}' did not end within {timeout:.0f} s; its output:\n"
                             f"{output.decode(errors='replace')[-4000:]}") from error

    def run(self, command: str, *, stdin: bytes = b"", timeout: float = 120) -> str:
        """Runs `command` and returns its stdout; a status other than 0 is an error."""
        return self.read(command, stdin=stdin, timeout=timeout).decode(errors="replace")

    def read(self, command: str, *, stdin: bytes = b"", timeout: float = 120) -> bytes:
        """Like run(), with stdout as bytes."""
        done = self.attempt(command, stdin=stdin, timeout=timeout)
        if done.returncode:
            output = (done.stdout + done.stderr).decode(errors="replace")
            raise GuestError(f"{self.name}: '{command}' ended with {done.returncode}:\n{output[-4000:]}")
        return done.stdout

    def start(self, command: str) -> subprocess.Popen[str]:
        """Starts `command` and returns at once; the caller closes its stdin."""
        process = subprocess.Popen(self.words(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE, text=True)
        self._started.append((command, process))
        return process

    def abandon(self) -> list[str]:
        """Ends the connections to commands of start() that still run, and returns these commands."""
        running = [(command, process) for command, process in self._started if process.poll() is None]
        for _, process in running:
            process.kill()
            process.wait()
            # Without reading to the end: the shared connection keeps the pipes open while the command runs.
            for pipe in (process.stdin, process.stdout, process.stderr):
                with contextlib.suppress(BrokenPipeError):  # of unsent data
                    if pipe:
                        pipe.close()
        self._started.clear()
        return [command for command, _ in running]

    def put(self, files: list[pathlib.Path], folder: str) -> None:
        """Copies files and folders, with names and modes, into `folder` there."""
        where = shlex.quote(folder)
        pack = ["tar", "--create", "--owner=0", "--group=0"]
        for file in files:
            pack += ["-C", str(file.parent), file.name]
        packed = subprocess.run(pack, stdout=subprocess.PIPE, check=True).stdout
        self.run(f"mkdir -p {where} && tar -xf - -C {where}", stdin=packed)

    def close(self) -> None:
        """Ends the shared connection, as necessary when the guest ends; the next command opens a new one."""
        subprocess.run([*self._ssh, "-O", "exit", self.name], capture_output=True, check=False)
