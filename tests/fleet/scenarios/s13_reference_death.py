# SPDX-License-Identifier: Apache-2.0
"""Clocks stay bounded when the reference PC loses its power, and when it returns

The PCs follow the successor without help. All statements about clocks are true all the time.
"""

import time

from lab.clocks import await_reference
from lab.lab import Lab
from lab.timing import PART
from lab.truth import SECOND_NS, Truth, expect_true


def run(lab: Lab) -> None:
    """Switches pc1 off and on."""
    pc1, _, pc3 = lab.guests
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        died = time.monotonic_ns()
        pc1.power_off()
        pc1.ssh.abandon()
        await_reference(pc3, "pc2")
        truth.await_good("pc2", "pc3")
        print(f"  | without the reference: the successor followed after {(time.monotonic_ns() - died) / SECOND_NS:.1f} s;"
              f" of the reads between the others {100 * truth.share_good('pc2', 'pc3', died):.1f} and"
              f" {100 * truth.share_good('pc3', 'pc2', died):.1f} % good", flush=True)
        expect_no_refusals(truth, died)
        with lab.timing.step(PART + "boot pc1"), lab.spread():
            pc1.power_on(lab.all_cores)
            pc1.await_running()
        back = time.monotonic_ns()
        truth.start_program(pc1)
        good = truth.await_good()
        print(f"  | the reference back: good {(good - back) / SECOND_NS:.1f} s after its boot", flush=True)
        await_reference(pc3, "pc1")
        truth.await_good()
        expect_no_refusals(truth, died)
    expect_true(truth)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))
    lab.await_streams()


def expect_no_refusals(truth: Truth, since: int) -> None:
    """The two others read each other all the time, while their clocks were near each other."""
    refused = truth.refused_while_near("pc2", "pc3", since) + truth.refused_while_near("pc3", "pc2", since)
    assert not refused, refused[:5]
