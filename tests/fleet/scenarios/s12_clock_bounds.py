# SPDX-License-Identifier: Apache-2.0
"""PCs report true clock bounds over a step of 200 ms and without connection to the reference

Each PC's statements about the samples of each other PC are compared with the true values some 30 times
a second. After a step or a cut no sample beyond the limit is accepted, and all samples are accepted
again by themselves; the time that this takes is printed.
"""

import os
import time

from lab.clocks import await_reference
from lab.lab import Lab
from lab.truth import SECOND_NS, Truth, expect_true, summary

STEP_NS = SECOND_NS // 5
READINGS = int(os.environ.get("DSSM_FLEET_READINGS", "10"))  # of the table, one per second


def run(lab: Lab) -> None:
    """No change, a step forward of pc2's clock, and a cut cable of pc1, which all follow."""
    pc2, pc3 = lab["pc2"], lab["pc3"]
    with Truth(lab.guests).watching() as truth:
        begin = truth.await_good()
        print(pc3.ssh.run(f"dssmctl clock --table {READINGS}", timeout=READINGS + 60), end="", flush=True)
        print(pc3.ssh.run("dssmctl clock --matrix"), end="", flush=True)
        for one, other in (("pc2", "pc1"), ("pc3", "pc1"), ("pc3", "pc2")):
            print(f"  | {one} - {other} by the truth: {summary(truth.true_offsets(one, other, begin))} us", flush=True)
        stepped = truth.step(pc2, STEP_NS)
        good = truth.await_good()
        print(f"  | a step of 200 ms: refused after {truth.await_refused('pc2', stepped):.3f} s, good again after"
              f" {(good - stepped) / SECOND_NS:.1f} s", flush=True)
        cut = time.monotonic_ns()
        lab.network.part([1], [2, 3])
        refused = truth.await_refused("pc1", cut)
        await_reference(pc3, "pc2")
        truth.await_good("pc2", "pc3")
        shares = truth.share_good("pc2", "pc3", cut), truth.share_good("pc3", "pc2", cut)
        print(f"  | without the reference: its samples refused after {refused:.1f} s; the successor followed after"
              f" {(time.monotonic_ns() - cut) / SECOND_NS:.1f} s; of the reads between the others"
              f" {100 * shares[0]:.1f} and {100 * shares[1]:.1f} % good", flush=True)
        # They measure each other. By chronyd's statements alone it was 65 to 83 %.
        assert min(shares) > 0.9, "the pair without the reference was refused"
        joined = time.monotonic_ns()
        lab.network.join()
        good = truth.await_good()
        print(f"  | the reference back: good again after {(good - joined) / SECOND_NS:.1f} s", flush=True)
        await_reference(pc3, "pc1")
        truth.await_good()
    expect_true(truth)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))
    lab.await_streams()
