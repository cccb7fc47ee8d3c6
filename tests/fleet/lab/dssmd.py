# SPDX-License-Identifier: Apache-2.0
"""What scenarios do to dssmd on a guest, and what they ask it."""

import json
from collections.abc import Iterable

from lab.guest import Guest
from lab.lab import await_that


HOST_DOWN = "7300d3a6bb28413296e1b5a92550935a"  # another host is; systemd/dssmd.catalog


def journal_of(guest: Guest, message_id: str) -> list[str]:
    """The entries of one kind since that PC booted. Not since a time: tests set clocks."""
    said = guest.ssh.attempt(f"journalctl --boot --output=cat --quiet MESSAGE_ID={message_id}")
    return said.stdout.decode(errors="replace").splitlines()


def main_pid(guest: Guest) -> int:
    """dssmd's process there; 0 when there is none."""
    return int(guest.ssh.run("systemctl show --property=MainPID --value dssmd"))


def kill_dssmd(guest: Guest, signal: str = "KILL") -> None:
    """Kills dssmd by a signal and waits until systemd has started it again."""
    before = main_pid(guest)
    guest.ssh.run(f"kill -{signal} {before}")
    await_restarted(guest, before)


def await_restarted(guest: Guest, before: int) -> None:
    """Waits until another dssmd than the process `before` is ready."""
    def look() -> tuple[bool, object]:
        state, pid = guest.ssh.run("systemctl show --property=ActiveState,MainPID --value dssmd"
                                   " | sort -r").split()
        return state == "active" and int(pid) not in (0, before), (state, pid)

    await_that(f"{guest.name}: systemd starts dssmd again", look)


def newest_received(guest: Guest, stream: str) -> int:
    """The newest tid that the guest's copy of another PC's stream holds; -1: none."""
    said = guest.ssh.attempt(f"dssmctl info --json {stream}")
    mirror = json.loads(said.stdout)["mirror"] if said.returncode == 0 else None
    return -1 if mirror is None or mirror["newest_tid"] is None else mirror["newest_tid"]


def await_news(streams: Iterable[str], *guests: Guest) -> None:
    """Waits until each guest's copy of each stream has received a sample more than now."""
    for guest in guests:
        for stream in streams:
            before = newest_received(guest, stream)

            def look() -> tuple[bool, object]:
                now = newest_received(guest, stream)
                return now > before, now

            await_that(f"{guest.name} receives samples of {stream} newer than tid {before}", look)
