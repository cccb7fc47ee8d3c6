# SPDX-License-Identifier: Apache-2.0
"""Clock bounds stay true through each fault of clocks, chronyd, networks, processors and power

One fault after the other on each PC; between two of them all PCs accept each other's samples again by
themselves. A pair that a fault does not concern stays good all the time, whatever happens to the
reference. DSSM_FLEET_STATEMENTS: rounds are added until so many statements were compared with the truth.
DSSM_FLEET_FAULTS: only faults that match this regular expression, as "pc1: (frozen|power lost)";
DSSM_FLEET_SEED: another order.
"""

import os
import random
import re
import statistics
import time
from collections.abc import Callable, Iterator

from lab.clocks import await_reference
from lab.dssmd import main_pid
from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.truth import SECOND_NS, Truth, expect_true

ONLY_BY_NAME = "a round of all faults takes a quarter of an hour"
STATEMENTS = int(os.environ.get("DSSM_FLEET_STATEMENTS", "0"))
FAULTS = re.compile(os.environ.get("DSSM_FLEET_FAULTS", ""))
SEED = int(os.environ.get("DSSM_FLEET_SEED", "17"))
WATCHED_SECONDS = 12.0  # for faults that last: longer than it takes to follow the successor
SECOND, HOUR = SECOND_NS, 3600 * SECOND_NS
# Left as they are; the clocks return by themselves.
SMALL_STEPS_NS = (5_000, 100_000, 1_000_000, 3_000_000, 50_000_000, 400_000_000)
# Undone after a moment: chronyd would slew for minutes or hours.
LARGE_STEPS_NS = (SECOND, 60 * SECOND, HOUR)
SETTLED_NS = 1_000_000  # a clock that is still being slewed is stated to be further off
ASLEEP = "asleep"
SLEEPS = 20  # a guest wakes up at once
DELAYS = ("1ms", "5ms", "20ms 10ms")

Fault = tuple[str, Callable[[Lab, Truth], None], bool]  # name, what happens, whether the others stay good


def run(lab: Lab) -> None:
    """All faults in random order; in further rounds, in other orders."""
    order = random.Random(SEED)
    failures: list[str] = []
    with Truth(lab.guests).watching() as truth:
        truth.await_good()
        while True:
            faults = [(guest, fault) for guest in lab.guests for fault in faults_of(guest)
                      if FAULTS.search(f"{guest.name}: {fault[0]}")]
            order.shuffle(faults)
            # These guests have no battery's clock. At a resume their kernel takes what the wall clock was set by
            # since the last one for a part of the sleep.
            faults.sort(key=lambda each: each[1][0] != ASLEEP)
            for guest, fault in faults:
                failures += suffer(lab, truth, guest, fault)
            if truth.count() >= STATEMENTS:
                break
    expect_true(truth)
    assert not failures, "; ".join(failures)
    lab.on_all(lambda guest: guest.ssh.run("dssmctl rm truth"))
    lab.await_streams()


def suffer(lab: Lab, truth: Truth, guest: Guest, fault: Fault) -> list[str]:
    """Lets a fault happen and waits until all is good again. Returns the pairs that refused samples although
    it did not concern them."""
    name, happen, spares_others = fault
    one, other = (each.name for each in lab.guests if each is not guest)
    began = time.monotonic_ns()
    happen(lab, truth)
    ended = time.monotonic_ns()
    good = truth.await_good()
    shares = [100 * share for share in (truth.share_good(one, other, began), truth.share_good(other, one, began))]
    print(f"  | {began / SECOND_NS:.2f} s: {guest.name}: {name}, {(ended - began) / SECOND_NS:.1f} s: all good"
          f" {max(good - ended, 0) / SECOND_NS:.1f} s after that; {one} and {other}: {min(shares):.1f} % good", flush=True)
    # Reads may be refused while chronyd really moves these two clocks apart, as it does for some time after
    # the reference was set.
    refused = truth.refused_while_near(one, other, began) + truth.refused_while_near(other, one, began)
    if min(shares) < 100:
        offsets = [abs(offset.ns) / 1e3 for offset in truth.true_offsets(one, other, began)]
        print(f"  |   true distance of {one} and {other} meanwhile: {spread_us(offsets)}; statuses of reads:"
              f" {truth.statuses(one, other, began)}, {truth.statuses(other, one, began)}; {len(refused)} refused while"
              f" they were near each other {refused[:3]}", flush=True)
    # A step that is within the limit is slewed away while all samples are good: the next fault waits for that.
    truth.await_good(bound_ns=SETTLED_NS)
    if not spares_others or not refused:
        return []
    return [f"{one} and {other} refused each other {len(refused)} times when {guest.name}: {name}"]


def spread_us(values: list[float]) -> str:
    """Median and greatest."""
    return f"median {statistics.median(values):.0f} us, max {max(values):.0f} us"


def faults_of(guest: Guest) -> Iterator[Fault]:
    """The faults of one PC."""
    number = guest.number
    others = [each for each in (1, 2, 3) if each != number]
    is_reference = number == 1
    for ns in (sign * size for size in SMALL_STEPS_NS for sign in (-1, 1)):
        yield f"set by {ns / 1e6} ms", step(guest, ns), not is_reference
    for ns in (sign * size for size in LARGE_STEPS_NS for sign in (-1, 1)):
        yield f"set by {ns / 1e9:.0f} s and back", step_and_back(guest, ns), not is_reference
    yield "chronyd killed", chronyd_killed(guest), True
    yield "chronyd stopped", chronyd_stopped(guest), True
    yield "chronyd slowed", chronyd_slowed(guest), True
    yield "dssmd killed", dssmd_killed(guest), True
    yield "cable cut", blocked([(number, other) for other in others] + [(other, number) for other in others]), True
    yield "cannot send", blocked([(number, other) for other in others]), True
    yield "cannot receive", blocked([(other, number) for other in others]), True
    yield "cannot send to one", blocked([(number, others[0])]), True
    for delay in DELAYS:
        yield f"sends {delay} later", delayed(guest, delay), not is_reference
    yield "overloaded", overloaded(guest), True
    yield "frozen", frozen(guest), True
    yield ASLEEP, asleep(guest), True
    yield "power lost", power_lost(guest), True
    if is_reference:
        yield "returns with a wrong time", returns_with_wrong_time(guest), False
        yield "restarted with a wrong time", restarted_with_wrong_time(guest), True
        yield "all PCs without chronyd", without_chronyd, True


def step(guest: Guest, ns: int) -> Callable[[Lab, Truth], None]:
    """Its clock is set forward, or backward."""
    def happen(_lab: Lab, truth: Truth) -> None:
        truth.step(guest, ns)
        time.sleep(1)  # a small step changes nothing that could be awaited

    return happen


def step_and_back(guest: Guest, ns: int) -> Callable[[Lab, Truth], None]:
    """Its clock is set, and set right after three seconds."""
    def happen(_lab: Lab, truth: Truth) -> None:
        truth.step(guest, ns)
        time.sleep(3)
        truth.step(guest, -ns)

    return happen


def signal_chronyd(signal: str) -> str:
    """The command that sends a signal to chronyd."""
    return f"kill -{signal} $(cat /run/chrony/chronyd.pid)"


def chronyd_killed(guest: Guest) -> Callable[[Lab, Truth], None]:
    """chronyd crashes, and systemd starts it again."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        guest.ssh.run(signal_chronyd("KILL"))
        time.sleep(WATCHED_SECONDS)

    return happen


def chronyd_stopped(guest: Guest) -> Callable[[Lab, Truth], None]:
    """chronyd hangs for a while."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        guest.ssh.run(signal_chronyd("STOP"))
        time.sleep(WATCHED_SECONDS)
        guest.ssh.run(signal_chronyd("CONT"))

    return happen


def chronyd_slowed(guest: Guest) -> Callable[[Lab, Truth], None]:
    """chronyd runs for a tenth of the time only."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        guest.ssh.run(f"for i in $(seq {WATCHED_SECONDS:.0f}); do {signal_chronyd('STOP')}; sleep 0.9;"
                      f" {signal_chronyd('CONT')}; sleep 0.1; done")

    return happen


def dssmd_killed(guest: Guest) -> Callable[[Lab, Truth], None]:
    """dssmd hangs for some seconds and is killed."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        pid = main_pid(guest)
        guest.ssh.run(f"kill -STOP {pid}; sleep 4; kill -KILL {pid}")

    return happen


def blocked(directions: list[tuple[int, int]]) -> Callable[[Lab, Truth], None]:
    """Packets of some PCs to others are lost."""
    def happen(lab: Lab, _truth: Truth) -> None:
        for sender, receiver in directions:
            lab.network.block(sender, receiver)
        time.sleep(WATCHED_SECONDS)
        lab.network.join()

    return happen


def delayed(guest: Guest, delay: str) -> Callable[[Lab, Truth], None]:
    """Packets that it sends take longer, and those that it receives do not."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        guest.ssh.run(f"tc qdisc add dev vec0 root netem delay {delay}")
        time.sleep(WATCHED_SECONDS)
        guest.ssh.run("tc qdisc del dev vec0 root")

    return happen


def overloaded(guest: Guest) -> Callable[[Lab, Truth], None]:
    """Programs that compute take all of its processor."""
    def happen(_lab: Lab, truth: Truth) -> None:
        began = time.monotonic_ns()
        guest.ssh.run("for i in 1 2 3 4; do (while :; do :; done) & all=\"$all $!\"; done; sleep 15; kill $all")
        expect_all_good(truth, began, f"{guest.name} was busy")

    return happen


def expect_all_good(truth: Truth, began: int, what: str) -> None:
    """All PCs accepted all samples since then."""
    shares = {(reader, owner): truth.share_good(reader, owner, began)
              for reader in truth.watched for owner in truth.watched if reader != owner}
    assert min(shares.values()) == 1, f"samples were refused because {what}: {shares}"


def without_chronyd(lab: Lab, truth: Truth) -> None:
    """No PC runs chronyd: the heartbeats alone decide."""
    began = time.monotonic_ns()
    lab.on_all(lambda guest: guest.ssh.run("systemctl stop chrony"))
    time.sleep(WATCHED_SECONDS)
    lab.on_all(lambda guest: guest.ssh.run("systemctl start chrony"))
    expect_all_good(truth, began, "no PC ran chronyd")


def frozen(guest: Guest) -> Callable[[Lab, Truth], None]:
    """The PC stands still for some seconds, and its clock goes on."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        guest.freeze()
        time.sleep(5)
        guest.thaw()

    return happen


def asleep(guest: Guest) -> Callable[[Lab, Truth], None]:
    """The PC sleeps, some 30 ms in all."""
    def happen(_lab: Lab, _truth: Truth) -> None:
        slept = guest.sleep(SLEEPS)
        assert slept == SLEEPS, f"{guest.name} slept {slept} times, not {SLEEPS}"

    return happen


def power_lost(guest: Guest) -> Callable[[Lab, Truth], None]:
    """The PC loses its power and boots again."""
    def happen(lab: Lab, truth: Truth) -> None:
        guest.power_off()
        guest.ssh.abandon()
        time.sleep(WATCHED_SECONDS)
        with lab.spread():
            guest.power_on(lab.all_cores)
            guest.await_running()
        truth.start_program(guest)

    return happen


def returns_with_wrong_time(guest: Guest) -> Callable[[Lab, Truth], None]:
    """The reference is away, its clock is set meanwhile, and it returns: all PCs have to follow it."""
    def happen(lab: Lab, truth: Truth) -> None:
        lab.network.part([guest.number], [2, 3])
        await_reference(lab["pc3"], "pc2")
        truth.step(guest, -30_000_000)
        time.sleep(WATCHED_SECONDS)
        lab.network.join()
        await_reference(lab["pc3"], guest.name)

    return happen


def restarted_with_wrong_time(guest: Guest) -> Callable[[Lab, Truth], None]:
    """The reference is switched on again with the time of its battery: it takes over its successor's."""
    def happen(lab: Lab, truth: Truth) -> None:
        guest.ssh.run("systemctl stop dssmd.socket dssmd chrony")
        # Without dssmd, its last statement counts for 3 s.
        await_that(f"{guest.name} refuses samples", lambda: (truth.refuses(guest.name, "pc2"), None))
        await_reference(lab["pc3"], "pc2")
        truth.step(guest, 2 * SECOND)
        guest.ssh.run("systemctl start chrony dssmd")
        await_reference(lab["pc3"], guest.name)

    return happen
