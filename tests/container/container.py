# SPDX-License-Identifier: Apache-2.0
"""A PC as a container: a real systemd 252 with its own file system, network and processes.

It shares kernel and clock with this machine, so chronyd runs there without setting the clock. The test
runs in new mount, pid and network namespaces, with which all its remains end.
"""

import contextlib
import os
import pathlib
import re
import secrets
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "packages"))

from tree import Unavailable, mount_overlay  # noqa: E402

# Installed at the start: the bare PC of a vehicle.
PACKAGES = "systemd,dbus,python3,sudo,nftables,procps"
# Packages that the role and the packages may install.
CACHED = "avahi-daemon chrony prometheus python3-apt"
TIMEOUT_S = 60.0  # for actions that take about a second

ADDRESSES = ("10.77.0.{}/24", "10.78.0.{}/24", "fd77::{}/64", "fd78::{}/64")


class Cgroups:
    """Control groups for the container, one in each hierarchy that systemd uses.

    Without them it would use those of this process, which other processes may use, too.
    """

    def __init__(self) -> None:
        """Creates them. Unavailable if this process may not."""
        self.folders: list[pathlib.Path] = []
        # Not the pid, which is 1 in each run, because a killed run leaves its groups. The same name in all
        # hierarchies, otherwise systemd-nspawn creates missing groups.
        name = f"dssm-container-{secrets.token_hex(4)}"
        for line in pathlib.Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            for root in self._roots(controllers):
                folder = root / group.lstrip("/") / name
                try:
                    folder.mkdir()
                except OSError as error:
                    raise Unavailable(f"control groups cannot be created here: {error}") from error
                self.folders.append(folder)

    @staticmethod
    def _roots(controllers: str) -> Iterator[pathlib.Path]:
        """The mount point of the hierarchy of these controllers, if systemd needs it."""
        kind = {"": "cgroup2", "name=systemd": "cgroup"}.get(controllers)
        for line in pathlib.Path("/proc/self/mounts").read_text().splitlines():
            _, mount_point, found, options, *_ = line.split(" ")
            if found == kind and (kind == "cgroup2" or controllers in options.split(",")):
                yield pathlib.Path(mount_point)
                return

    def enter(self) -> None:
        """Moves this process into them."""
        for folder in self.folders:
            (folder / "cgroup.procs").write_text(str(os.getpid()))

    def remove(self) -> None:
        """Removes them; no process may be in them."""
        for folder in self.folders:
            for below, _, _ in os.walk(folder, topdown=False):
                os.rmdir(below)


class Container:
    """A PC at 10.77.0.2, 10.78.0.2, fd77::2 and fd78::2. This process is at the .1 of each."""

    def __init__(self, bare: pathlib.Path, scratch: pathlib.Path, name: str) -> None:
        """Mounts its file system over the bare tree. Unavailable if this fails."""
        scratch.mkdir()
        self.name = name
        self._scratch = scratch
        self.root = mount_overlay(bare, scratch)
        self._leader = 0
        self._nspawn: subprocess.Popen[bytes] | None = None
        self._left = contextlib.ExitStack()
        self._left.callback(subprocess.run, ["umount", self.root], check=True)
        self._left.callback(self.power_off)
        self.at_end = self._left.callback  # registers functions to call at the end

    def __enter__(self) -> "Container":
        return self

    def __exit__(self, *_: object) -> None:
        self._left.close()

    def boot(self) -> None:
        """Returns when systemd has started all units. Unavailable if it cannot run here."""
        self._cgroups = Cgroups()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
            ready.bind(str(self._scratch / "ready"))
            ready.settimeout(TIMEOUT_S)
            log = (self._scratch / "log").open("w")
            self._nspawn = subprocess.Popen(
                ["systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--notify-ready=yes",
                 "--network-veth", f"--directory={self.root}", f"--machine={self.name}",
                 "--console=pipe", "--resolv-conf=off", "--boot"],
                env=os.environ | {"NOTIFY_SOCKET": str(self._scratch / "ready")},
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, preexec_fn=self._cgroups.enter)
            messages = ""
            try:
                while "READY=1" not in messages:
                    messages += ready.recv(4096).decode() + "\n"
            except TimeoutError:
                self.power_off()
                text = (self._scratch / "log").read_text()
                raise Unavailable(f"systemd does not start in a container here: {text}") from None
        (self._scratch / "ready").unlink()
        self._leader = int(re.search(r"^X_NSPAWN_LEADER_PID=([0-9]+)$", messages, re.MULTILINE)[1])
        device = f"ve-{self.name}"
        for number, ip in ((1, ["ip"]), (2, ["nsenter", f"--target={self._leader}", "--net", "ip"])):
            for address in ADDRESSES:
                # nodad: otherwise the address is unusable for the first seconds.
                subprocess.run([*ip, "address", "add", address.format(number), "dev",
                                device if number == 1 else "host0",
                                *(["nodad"] if ":" in address else [])], check=True)
            subprocess.run([*ip, "link", "set", device if number == 1 else "host0", "up"], check=True)

    def power_off(self) -> None:
        """Shuts it down if it runs."""
        if not self._nspawn:
            return
        nspawn, self._nspawn = self._nspawn, None
        nspawn.terminate()  # systemd-nspawn then shuts the container down
        try:
            nspawn.wait(TIMEOUT_S)
        finally:
            nspawn.kill()
            nspawn.wait()
        self._cgroups.remove()

    @property
    def environment(self) -> dict[str, str]:
        """The environment of `enter` and of programs in the container."""
        return {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin", "LC_ALL": "C.UTF-8",
                "DEBIAN_FRONTEND": "noninteractive", "DSSM_CONTAINER": str(self._leader)}

    def attempt(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Runs a program in the container; its output is in stdout."""
        return subprocess.run(["nsenter", f"--target={self._leader}", "--all", *words],
                              env=self.environment, stdin=subprocess.DEVNULL,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def run(self, *words: str) -> str:
        """Runs a program in the container and returns its output; a failure is an AssertionError."""
        done = self.attempt(*words)
        assert done.returncode == 0, f"{' '.join(words)}: {done.returncode}\n{done.stdout[-4000:]}"
        return done.stdout.strip()

    def path(self, name: str) -> pathlib.Path:
        """A file of the running container, also in its mounts, such as /run."""
        return pathlib.Path(f"/proc/{self._leader}/root") / name.lstrip("/")

    def install(self, debs: list[pathlib.Path]) -> None:
        """Installs packages with apt-get; their dependencies are in the apt cache."""
        folder = self.root / "debs"
        folder.mkdir()
        for deb in debs:
            shutil.copy(deb, folder)
        self.run("apt-get", "install", "--yes", "--no-install-recommends",
                 *(f"/debs/{deb.name}" for deb in debs))
