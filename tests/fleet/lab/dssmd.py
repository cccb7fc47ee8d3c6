# SPDX-License-Identifier: Apache-2.0
"""Commands to dssmd on a guest, and queries of its state."""

import json
from collections.abc import Iterable

from lab.guest import Guest
from lab.lab import await_that


HOST_DOWN = "7300d3a6bb28413296e1b5a92550935a"  # "Another host is down" in systemd/dssmd.catalog


def journal_of(guest: Guest, message_id: str) -> list[str]:
    """The entries with a message id since that PC booted. Not since a time, because tests set clocks."""
    result = guest.ssh.attempt(f"journalctl --boot --output=cat --quiet MESSAGE_ID={message_id}")
    return result.stdout.decode(errors="replace").splitlines()


def main_pid(guest: Guest) -> int:
    """The pid of dssmd there; 0 if it does not run."""
    return int(guest.ssh.run("systemctl show --property=MainPID --value dssmd"))


def kill_dssmd(guest: Guest, signal: str = "KILL") -> None:
    """Kills dssmd by a signal and waits until systemd has started it again."""
    before = main_pid(guest)
    guest.ssh.run(f"kill -{signal} {before}")
    await_restarted(guest, before)


def await_restarted(guest: Guest, before: int) -> None:
    """Waits until a dssmd with another pid than `before` is ready."""
    def check() -> tuple[bool, object]:
        state, pid = guest.ssh.run("systemctl show --property=ActiveState,MainPID --value dssmd"
                                   " | sort -r").split()
        return state == "active" and int(pid) not in (0, before), (state, pid)

    await_that(f"{guest.name}: systemd starts dssmd again", check)


def newest_received(guest: Guest, stream: str) -> int:
    """The newest tid in the guest's mirror of another PC's stream; -1: none."""
    result = guest.ssh.attempt(f"dssmctl info --json {stream}")
    mirror = json.loads(result.stdout)["mirror"] if result.returncode == 0 else None
    return -1 if mirror is None or mirror["newest_tid"] is None else mirror["newest_tid"]


def await_new_samples(streams: Iterable[str], *guests: Guest) -> None:
    """Waits until each guest's mirror of each stream has received a further sample."""
    for guest in guests:
        for stream in streams:
            before = newest_received(guest, stream)

            def check() -> tuple[bool, object]:
                now = newest_received(guest, stream)
                return now > before, now

            await_that(f"{guest.name} receives samples of {stream} newer than tid {before}", check)
