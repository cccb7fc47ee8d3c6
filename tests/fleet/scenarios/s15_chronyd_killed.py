# SPDX-License-Identifier: Apache-2.0
"""A reference whose chronyd is killed recovers by itself, and site.yml repairs a chronyd started by hand

Afterwards reads by time are good between all PCs, and chronyd on the reference serves its clock again. All
statements about clocks are true all the time.
"""

import time

from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.truth import SECOND_NS, Truth, expect_true

ONLY_BY_NAME = "it runs Ansible twice"


def run(lab: Lab) -> None:
    """Kills chronyd on pc1; then stops it, starts it by hand and runs site.yml."""
    pc1 = lab["pc1"]
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        killed = time.monotonic_ns()
        pc1.ssh.run("kill -KILL $(cat /run/chrony/chronyd.pid)")
        await_serving(pc1)
        served = time.monotonic_ns()
        good = truth.await_good()
        print(f"  | chronyd of the reference killed: serves again after {(served - killed) / SECOND_NS:.1f} s,"
              f" reads good from {(good - killed) / SECOND_NS:.1f} s on", flush=True)
    expect_true(truth)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))

    pc1.ssh.run("systemctl stop chrony && /usr/sbin/chronyd -F 1")
    assert "7F7F0101" not in tracking(pc1), "a chronyd started by hand serves its clock without help"
    repaired = lab.deploy()
    assert repaired.changed()["pc1"] > 0, repaired.output
    await_serving(pc1)
    again = lab.deploy()
    assert again.changed() == {guest.name: 0 for guest in lab.guests}, again.output


def tracking(guest: Guest) -> str:
    """What chronyd there follows; its own clock is 7F7F0101."""
    return guest.ssh.attempt("chronyc -c tracking").stdout.decode()


def await_serving(guest: Guest) -> None:
    """Waits until chronyd there serves its own clock, started by systemd."""
    def check() -> tuple[bool, object]:
        state = guest.ssh.attempt("systemctl is-active chrony dssm-clock-server").stdout.decode().split()
        seen = tracking(guest)
        return state == ["active", "active"] and "7F7F0101" in seen, (state, seen)

    await_that(f"{guest.name} serves its clock", check)
