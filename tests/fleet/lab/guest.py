# SPDX-License-Identifier: Apache-2.0
"""One PC: a User Mode Linux process with its own kernel, clock, disk and systemd.

All host processes of a guest are in its own pid namespace. Killing the first process of that
namespace kills all of them at once, like a power loss.
"""

import hashlib
import os
import pathlib
import signal
import socket
import subprocess
import time

from lab.image import KERNEL, Image
from lab.network import guest_address, guest_name, tap
from lab.ssh import GuestError, Ssh

MEMORY = "384M"
BOOT_SECONDS = 180
BANNER_SECONDS = 20  # for the first bytes of sshd, even on a busy machine


class Guest:
    """Guest `number`; its files are in `folder`, which is in memory and removed with the lab."""

    def __init__(self, number: int, image: Image, preload: pathlib.Path, folder: pathlib.Path,
                 ssh_config: pathlib.Path) -> None:
        self.number = number
        self.name = guest_name(number)
        self.address = guest_address(number)
        self.folder = folder / self.name
        self.folder.mkdir()
        self.console = self.folder / "console"
        self.ssh = Ssh(self.name, ssh_config)
        self._image = image
        self._disk = self.folder / "disk"  # the differences to the image
        self._preload = preload
        self._process: subprocess.Popen[bytes] | None = None

    def power_on(self, cores: set[int]) -> None:
        """Starts the PC, on `cores` of this machine; await_running() waits for its boot."""
        machine_id = hashlib.md5(self.name.encode(), usedforsecurity=False).hexdigest()
        command = [
            "unshare", "--pid", "--fork", "--kill-child=SIGKILL", "--mount-proc",
            "env", f"LD_PRELOAD={self._preload}", str(KERNEL),
            f"mem={MEMORY}", f"ubd0={self._disk},{self._image.disk}", "root=/dev/ubda", "rw",
            "rootfstype=ext4", "con=null", "con0=null,fd:1", f"umid={self.name}", f"uml_dir={self.folder}",
            f"vec0:transport=tap,ifname={tap(self.number)},depth=128,gro=1",
            f"lab_address={self.address}", f"systemd.hostname={self.name}",
            f"systemd.machine_id={machine_id}", "quiet", "systemd.show_status=no",
            "random.trust_cpu=on", "net.ifnames=0",
        ]
        # UML keeps the guest's memory in a file of $TMPDIR.
        with self.console.open("ab") as console:
            self._process = subprocess.Popen(
                ["taskset", "--cpu-list", ",".join(map(str, cores)), *command],
                stdin=subprocess.DEVNULL, stdout=console, stderr=console,
                env={**os.environ, "TMPDIR": str(self.folder), "HOME": str(self.folder)})

    def power_off(self) -> None:
        """Cuts the power; the disk stays."""
        if self._process is None:
            return
        init = self._init()
        if init is None:
            self._process.kill()
        else:
            # The kernel ends a pid namespace's first process last.
            os.kill(init, signal.SIGKILL)
        self._process.wait()
        self._process = None
        self.ssh.close()

    def wipe(self) -> None:
        """Makes a switched-off PC bare again."""
        self._disk.unlink(missing_ok=True)

    def reboot(self, cores: set[int]) -> None:
        """Shuts the PC down and switches it on; call await_running() afterwards."""
        # A reboot by UML fails: it keeps its end of the cable open and then finds it in use.
        self.ssh.attempt("systemctl poweroff")
        assert self._process
        try:
            self._process.wait(BOOT_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise GuestError(f"{self.name}: 'systemctl poweroff' did not end it within {BOOT_SECONDS} s;"
                             f" its console says:\n{self.console_tail()}") from error
        self._process = None
        self.ssh.close()
        self.power_on(cores)

    def await_running(self, seconds: float = BOOT_SECONDS) -> None:
        """Waits until its systemd has started all units."""
        deadline = time.monotonic() + seconds
        while not self.answers():
            self._check_alive()
            if time.monotonic() > deadline:
                raise GuestError(f"{self.name}: no answer within {seconds:.0f} s; its console says:\n"
                                 f"{self.console_tail()}")
        state = self.ssh.attempt("systemctl is-system-running --wait", timeout=seconds)
        if state.returncode:
            failed = self.ssh.attempt("systemctl --failed --no-legend --plain").stdout
            raise GuestError(f"{self.name}: systemd says '{state.stdout.decode().strip()}' "
                             f"{state.stderr.decode().strip()}\n{failed.decode()}")

    def answers(self) -> bool:
        """Whether its sshd answers."""
        try:
            with socket.create_connection((self.address, 22), timeout=0.3) as connection:
                # It is up. Further attempts would only add to the load of a busy PC.
                connection.settimeout(BANNER_SECONDS)
                return connection.recv(4) == b"SSH-"
        except OSError:
            time.sleep(0.05)  # a refusal returns at once
            return False

    def pin(self, cores: set[int]) -> None:
        """Restricts the PC to these cores of this machine."""
        for pid in self._pids():
            for task in _numbers(f"/proc/{pid}/task"):
                try:
                    os.sched_setaffinity(task, cores)
                except ProcessLookupError:
                    pass

    def freeze(self) -> None:
        """Stops the PC; its connections stay open, and its clock goes on."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Continues a frozen PC."""
        self._signal(signal.SIGCONT)

    def sleep(self, times: int) -> int:
        """Suspends the PC so often: its oscillator stands still, and its wall clock is right afterwards. A User
        Mode Linux kernel wakes up at the first interrupt, mostly within 2 ms. Returns how often it slept."""
        done = "cat /sys/power/suspend_stats/success"
        before = int(self.ssh.run(done))
        self.ssh.run(f"for i in $(seq {times}); do echo mem > /sys/power/state; done")
        return int(self.ssh.run(done)) - before

    def console_tail(self) -> str:
        """The end of its kernel's output."""
        return self.console.read_bytes()[-3000:].decode(errors="replace")

    def _signal(self, number: int) -> None:
        # The kernel's process only: it traces the others, and panics when those are stopped.
        init = self._init()
        assert init
        os.kill(init, number)

    def _check_alive(self) -> None:
        if self._process is None or self._process.poll() is not None:
            raise GuestError(f"{self.name}: its kernel ended; its console says:\n{self.console_tail()}")

    def _init(self) -> int | None:
        """The pid, in our namespace, of the first process of the guest's pid namespace."""
        if self._process is None:
            return None
        pid = self._process.pid
        try:
            children = pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        except OSError:
            return None
        return int(children[0]) if children else None

    def _pids(self) -> list[int]:
        """All processes of the guest's pid namespace."""
        init = self._init()
        if init is None:
            return []
        namespace = os.readlink(f"/proc/{init}/ns/pid")
        found = []
        for pid in _numbers("/proc"):
            try:
                if os.readlink(f"/proc/{pid}/ns/pid") == namespace:
                    found.append(pid)
            except OSError:
                pass  # it just ended
        return found


def _numbers(folder: str) -> list[int]:
    try:
        return [int(name) for name in os.listdir(folder) if name.isdigit()]
    except FileNotFoundError:
        return []
