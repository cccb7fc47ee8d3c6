# SPDX-License-Identifier: Apache-2.0
"""A killed chronyd recovers by itself; site.yml repairs clocks, and fails where it must not

Afterwards reads by time are good between all PCs, and chronyd on the reference serves its clock again. All
statements about clocks are true all the time.
"""

import time

from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.truth import SECOND_NS, Truth, expect_true

ONLY_BY_NAME = "it runs Ansible five times"
RESTART_SECONDS = 10


def run(lab: Lab) -> None:
    """Kills chronyd on pc1; then stops it, starts it by hand and runs site.yml."""
    pc1 = lab["pc1"]
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        killed = time.monotonic_ns()
        pc1.ssh.run("kill -KILL $(cat /run/chrony/chronyd.pid)")
        await_serving(pc1)
        served = time.monotonic_ns()
        assert served - killed < RESTART_SECONDS * SECOND_NS, f"serves only after {(served - killed) / SECOND_NS:.1f} s"
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

    # Playbooks that may not repair the clocks find that reads by time are refused.
    lab["pc2"].ssh.run("systemctl stop chrony && date -s '+2 seconds'")
    for playbook in ("upgrade.yml", "site.yml"):
        played = lab.playbooks.attempt(playbook, lab.artifacts.packages, "-e", "dssm_chrony=false",
                                       "-e", "dssm_verify_timeout=5")
        assert not played.succeeded and "cannot read streams of pc2 by time" in played.output, played.output
    lab.deploy()
    await_serving(pc1)


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
