# SPDX-License-Identifier: Apache-2.0
"""Journals and states of guests, collected after a failure."""

import pathlib
from collections.abc import Iterable

from lab.guest import Guest
from lab.ssh import GuestError

COMMANDS = {
    "journal": "journalctl --no-pager --output=short-precise",
    "state": "systemctl --failed --no-pager; systemctl status --no-pager --lines=0 dssmd;"
             " dssmctl hosts; dssmctl ls; dssmctl doctor; ip address; ps -ef",
}


def collect(guests: Iterable[Guest], folder: pathlib.Path) -> None:
    """Writes journal, state and console of each guest into `folder`, as far as available."""
    folder.mkdir(parents=True, exist_ok=True)
    for guest in guests:
        (folder / f"{guest.name}.console").write_bytes(guest.console.read_bytes())
        if not guest.answers():
            continue
        for name, command in COMMANDS.items():
            try:
                result = guest.ssh.attempt(command, timeout=20)
            except GuestError:
                continue
            (folder / f"{guest.name}.{name}").write_bytes(result.stdout + result.stderr)
