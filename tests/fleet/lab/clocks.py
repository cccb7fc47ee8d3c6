# SPDX-License-Identifier: Apache-2.0
"""The clocks of the PCs, as DSSM reports them."""

import json
from typing import Any

from lab.guest import Guest
from lab.lab import await_that


def clock_of(guest: Guest) -> dict[str, Any]:
    """The entry of that PC in the output of `dssmctl clock` there."""
    clocks = json.loads(guest.ssh.run("dssmctl clock --json"))["clocks"]
    own: dict[str, Any] = next(clock for clock in clocks if clock["host"] == guest.name)
    return own


def await_reference(guest: Guest, reference: str) -> None:
    """Waits until chronyd there follows the PC `reference`."""
    def check() -> tuple[bool, object]:
        clock = clock_of(guest)
        return clock["reference"] == reference and clock["status"] == "synchronized", clock

    await_that(f"{guest.name} follows {reference}", check)
