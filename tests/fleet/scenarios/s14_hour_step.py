# SPDX-License-Identifier: Apache-2.0
"""A wall clock that is set by an hour, forward and backward, disturbs no heartbeat and no wait

Under load, every sample arrives once and in order, no PC reports another one as down, and no stream is
removed from a list. Only reads by time are refused, until the clocks are within bounds again.
"""

from lab.dssmd import HOST_DOWN, journal_of
from lab.guest import Guest
from lab.lab import Lab
from lab.load import Load, expect_complete
from lab.truth import SECOND_NS, Truth, expect_true

HOUR_NS = 3600 * SECOND_NS
STREAMS = ["hour:0@pc1", "hour:0@pc2", "hour:0@pc3"]
STALLED_SECONDS = 1.0  # a PC that stands still for so long may miss its heartbeats: no fault of the step
# The load shows that samples flow. More of it would test how fast the machine is, with 9 streams and
# a watched clock on each PC.
RATE_HZ = 200
MORE = 3 * RATE_HZ  # samples, three seconds: longer than the peer timeout


def run(lab: Lab) -> None:
    """Sets pc3's clock an hour forward, two back, and one forward."""
    pc3 = lab["pc3"]
    before = lab.on_all(hosts_down)
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        writers = [Load(guest, "write", [stream], RATE_HZ).await_ready()
                   for guest, stream in zip(lab.guests, STREAMS)]
        readers = {guest.name: Load(guest, "read", STREAMS, RATE_HZ).await_ready()
                   for guest in lab.guests}
        for hours in (1, -2, 1):
            stepped = truth.step(pc3, hours * HOUR_NS)
            for load in (*writers, *readers.values()):
                load.await_more(MORE)
            print(f"  | pc3's clock set by {hours} h: refused elsewhere after"
                  f" {truth.await_refused('pc3', stepped):.3f} s", flush=True)
        good = truth.await_good()
        print(f"  | good again {(good - stepped) / SECOND_NS:.1f} s after it was set right", flush=True)
        written = {"written": {stream: count for writer in writers
                               for stream, count in writer.finish()["written"].items()}}
        for name, reader in readers.items():
            expect_complete(written, reader.finish(), f"reader on {name}")
    expect_true(truth)
    after = lab.on_all(hosts_down)
    reported = {guest.name: new[len(old):] for guest, old, new in zip(lab.guests, before, after)}
    if any(reported.values()):
        silence = truth.longest_silence()
        print(f"  | reported as down: {reported}; a PC did not answer for up to {silence:.1f} s", flush=True)
        assert silence > STALLED_SECONDS, "a PC was reported as down that answered"
    for stream in STREAMS:
        lab["pc1"].ssh.run(f"dssmctl rm {stream}")
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))
    lab.await_streams()


def hosts_down(guest: Guest) -> list[str]:
    """What dssmd there has logged about other PCs that are down."""
    return journal_of(guest, HOST_DOWN)
