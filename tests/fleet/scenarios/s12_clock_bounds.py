# SPDX-License-Identifier: Apache-2.0
"""What PCs state of their clocks holds over a step of 200 ms and a reference that is cut off

Looked at from outside some 30 times a second, each statement on each PC about each other's samples.
After a step or a cut nothing is delivered as good that is beyond the limit, and all is good again by
itself; how long that takes is measured.
"""

from lab.lab import Lab
from lab.truth import SECOND_NS, Truth, expect_true, refused_since, summary

STEP_NS = SECOND_NS // 5
READINGS = 10


def run(lab: Lab) -> None:
    """Nothing, a step forward of pc2's clock, and pc1, which all follow, behind a cut cable."""
    pc2, pc3 = lab["pc2"], lab["pc3"]
    with Truth(lab.guests).watching() as truth:
        begin = truth.await_good()
        print(pc3.ssh.run(f"dssmctl clock --table {READINGS}"), end="", flush=True)
        for guest in (pc2, pc3):
            offsets = truth.true_offsets(guest.name, "pc1", begin)
            print(f"  | {guest.name} - pc1, seen from outside: {summary(each[0] for each in offsets)}; within"
                  f" {summary(each[1] for each in offsets)}", flush=True)
        stepped = truth.step(pc2, STEP_NS)
        good = truth.await_good()
        print(f"  | after a step of 200 ms: refused after {refused_since(truth, 'pc2', stepped):.3f} s, good again"
              f" after {(good - stepped) / SECOND_NS:.1f} s", flush=True)
        cut = truth.now()
        lab.network.part([1], [2, 3])
        good = truth.await_good("pc2", "pc3")
        lab.await_streams("truth:0@pc2", "truth:0@pc3", on=[pc2, pc3])
        print(f"  | without the reference: its samples refused after {refused_since(truth, 'pc1', cut):.1f} s, the"
              f" others good without a break {(truth.now() - good) / SECOND_NS:.1f} s"
              f" of {(truth.now() - cut) / SECOND_NS:.1f} s", flush=True)
        joined = truth.now()
        lab.network.join()
        good = truth.await_good()
        print(f"  | the reference back: good again after {(good - joined) / SECOND_NS:.1f} s", flush=True)
    expect_true(truth)
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm truth")
    lab.await_streams()
