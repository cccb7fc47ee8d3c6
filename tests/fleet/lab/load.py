# SPDX-License-Identifier: Apache-2.0
"""Writers on guests, and readers that check every sample (fleet_load.cpp)."""

import json
import select
import subprocess
from collections.abc import Iterable
from typing import Any

from lab.guest import Guest
from lab.lab import TIMEOUT_SECONDS, await_that
from lab.packages import PROGRAMS_FOLDER
from lab.ssh import GuestError

RATE_HZ = 1000
FINISH_SECONDS = 120


class Load:
    """One fleet-load on a guest; runs until finish()."""

    def __init__(self, guest: Guest, mode: str, streams: Iterable[str], rate_hz: int = RATE_HZ,
                 prefix: str = "") -> None:
        """`prefix`: begins the command line, for example to run the command as another user."""
        self._guest = guest
        self._command = f"{prefix} {PROGRAMS_FOLDER}/fleet-load {mode} {rate_hz} {' '.join(streams)}"
        self._process = guest.ssh.start(self._command.strip())

    def await_ready(self) -> "Load":
        """Waits until it has written or read samples of each of its streams."""
        self._line()
        return self

    def moved(self) -> int:
        """The number of samples that it has written or read."""
        return int(self._ask())

    def ages_us(self) -> tuple[int, int]:
        """The median and the 99th percentile of the newest image's age since the last call ("look")."""
        median, p99 = self._ask().split()
        return int(median), int(p99)

    def await_more(self, samples: int) -> None:
        """Waits until it has written or read `samples` more."""
        wanted = self.moved() + samples
        await_that(f"{self._guest.name}: '{self._command}' reaches {wanted} samples",
                   lambda: ((moved := self.moved()) >= wanted, moved))

    def finish(self) -> dict[str, Any]:
        """Ends it, a reader after it has read all samples, and returns its result."""
        try:
            out, err = self._process.communicate(timeout=FINISH_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise self._error(f"did not end within {FINISH_SECONDS} s") from error
        if self._process.returncode:
            raise self._error(f"ended with {self._process.returncode}:\n{out}{err}")
        result: dict[str, Any] = json.loads(out.splitlines()[-1])
        return result

    def _ask(self) -> str:
        assert self._process.stdin
        self._process.stdin.write("?")
        self._process.stdin.flush()
        return self._line()

    def _line(self) -> str:
        assert self._process.stdout
        # Each request has one line as an answer, so the buffer is empty.
        if not select.select([self._process.stdout], [], [], TIMEOUT_SECONDS)[0]:
            raise self._error(f"printed nothing within {TIMEOUT_SECONDS} s")
        line = self._process.stdout.readline()
        if not line:
            self.finish()
            raise self._error("ended early")
        return line

    def _error(self, what: str) -> GuestError:
        return GuestError(f"{self._guest.name}: '{self._command}' {what}")


def print_silences(read: dict[str, Any], who: str) -> None:
    """Prints how long the streams brought nothing new, from 400 ms on."""
    for stream, silences in read["silences_ms"].items():
        print(f"  | {who}, '{stream}': silent for {', '.join(map(str, silences)) or 'less than 400'} ms", flush=True)


def expect_complete(written: dict[str, Any], read: dict[str, Any], who: str) -> None:
    """Checks that every written sample was read once, in order, untorn, and from the same ring."""
    assert not read["faults"], f"{who}: {read['faults']}"
    for stream, found in read["streams"].items():
        wanted = {"taken": written["written"][stream], "lost": 0, "restarts": 0}
        assert found == wanted, f"{who}, '{stream}': {found} instead of {wanted}"
