# SPDX-License-Identifier: Apache-2.0
"""Writers and readers on guests whose every sample is checked (fleet_load.cpp)."""

import json
import select
import subprocess
from collections.abc import Iterable
from typing import Any

from lab.guest import Guest
from lab.lab import PATIENCE_SECONDS, await_that
from lab.packages import PROGRAMS_FOLDER
from lab.ssh import GuestError

RATE_HZ = 1000
FINISH_SECONDS = 120


class Load:
    """One fleet-load on a guest; runs until finish()."""

    def __init__(self, guest: Guest, mode: str, streams: Iterable[str], rate_hz: int = RATE_HZ,
                 prefix: str = "") -> None:
        """`prefix`: what stands before the command, to run it as another user say."""
        self._guest = guest
        self._command = f"{prefix} {PROGRAMS_FOLDER}/fleet-load {mode} {rate_hz} {' '.join(streams)}"
        self._process = guest.ssh.start(self._command.strip())

    def await_ready(self) -> "Load":
        """Waits until samples move in each of its streams."""
        self._line()
        return self

    def moved(self) -> int:
        """How many samples it has written or read until now."""
        assert self._process.stdin
        self._process.stdin.write("?")
        self._process.stdin.flush()
        return int(self._line())

    def await_more(self, samples: int) -> None:
        """Waits until it has written or read so many samples more than now."""
        wanted = self.moved() + samples
        await_that(f"{self._guest.name}: '{self._command}' comes to {wanted} samples",
                   lambda: ((moved := self.moved()) >= wanted, moved))

    def finish(self) -> dict[str, Any]:
        """Lets it come to its end, a reader when it has all, and returns what it found."""
        try:
            out, err = self._process.communicate(timeout=FINISH_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise self._error(f"did not come to its end within {FINISH_SECONDS} s") from error
        if self._process.returncode:
            raise self._error(f"ended with {self._process.returncode}:\n{out}{err}")
        result: dict[str, Any] = json.loads(out.splitlines()[-1])
        return result

    def _line(self) -> str:
        assert self._process.stdout
        # Each question has one line for an answer, so that none waits in the buffer already.
        if not select.select([self._process.stdout], [], [], PATIENCE_SECONDS)[0]:
            raise self._error(f"said nothing within {PATIENCE_SECONDS} s")
        line = self._process.stdout.readline()
        if not line:
            self.finish()
            raise self._error("ended by itself")
        return line

    def _error(self, what: str) -> GuestError:
        return GuestError(f"{self._guest.name}: '{self._command}' {what}")


def expect_complete(written: dict[str, Any], read: dict[str, Any], who: str) -> None:
    """Every sample that was written was read once, in order, untorn, and from one and the same ring."""
    assert not read["faults"], f"{who}: {read['faults']}"
    for stream, found in read["streams"].items():
        wanted = {"taken": written["written"][stream], "lost": 0, "restarts": 0}
        assert found == wanted, f"{who}, '{stream}': {found} instead of {wanted}"
