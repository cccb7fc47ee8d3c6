# SPDX-License-Identifier: Apache-2.0
"""dssmd.service, dssmd.socket, dssm-record.service and dssm-view.service under a real systemd."""

import json
import pathlib
import socket
import statistics
import struct
import subprocess
import threading
import time
from collections.abc import Callable

from container import TIMEOUT_S, Container

SOCKET = "/run/dssm/dssmd.sock"
CONFIGURATION = "/etc/dssm/dssmd.conf"


def get(container: Container, url: str) -> str:
    """What a server answers in the container; empty: nothing."""
    program = "import sys, urllib.request as web; print(web.urlopen(sys.argv[1]).read().decode())"
    done = container.attempt("python3", "-c", program, url)
    return done.stdout if done.returncode == 0 else ""


class Clients:
    """Connect to dssmd's socket repeatedly, one after the other, inside the `with` block."""

    def __init__(self, container: Container) -> None:
        self._path = str(container.path(SOCKET))
        self._thread = threading.Thread(target=self._connect)
        self._end = False
        self.served = 0
        self.refused: list[OSError] = []

    def __enter__(self) -> "Clients":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end = True
        self._thread.join()

    def _connect(self) -> None:
        while not self._end:
            with socket.socket(socket.AF_UNIX) as client:
                try:
                    client.connect(self._path)
                    self.served += 1
                except OSError as error:
                    self.refused.append(error)

    def wait_for_refused(self) -> None:
        """Waits until a thousand more were refused."""
        enough = len(self.refused) + 1000
        wait_until(lambda: len(self.refused) >= enough, "clients are not refused")


def wait_until(condition: Callable[[], bool], otherwise: str) -> None:
    """Waits until `condition` is true; after a timeout, fails with `otherwise`."""
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end, otherwise
        time.sleep(0.02)


class ServiceTests:
    """The tests, in the order in which they must run."""

    def __init__(self, container: Container, debs: list[pathlib.Path]) -> None:
        self.container = container
        self.debs = debs

    def tests(self) -> list[tuple[str, Callable[[], None]]]:
        """Names and functions."""
        return [
            ("installing dssmd starts it, with its socket", self.install),
            ("clients never find a closed socket during crashes", self.crash),
            ("clients never find a closed socket during restarts", self.restart),
            ("clients never find a closed socket when dssmd hangs", self.hang),
            ("a reader on another host loses nothing when dssmd is restarted or killed", self.elsewhere),
            ("a stopped dssmd stays stopped, without its socket, although clients connect", self.stop),
            ("a dssmd that is stopped right after a crash stays stopped", self.stop_after_crash),
            ("a mistake in the configuration stops service and socket", self.mistake),
            ("the recorder records incidents, also after a restart of dssmd", self.record),
            ("a mistake in the recorder's configuration stops it", self.record_mistake),
            ("the view serves page and metrics on this PC only, as its own user", self.view),
            ("after a boot dssmd runs, and its socket was started first", self.boot),
            ("removing dssmd leaves neither service nor socket", self.remove),
        ]

    def show(self, unit: str, name: str) -> str:
        """A property of a unit."""
        return self.container.run("systemctl", "show", "--property", name, "--value", unit)

    def states(self) -> tuple[str, str]:
        """Of service and socket."""
        return self.show("dssmd.service", "ActiveState"), self.show("dssmd.socket", "ActiveState")

    def kill(self, signal: str) -> None:
        """Sends dssmd a signal."""
        self.container.run("systemctl", "kill", "--kill-who=main", f"--signal={signal}", "dssmd")

    def end_and_await_next(self, signal: str) -> None:
        """Returns when systemd has started the next dssmd."""
        old = self.show("dssmd.service", "MainPID")
        self.kill(signal)
        wait_until(lambda: self.show("dssmd.service", "MainPID") not in ("0", old)
                   and self.states() == ("active", "active"), f"no dssmd after SIG{signal}")

    def install(self) -> None:
        """Test."""
        self.container.install(self.debs)
        assert self.states() == ("active", "active"), self.states()
        # At most 1.4; systemd 252 takes the threshold in tenths.
        self.container.run("systemd-analyze", "security", "--threshold=14", "dssmd.service")

    def crash(self) -> None:
        """Test. Seven in a row, because systemd may stop units that start five times in 10 s."""
        with Clients(self.container) as clients:
            for signal in ("KILL", "ABRT", "TERM", "KILL", "KILL", "KILL", "KILL"):
                self.end_and_await_next(signal)
        assert clients.served and not clients.refused, clients.refused[:3]

    def restart(self) -> None:
        """Test."""
        with Clients(self.container) as clients:
            for _ in range(3):
                self.container.run("systemctl", "restart", "dssmd")
            self.container.run("systemctl", "daemon-reexec")
        assert clients.served and not clients.refused, clients.refused[:3]

    def hang(self) -> None:
        """Test. With a watchdog of half a second instead of 10 s."""
        drop_in = self.container.path("/run/systemd/system/dssmd.service.d/watchdog.conf")
        drop_in.parent.mkdir(parents=True)
        drop_in.write_text("[Service]\nWatchdogSec=500ms\n")
        self.container.run("systemctl", "daemon-reload")
        self.container.run("systemctl", "restart", "dssmd")
        with Clients(self.container) as clients:
            self.end_and_await_next("STOP")
        # Clients for which the socket's queue has no more space wait, too.
        assert clients.served and not clients.refused, clients.refused[:3]
        drop_in.unlink()
        self.container.run("systemctl", "daemon-reload")

    def elsewhere(self) -> None:
        """Test. The other host is a second dssmd here. Prints how long a sample was on its way at most."""
        run, other = self.container.run, "/run/dssm-other"
        log = self.container.root / "speed.log"  # of SSM, 2 minutes at 500 Hz
        log.write_bytes(b"speed 0 8 5000 0.002 1000 0\n" +
                        b"".join(struct.pack("<dd", 1000 + i * 0.002, i) for i in range(60_000)))
        run("systemd-run", "--unit=other", "dssmd", "--runtime-dir", other, "--name", "other", "--mdns=false",
            "--listen", "127.0.0.1:13777", "--peer", "127.0.0.1:13776")
        run("systemd-run", "--unit=writer", "dssmctl", "play", "/speed.log", "--now")
        asked = ("dssmctl", "--socket", f"{other}/dssmd.sock")
        wait_until(lambda: self.container.attempt(*asked, "hosts").returncode == 0, "the other dssmd does not answer")
        delays_ms = []
        for signal in ("", "", "", "KILL", "KILL", "KILL"):
            run(*asked, "clock", "--wait", "60")  # a busy PC takes some heartbeats to measure the pair
            with subprocess.Popen(
                    ["nsenter", f"--target={self.container.environment['DSSM_CONTAINER']}", "--all", "dssmctl",
                     "--socket", f"{other}/dssmd.sock", "--json", "delay", "speed", "--wait", "10", "-i", "2.5",
                     "-n", "1"],
                    env=self.container.environment, stdout=subprocess.PIPE, text=True) as reader:
                time.sleep(1)
                if signal:
                    self.end_and_await_next(signal)
                else:
                    run("systemctl", "restart", "dssmd")
                found = json.loads(reader.communicate()[0])
            delays_ms.append(found["delay_max_ns"] / 1e6)
            print(f"  | {'killed' if signal else 'restarted'}: a sample was on its way for up to"
                  f" {delays_ms[-1]:.0f} ms", flush=True)
            assert found["lost_samples"] == 0 and found["seen_samples"] > 500, found
        run("systemctl", "stop", "writer", "other")
        # Some 60 ms on an idle PC. Of a busy one, the median tells a new design from a busy moment.
        assert statistics.median(delays_ms) < 500, delays_ms

    def stop(self) -> None:
        """Test."""
        for _ in range(3):
            with Clients(self.container) as clients:
                self.container.run("systemctl", "stop", "dssmd")
                clients.wait_for_refused()
                assert self.states() == ("inactive", "inactive"), self.states()
            self.container.run("systemctl", "start", "dssmd")
            assert self.states() == ("active", "active"), self.states()

    def stop_after_crash(self) -> None:
        """Test."""
        with Clients(self.container) as clients:
            self.kill("KILL")
            self.container.run("systemctl", "stop", "dssmd")
            clients.wait_for_refused()
            assert "active" not in self.states(), self.states()
        self.container.run("systemctl", "start", "dssmd")

    def mistake(self) -> None:
        """Test."""
        file = self.container.path(CONFIGURATION)
        right = file.read_text()
        file.write_text("no_such_key = 1\n")
        with Clients(self.container) as clients:
            assert self.container.attempt("systemctl", "restart", "dssmd").returncode != 0
            clients.wait_for_refused()
            assert self.states() == ("failed", "inactive"), self.states()
        file.write_text(right)
        self.container.run("systemctl", "start", "dssmd")
        assert self.states() == ("active", "active"), self.states()

    def await_incident(self, name: str) -> pathlib.Path:
        """Triggers an incident until its file is there: one that has not ended would only be prolonged."""
        folder = self.container.path("/var/lib/dssm-record")
        wait_until(lambda: self.container.attempt("dssmctl", "trigger", name).returncode == 0
                   and list(folder.glob(f"incident_*_{name}*.mcap")), f"no incident '{name}'")
        return next(folder.glob(f"incident_*_{name}*.mcap"))

    def record(self) -> None:
        """Test."""
        assert self.show("dssm-record.service", "UnitFileState") == "disabled"
        assert self.show("dssm-record.service", "ActiveState") == "inactive"
        with self.container.path("/etc/dssm/record.conf").open("a") as file:
            file.write('after = "1ms"\nmin_interval = "0s"\n')
        self.container.run("systemctl", "enable", "--now", "dssm-record")
        file = self.await_incident("before")
        owner = self.container.run("stat", "--format=%a %U %G", f"/var/lib/dssm-record/{file.name}")
        assert owner == "640 dssm-record dssm", owner
        recorder = self.show("dssm-record.service", "MainPID")
        self.container.run("systemctl", "restart", "dssmd")
        self.await_incident("after")
        assert self.show("dssm-record.service", "MainPID") == recorder
        self.container.run("systemctl", "kill", "--signal=KILL", "dssm-record")
        wait_until(lambda: self.show("dssm-record.service", "MainPID") not in ("0", recorder),
                   "it is not started again")
        self.await_incident("last")
        recorder = self.show("dssm-record.service", "MainPID")
        deb = next(deb.name for deb in self.debs if deb.name.startswith("dssm-record_"))
        self.container.run("apt-get", "install", "--yes", "--reinstall", f"/debs/{deb}")
        assert self.show("dssm-record.service", "MainPID") not in ("0", recorder)

    def record_mistake(self) -> None:
        """Test."""
        file = self.container.path("/etc/dssm/record.conf")
        right = file.read_text()
        file.write_text("no_such_key = 1\n")
        self.container.attempt("systemctl", "restart", "dssm-record")
        wait_until(lambda: self.show("dssm-record.service", "ActiveState") == "failed",
                   "it does not fail")
        assert self.show("dssm-record.service", "ExecMainStatus") == "2"
        file.write_text(right)
        self.container.run("systemctl", "disable", "dssm-record")

    def view(self) -> None:
        """Test."""
        assert self.show("dssm-view.service", "UnitFileState") == "disabled"
        assert self.show("dssm-view.service", "ActiveState") == "inactive"
        self.container.run("systemctl", "start", "dssm-view")
        wait_until(lambda: "dssm_host_up" in get(self.container, "http://127.0.0.1:8765/metrics"),
                   "there are no metrics")
        assert "<title>" in get(self.container, "http://127.0.0.1:8765/")
        assert not get(self.container, "http://10.77.0.2:8765/"), "it listens at other addresses, too"
        pid = self.show("dssm-view.service", "MainPID")
        assert self.container.run("stat", "--format=%U %G", f"/proc/{pid}") == "dssm-view dssm"
        saved = self.container.run("find", f"/proc/{pid}/root/var/tmp/", "-name", "dssm-view-*")
        assert saved, "it has no folder for what pages have saved"
        self.container.run("systemctl", "stop", "dssm-view")
        assert self.show("dssm-view.service", "Result") == "success"

    def boot(self) -> None:
        """Test."""
        self.container.power_off()
        self.container.boot()
        assert self.states() == ("active", "active"), self.states()
        began = {unit: int(self.show(unit, "ActiveEnterTimestampMonotonic"))
                 for unit in ("dssmd.socket", "sockets.target", "dssmd.service")}
        assert sorted(began, key=began.__getitem__) == list(began), began

    def remove(self) -> None:
        """Test."""
        self.container.run("systemctl", "start", "dssm-record")
        self.container.run("apt-get", "purge", "--yes", "dssmd")  # and with it what needs it
        assert self.show("dssm-record.service", "ActiveState") == "inactive"
        wait_until(lambda: self.states() == ("inactive", "inactive"), f"their states are {self.states()}")
