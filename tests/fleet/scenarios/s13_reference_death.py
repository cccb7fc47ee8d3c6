# SPDX-License-Identifier: Apache-2.0
"""Clocks stay bounded when the reference PC loses its power, and when it returns

The successor takes over with no help. What is stated holds all the time, seen from outside.
"""

import time

from lab.lab import Lab
from lab.timing import PART
from lab.truth import SECOND_NS, Truth, expect_true

WITHOUT_SECONDS = 20  # chronyd on the others gives the reference up after some 8


def run(lab: Lab) -> None:
    """Takes the power of pc1, and gives it back."""
    pc1 = lab["pc1"]
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        died = truth.now()
        pc1.power_off()
        pc1.ssh.abandon()
        # The one wait for time: nothing tells that a bound did not grow any more.
        time.sleep(WITHOUT_SECONDS)
        good = truth.await_good("pc2", "pc3")
        print(f"  | without the reference: the others good without a break for {(truth.now() - good) / SECOND_NS:.1f}"
              f" of {(truth.now() - died) / SECOND_NS:.1f} s", flush=True)
        with lab.timing.step(PART + "boot pc1"), lab.spread():
            pc1.power_on(lab.all_cores)
            pc1.await_running()
        back = truth.now()
        truth.start_program(pc1)
        good = truth.await_good()
        print(f"  | the reference back: good {(good - back) / SECOND_NS:.1f} s after its boot", flush=True)
    expect_true(truth)
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm truth")
    lab.await_streams()
