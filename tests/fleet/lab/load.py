# SPDX-License-Identifier: Apache-2.0
"""Writers and readers on guests whose every sample is checked (fleet_load.cpp)."""

import json
from collections.abc import Iterable
from typing import Any

from lab.guest import Guest
from lab.packages import PROGRAMS_FOLDER
from lab.ssh import GuestError

RATE_HZ = 1000


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
        assert self._process.stdout
        if self._process.stdout.readline() != "ready\n":
            self.finish()
            raise self._error("ended before it began")
        return self

    def finish(self) -> dict[str, Any]:
        """Lets it come to its end, a reader when it has all, and returns what it found."""
        out, err = self._process.communicate(timeout=120)
        if self._process.returncode:
            raise self._error(f"ended with {self._process.returncode}:\n{out}{err}")
        result: dict[str, Any] = json.loads(out.splitlines()[-1])
        return result

    def abandon(self) -> None:
        """Ends the connection to it, and it by that."""
        self._process.kill()
        self._process.communicate()

    def _error(self, what: str) -> GuestError:
        return GuestError(f"{self._guest.name}: '{self._command}' {what}")


def expect_complete(written: dict[str, Any], read: dict[str, Any], who: str) -> None:
    """Every sample that was written was read once, in order, untorn, and from one and the same ring."""
    assert not read["faults"], f"{who}: {read['faults']}"
    for stream, found in read["streams"].items():
        wanted = {"taken": written["written"][stream], "lost": 0, "restarts": 0}
        assert found == wanted, f"{who}, '{stream}': {found} instead of {wanted}"
