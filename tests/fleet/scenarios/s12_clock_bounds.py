# SPDX-License-Identifier: Apache-2.0
"""What PCs state of their clocks holds over a step of 200 ms and a reference that is cut off

Looked at from outside some 30 times a second, each statement on each PC about each other's samples.
After a step or a cut nothing is delivered as good that is beyond the limit, and all is good again by
itself; how long that takes is measured.
"""

import os
import time

from lab.clocks import await_reference
from lab.lab import Lab
from lab.truth import SECOND_NS, Truth, expect_true, summary

STEP_NS = SECOND_NS // 5
READINGS = int(os.environ.get("DSSM_FLEET_READINGS", "10"))  # of the table, one a second


def run(lab: Lab) -> None:
    """Nothing, a step forward of pc2's clock, and pc1, which all follow, behind a cut cable."""
    pc2, pc3 = lab["pc2"], lab["pc3"]
    with Truth(lab.guests).watching() as truth:
        begin = truth.await_good()
        print(pc3.ssh.run(f"dssmctl clock --table {READINGS}", timeout=READINGS + 60), end="", flush=True)
        for guest in (pc2, pc3):
            print(f"  | {guest.name} - pc1 by the truth: {summary(truth.true_offsets(guest.name, 'pc1', begin))} us",
                  flush=True)
        stepped = truth.step(pc2, STEP_NS)
        good = truth.await_good()
        print(f"  | a step of 200 ms: refused after {truth.await_refused('pc2', stepped):.3f} s, good again after"
              f" {(good - stepped) / SECOND_NS:.1f} s", flush=True)
        cut = time.monotonic_ns()
        lab.network.part([1], [2, 3])
        refused = truth.await_refused("pc1", cut)
        await_reference(pc3, "pc2")
        truth.await_good("pc2", "pc3")
        print(f"  | without the reference: its samples refused after {refused:.1f} s; the successor followed after"
              f" {(time.monotonic_ns() - cut) / SECOND_NS:.1f} s; of the reads between the others"
              f" {100 * truth.share_good('pc2', 'pc3', cut):.1f} and {100 * truth.share_good('pc3', 'pc2', cut):.1f}"
              " % good", flush=True)
        joined = time.monotonic_ns()
        lab.network.join()
        good = truth.await_good()
        print(f"  | the reference back: good again after {(good - joined) / SECOND_NS:.1f} s", flush=True)
        await_reference(pc3, "pc1")
        truth.await_good()
    expect_true(truth)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))
    lab.await_streams()
