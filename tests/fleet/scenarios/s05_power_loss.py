# SPDX-License-Identifier: Apache-2.0
"""A PC that loses its power leaves the lists, returns by itself, and readers follow

It is gone within 3 s of its connection's death and back within 3 s of answering; readers elsewhere
go on with its new streams and are told that these began anew.
"""

import time

from lab.lab import Lab
from lab.load import Load
from lab.timing import PART

STREAM = "powered:0@pc1"
# What the design promises, and what a busy machine may add to the looking.
PROMISED_SECONDS = 3
LOOKING_SECONDS = 2


def run(lab: Lab) -> None:
    """Takes the power of pc1 and gives it back."""
    pc1, pc2, pc3 = lab.guests
    Load(pc1, "write", [STREAM]).await_ready()
    reader = Load(pc2, "read", [STREAM]).await_ready()
    lab.await_streams(STREAM)
    lost = time.monotonic()
    pc1.power_off()
    lab.await_streams(on=[pc2, pc3])
    gone = time.monotonic() - lost
    with lab.timing.step(PART + "boot pc1"), lab.spread():
        pc1.power_on(lab.all_cores)
        pc1.await_running()
    writer = Load(pc1, "write", [STREAM]).await_ready()
    answered = time.monotonic()
    lab.await_streams(STREAM)
    back = time.monotonic() - answered
    print(f"  | gone after {gone:.1f} s, back {back:.1f} s after its stream", flush=True)
    written = writer.finish()["written"][STREAM]
    found = reader.finish()
    assert not found["faults"], found["faults"]
    assert found["streams"][STREAM]["restarts"] == 1, found
    assert written > 0
    pc1.ssh.run(f"dssmctl rm {STREAM}")
    lab.await_streams()
    for what, took in (("gone", gone), ("back", back)):
        assert took < PROMISED_SECONDS + LOOKING_SECONDS, f"{what} only after {took:.1f} s"
