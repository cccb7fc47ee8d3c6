# SPDX-License-Identifier: Apache-2.0
"""A PC that loses its power leaves the lists, returns by itself, and readers follow

How long both take is measured and said, beside what is promised; a busy machine proves nothing about
that, so what is proved is that the heartbeat's silence made it leave, and nothing slower. Readers elsewhere go on with the PC's new streams and are told that these began anew.
"""

import time

from lab.dssmd import HOST_DOWN, journal_of
from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.load import Load
from lab.timing import PART

STREAM = "powered:0@pc1"
# docs/discovery.md, on a machine that is not busy.
PROMISED_SECONDS = 3


def run(lab: Lab) -> None:
    """Takes the power of pc1 and gives it back."""
    pc1, pc2, pc3 = lab.guests
    Load(pc1, "write", [STREAM]).await_ready()
    reader = Load(pc2, "read", [STREAM]).await_ready()
    lab.await_streams(STREAM)
    told = {guest: len(journal_of(guest, HOST_DOWN)) for guest in (pc2, pc3)}
    lost = time.monotonic()
    pc1.power_off()
    lab.await_streams(on=[pc2, pc3])
    gone = time.monotonic() - lost
    for guest, before in told.items():
        expect_silence(guest, before)
    with lab.timing.step(PART + "boot pc1"), lab.spread():
        pc1.power_on(lab.all_cores)
        pc1.await_running()
    writer = Load(pc1, "write", [STREAM]).await_ready()
    answered = time.monotonic()
    lab.await_streams(STREAM)
    back = time.monotonic() - answered
    print(f"  | gone {gone:.1f} s after the power, back {back:.1f} s after its stream; promised:"
          f" {PROMISED_SECONDS} s", flush=True)
    reader.await_more(100)  # it has found the new ring
    written = writer.finish()["written"][STREAM]
    found = reader.finish()
    assert not found["faults"], found["faults"]
    assert found["streams"][STREAM]["restarts"] == 1, found
    assert written > 0
    pc1.ssh.run(f"dssmctl rm {STREAM}")
    lab.await_streams()


def expect_silence(guest: Guest, before: int) -> None:
    """dssmd there says, behind so many entries, that pc1 left because nothing was heard of it."""
    def look() -> tuple[bool, object]:  # journald may be a little behind
        said = journal_of(guest, HOST_DOWN)[before:]
        return any("host 'pc1' is down: " in line for line in said), said

    await_that(f"{guest.name} says why pc1 is down", look)
    _, said = look()
    assert "no sign of life" in str(said), f"{guest.name}: {said}"
