# SPDX-License-Identifier: Apache-2.0
"""Clock bounds stay true over many steps of all sizes, one PC's clock after the other

The clocks are set by 5 us to 400 ms, forward and back, while each PC states about each other PC's
samples. After each step all samples are accepted again by themselves. Larger steps: s14.
"""

import os
import random
import time

from lab.lab import Lab
from lab.truth import SECOND_NS, Truth, expect_true

ONLY_BY_NAME = "it takes minutes"
STEPS = int(os.environ.get("DSSM_FLEET_STEPS", "24"))
LEAST_NS, GREATEST_NS = 5_000, 400_000_000
WATCHED_SECONDS = 1.0  # after each step


def run(lab: Lab) -> None:
    """Sets the clocks of all PCs in turn, by sizes that rise and fall at random."""
    order = random.Random(16)
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        for number in range(STEPS):
            guest = lab.guests[number % len(lab.guests)]
            size = int(LEAST_NS * (GREATEST_NS / LEAST_NS) ** order.random()) * order.choice((-1, 1))
            stepped = truth.step(guest, size)
            time.sleep(WATCHED_SECONDS)  # a small step changes nothing that could be awaited
            good = truth.await_good()
            print(f"  | {guest.name}'s clock set by {size / 1e6:.3f} ms: all good"
                  f" {max(good - stepped, 0) / SECOND_NS:.1f} s after that", flush=True)
    expect_true(truth)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))
    lab.await_streams()
