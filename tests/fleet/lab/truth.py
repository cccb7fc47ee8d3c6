# SPDX-License-Identifier: Apache-2.0
"""The clocks of the guests as they are, measured from outside, and what DSSM states about them.

Asks each guest's fleet-clock (fleet_clock.cpp) some 30 times a second. An answer holds the clocks of
the guest and statements about the samples of the others; each sample holds the clocks of its writer.

What all are compared with is this machine's monotonic clock, which is what a User Mode Linux kernel
counts its CLOCK_MONOTONIC_RAW by: the two differ by what they differed by when it booted. A question
that left at t1 and was answered at t2 was looked at in between; all of them together bound that
difference. So what is computed of a clock has a width, and a statement is called false only when it
is for all values within.
"""

import bisect
import dataclasses
import itertools
import json
import math
import select
import socket
import statistics
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from lab.guest import Guest
from lab.lab import await_that
from lab.packages import PROGRAMS_FOLDER

PORT = 7123
PERIOD_SECONDS = 0.03
CALIBRATION = 300  # questions to each guest, one after the other, before all others
MOST_ASKED = 300  # questions whose answers may still come
QUICK_NS = 150_000  # a look at a guest's clocks that took longer is no measurement
LIMIT_NS = 1_500_000  # dssmd's default clock_limit
STEADY_SECONDS = 1.5  # without one statement that is not good: recovered
RECOVERY_SECONDS = 180
SECOND_NS = 10**9


@dataclasses.dataclass
class Look:
    """A guest's clocks, all in ns, and what was said with them."""

    came: int  # when that was here
    wall: int
    mono: int
    raw: int
    within: int
    said: dict[str, Any]

    def status_of(self, owner: str) -> str:
        """How a read by time of another guest's samples ended; "closed": they cannot be had yet."""
        status: str = self.said["others"].get(owner, {"by_time": {"status": "closed"}})["by_time"]["status"]
        return status


@dataclasses.dataclass
class Checked:
    """A statement about a sample of `owner` made on the PC `reader`, beside the truth. In ns."""

    came: int
    reader: str
    owner: str
    good: bool
    stated: int  # -1: nothing
    true: float  # the sample's time minus that PC's
    width: float

    def is_false(self, claim: int) -> bool:
        """Whether the truth is beyond `claim` for certain."""
        return abs(self.true) - self.width > claim


class Life:
    """What was seen of one run of fleet-clock."""

    def __init__(self) -> None:
        self.looks: list[Look] = []
        self._ahead_least, self._ahead_most = -math.inf, math.inf

    def note(self, look: Look, left: int) -> None:
        """Adds the answer to a question that left here at `left`."""
        self._ahead_least = max(self._ahead_least, left - look.raw - look.within)
        self._ahead_most = min(self._ahead_most, look.came - look.said["raw_end"])
        if not self.looks or self.looks[-1].raw < look.raw:
            self.looks.append(look)

    def ahead(self) -> tuple[float, float]:
        """This machine's monotonic clock minus the guest's raw one, and its width."""
        assert self._ahead_least <= self._ahead_most, "the guest does not count time as this machine does"
        return ((self._ahead_least + self._ahead_most) / 2, (self._ahead_most - self._ahead_least) / 2)

    def wall_at(self, raw: float, look: Look) -> tuple[float, float] | None:
        """What the wall clock that `look` shows would have shown when the raw one showed `raw`, and its
        width: what the PC slewed in between."""
        index = bisect.bisect_right(self.looks, raw, key=lambda each: each.raw) - 1
        if index < 0:
            return None
        before = self.looks[index]
        slewed = abs((look.mono - before.mono) - (look.raw - before.raw))
        return look.wall - (look.raw - raw), look.within + slewed


class Watched:
    """What was seen of one guest."""

    def __init__(self, guest: Guest) -> None:
        self.guest = guest
        self.lives: dict[int, Life] = {}
        self.steps: list[int] = []  # when its clock was set from here

    @property
    def last(self) -> Life:
        """The one that goes on."""
        return next(reversed(self.lives.values())) if self.lives else Life()


class Truth:
    """Watches within `with watching()`; what it saw is judged after that."""

    def __init__(self, guests: Iterable[Guest]) -> None:
        self.watched = {guest.name: Watched(guest) for guest in guests}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._asked: dict[int, tuple[str, int, bool]] = {}  # by number: guest, when [ns], to step
        self._numbers = itertools.count()
        self._steps: list[tuple[str, int]] = []  # that are to be asked for
        self._stop = threading.Event()

    def start_program(self, guest: Guest) -> None:
        """Starts fleet-clock on a guest."""
        others = " ".join(name for name in self.watched if name != guest.name)
        program = guest.ssh.start(f"{PROGRAMS_FOLDER}/fleet-clock {PORT} {others}")
        assert program.stdout
        line = program.stdout.readline()
        if line != "ready\n":
            raise AssertionError(f"{guest.name}: fleet-clock: {line}{program.communicate()[1]}")

    @contextmanager
    def watching(self) -> Iterator["Truth"]:
        """Runs fleet-clock on all guests and looks at them until the end of the block."""
        guests = [watched.guest for watched in self.watched.values()]
        for guest in guests:
            self.start_program(guest)
            self._calibrate(guest.name)
        watch = threading.Thread(target=self._watch)
        watch.start()
        try:
            yield self
        finally:
            self._stop.set()
            watch.join()
            self._socket.close()
            for guest in guests:
                guest.ssh.abandon()

    def step(self, guest: Guest, ns: int) -> int:
        """Sets a guest's clock forward by `ns`; returns when that was."""
        steps = self.watched[guest.name].steps
        before = len(steps)
        self._steps.append((guest.name, ns))
        await_that(f"{guest.name}'s clock is set", lambda: (len(steps) > before, len(steps)))
        return steps[-1]

    def await_good(self, *names: str) -> int:
        """Waits until these guests, or all, have called each other's samples good for a while, and returns
        when that began."""
        begin = time.monotonic_ns()
        wanted = names or tuple(self.watched)

        def look() -> tuple[bool, object]:
            bad, since = self._last_not_good(wanted, begin)
            return time.monotonic_ns() - since > STEADY_SECONDS * SECOND_NS, bad

        await_that(f"{', '.join(wanted)} call each other's clocks good", look, RECOVERY_SECONDS)
        return self._last_not_good(wanted, begin)[1]

    def await_refused(self, owner: str, since: int) -> float:
        """Waits until a read of a guest's samples is refused elsewhere for its time; after how many seconds
        since `since` that was for the first time."""
        def refused() -> list[int]:
            return [look.came for name, watched in self.watched.items() if name != owner
                    for look in reversed(watched.last.looks) if look.came > since
                    and look.status_of(owner) == "clock_out_of_bounds"]

        await_that(f"reads of {owner}'s samples by time are refused", lambda: (bool(refused()), None))
        return (min(refused()) - since) / SECOND_NS

    def share_good(self, reader: str, owner: str, since: int) -> float:
        """The share of the reads of `owner`'s samples that were good, of those since then."""
        said = [look.status_of(owner) for look in self.watched[reader].last.looks if look.came > since]
        return said.count("ok") / max(len(said), 1)

    def _last_not_good(self, names: Iterable[str], begin: int) -> tuple[str, int]:
        last = ("nothing", begin)
        for name in names:
            looks = self.watched[name].last.looks
            if not looks or looks[-1].came < time.monotonic_ns() - SECOND_NS:
                return f"{name} does not answer", time.monotonic_ns()
            for owner in names:
                for look in reversed(looks) if owner != name else ():
                    if look.came < last[1]:
                        break
                    if look.status_of(owner) != "ok":
                        last = (f"{name} reads {owner}: {look.status_of(owner)}", look.came)
                        break
        return last

    def _calibrate(self, name: str) -> None:
        """The quickest of many answers tells best how a guest's clock counts."""
        for _ in range(CALIBRATION):
            self._ask(name, 0)
            if select.select([self._socket], [], [], 1)[0]:
                self._take_answer()

    def _watch(self) -> None:
        while not self._stop.is_set():
            deadline = time.monotonic() + PERIOD_SECONDS
            while self._steps:
                name, ns = self._steps.pop()
                self._ask(name, ns)
            for name in self.watched:
                self._ask(name, 0)
            while (left := deadline - time.monotonic()) > 0:
                if select.select([self._socket], [], [], left)[0]:
                    self._take_answer()

    def _ask(self, name: str, step: int) -> None:
        number = next(self._numbers)
        self._asked.pop(number - MOST_ASKED, None)
        self._asked[number] = (name, time.monotonic_ns(), step != 0)
        try:
            self._socket.sendto(f"{number} {step}".encode(), (self.watched[name].guest.address, PORT))
        except OSError:
            pass  # its power is off

    def _take_answer(self) -> None:
        try:
            data = self._socket.recv(65536)
        except OSError:
            return  # nobody listens there
        came = time.monotonic_ns()
        said = json.loads(data)
        asked = self._asked.pop(said["number"], None)
        if asked is None:
            return
        name, left, stepped = asked
        watched = self.watched[name]
        look = Look(came, said["wall"], said["mono"], said["raw"], said["within"], said)
        if stepped:
            watched.steps.append(came)
        watched.lives.setdefault(said["life"], Life()).note(look, left)

    # --- what was seen ---

    def checked(self, kind: str) -> Iterator[Checked]:
        """All statements of a kind (KINDS) beside the truth."""
        for name, watched in self.watched.items():
            for life in watched.lives.values():
                for look in life.looks:
                    for owner, said in statements(look, kind):
                        checked = self._check(name, life, look, owner, said)
                        if checked:
                            yield checked

    def _check(self, reader: str, life: Life, look: Look, owner: str, said: dict[str, Any]
               ) -> Checked | None:
        writer = self.watched[owner].lives.get(said["life"])
        if writer is None:
            return None  # it died before it was seen
        writer_ahead, writer_width = writer.ahead()
        ahead, width = life.ahead()
        wall = life.wall_at(said["raw"] + writer_ahead - ahead, look)
        if wall is None:
            return None  # written before the first look
        return Checked(look.came, reader, owner, said["good"], said["error"], said["time"] - wall[0],
                       width + writer_width + wall[1] + said["within"])

    def true_offsets(self, name: str, reference: str, since: int) -> list[tuple[float, float]]:
        """How far a guest's clock was ahead of another's, and the width, at each quick look of its [ns]."""
        found = []
        own, other = self.watched[name].last, self.watched[reference].last
        (own_ahead, own_width), (other_ahead, other_width) = own.ahead(), other.ahead()
        for look in own.looks:
            raw = look.raw + own_ahead - other_ahead
            index = bisect.bisect_right(other.looks, raw, key=lambda each: each.raw) - 1
            near = other.looks[max(index, 0)]
            if look.came > since and index >= 0 and max(look.within, near.within) < QUICK_NS:
                found.append((look.wall - (near.wall + raw - near.raw),
                              own_width + other_width + (look.within + near.within) / 2))
        return found


# Reads by time; of the newest sample by number; and of all others' samples together.
KINDS = ("by_time", "newest", "joint")
# A program that asks for the time just after its own PC's clock was set has it before dssmd has
# noticed: docs/clocks.md "What is not covered".
NOTICE_NS = 0.25 * SECOND_NS
# And chronyd may have begun to slew a clock that is wrong since it was asked, by as much as a second
# of its maxslewrate (83,333 ppm); same place. Nobody calls the times of such a clock good.
SLEWED_NS = SECOND_NS / 12


def expect_true(truth: Truth) -> None:
    """Everything that DSSM stated holds, and what it called good was within the limit."""
    everything = [each for kind in KINDS for each in truth.checked(kind)]
    stated = [each for each in everything if each.stated >= 0]
    good = [each for each in everything if each.good]
    assert good, "nothing was called good"
    print(f"  | {len(everything)} statements, {len(stated)} with a bound, {len(good)} good; of those with a bound, in"
          f" us: stated {spread(each.stated for each in stated)}; true {spread(abs(each.true) for each in stated)};"
          f" known within {spread(each.width for each in stated)}", flush=True)
    known = statistics.median(each.width for each in good)
    assert known < LIMIT_NS / 2, f"the truth is known within {known / 1e3:.0f} us only"
    slewed = {name for name, watched in truth.watched.items() if watched.steps}
    wrong = [each for each in stated if each.is_false(
        each.stated + (SLEWED_NS if not each.good and {each.reader, each.owner} & slewed else 0))]
    wrong += [each for each in good if not 0 <= each.stated <= LIMIT_NS or each.is_false(LIMIT_NS)]
    unnoticed = [(each.came - step) / 1e6 for each in wrong for step in truth.watched[each.reader].steps
                 if 0 <= each.came - step < NOTICE_NS]
    if unnoticed:
        print(f"  | on the PC whose clock was set, {len(unnoticed)} statements were wrong before its dssmd knew, the"
              f" last one {max(unnoticed):.1f} ms after that", flush=True)
    wrong = [each for each in wrong if not any(0 <= each.came - step < NOTICE_NS
                                               for step in truth.watched[each.reader].steps)]
    assert not wrong, f"{len(wrong)} of {len(everything)} statements are false, the first ones: {wrong[:5]}"


def spread(values_ns: Iterable[float]) -> str:
    """Median and greatest, in us."""
    values = sorted(values_ns)
    return f"median {statistics.median(values) / 1e3:.0f}, max {values[-1] / 1e3:.0f}"


def statements(look: Look, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """What was said of samples in one answer, by their owners."""
    if kind == "joint":
        joint = look.said.get("joint", {})
        for owner, sample in joint.get("samples", {}).items():
            yield owner, {**sample, "good": True, "error": joint["error"]}
        return
    for owner, said in look.said["others"].items():
        if said[kind]["status"] == "ok":
            yield owner, said[kind]


def summary(offsets: Iterable[tuple[float, float]]) -> str:
    """A row of the paper's Table I: average, maximum, minimum and standard deviation of the size."""
    pairs = list(offsets)
    sizes = [abs(offset) / 1e3 for offset, _ in pairs]
    return (f"average {statistics.fmean(sizes):.1f} us, max {max(sizes):.1f}, min {min(sizes):.1f}, std dev"
            f" {statistics.pstdev(sizes):.1f}, of {len(sizes)}, known within {max(width for _, width in pairs) / 1e3:.1f}")
