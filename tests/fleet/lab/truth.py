# SPDX-License-Identifier: Apache-2.0
"""The clocks of the guests as they are, measured from outside, and what DSSM states about them.

Asks each guest's fleet-clock (fleet_clock.cpp) some 30 times a second. An answer holds both clocks of
the guest, and statements about the samples of the others; each sample holds both clocks of its
writer. This machine's monotonic clock is what all are compared with: a question that left at t1 and
whose answer was there at t2 was answered in between, so what is computed of a clock has a width, half
a round trip, and a statement is called false only when it is for all values within.
"""

import bisect
import dataclasses
import itertools
import json
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
MOST_ASKED = 300  # questions whose answers may still come
LIMIT_NS = 1_500_000  # dssmd's default clock_limit
STEADY_SECONDS = 1.5  # without one statement that is not good: recovered
SECOND_NS = 10**9


@dataclasses.dataclass
class Look:
    """A guest's clocks at the moment `at` of this machine's clock, all in ns."""

    at: float
    width: float  # half of what `at` may be off
    wall: int
    mono: int
    said: dict[str, Any]


@dataclasses.dataclass
class Checked:
    """A statement about a sample of `owner` made on the PC `reader`, beside the truth. In ns."""

    at: float
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
    """What was seen of one run of fleet-clock: within it the monotonic clock goes on."""

    def __init__(self) -> None:
        self.looks: list[Look] = []

    def at_mono(self, mono: int) -> tuple[float, float] | None:
        """This machine's time when the guest's monotonic clock showed `mono`, and its width."""
        index = bisect.bisect_right(self.looks, mono, key=lambda look: look.mono)
        return self._between(index, lambda a, b: (mono - a.mono) / (b.mono - a.mono),
                             lambda a, b, part: a.at + part * (b.at - a.at))

    def mono_at(self, at: float) -> tuple[float, float] | None:
        """The guest's monotonic clock at a time of this machine, and its width."""
        index = bisect.bisect_right(self.looks, at, key=lambda look: look.at)
        return self._between(index, lambda a, b: (at - a.at) / (b.at - a.at),
                             lambda a, b, part: a.mono + part * (b.mono - a.mono))

    def _between(self, index: int, part_of: Any, value_of: Any) -> tuple[float, float] | None:
        if not 0 < index < len(self.looks):
            return None
        before, after = self.looks[index - 1], self.looks[index]
        # While chronyd slews, the guest's second is not this machine's, and where that began within
        # the interval is not known.
        bend = abs((after.mono - before.mono) - (after.at - before.at))
        part = part_of(before, after)
        return value_of(before, after, part), max(before.width, after.width) + bend


class Watched:
    """What was seen of one guest."""

    def __init__(self, guest: Guest) -> None:
        self.guest = guest
        self.lives: dict[int, Life] = {}
        self.steps: list[float] = []  # when its clock was set from here

    @property
    def looks(self) -> list[Look]:
        """Those of the last life."""
        return next(reversed(self.lives.values())).looks if self.lives else []


class Truth:
    """Watches from `with watching()` on; what it saw is judged after that."""

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

    def step(self, guest: Guest, ns: int) -> float:
        """Sets a guest's clock forward by `ns`; returns when that was."""
        steps = self.watched[guest.name].steps
        before = len(steps)
        self._steps.append((guest.name, ns))
        await_that(f"{guest.name}'s clock is set", lambda: (len(steps) > before, len(steps)))
        return steps[-1]

    def now(self) -> float:
        """A moment, for since= below."""
        return float(time.monotonic_ns())

    def await_good(self, *names: str) -> float:
        """Waits until these guests have called each other's samples good for a while, and returns when that
        began."""
        begin = self.now()
        wanted = names or tuple(self.watched)

        def look() -> tuple[bool, object]:
            bad, since = self._last_not_good(wanted, begin)
            return self.now() - since > STEADY_SECONDS * SECOND_NS, bad

        await_that(f"{', '.join(wanted)} call each other's clocks good", look, 180)
        return self._last_not_good(wanted, begin)[1]

    def _last_not_good(self, names: Iterable[str], begin: float) -> tuple[str, float]:
        last = ("nothing", begin)
        for name in names:
            looks = self.watched[name].looks
            if not looks or looks[-1].at < self.now() - SECOND_NS:
                return f"{name} does not answer", self.now()
            for other in names:
                if other == name:
                    continue
                for look in reversed(looks):
                    if look.at < last[1]:
                        break
                    said = look.said["others"].get(other, {"by_time": {"status": "not open"}})["by_time"]
                    if said["status"] != "ok":
                        last = (f"{name} reads {other}: {said['status']}", look.at)
                        break
        return last

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
        spent = said["mono_end"] - said["mono"]
        width = max(0, came - left - spent) / 2 + said["within"] / 2
        look = Look(left + width, width, said["wall"], said["mono"], said)
        if stepped:
            watched.steps.append(look.at)
        looks = watched.lives.setdefault(said["life"], Life()).looks
        if not looks or (looks[-1].at < look.at and looks[-1].mono < look.mono):
            looks.append(look)

    # --- what was seen ---

    def checked(self, kind: str, since: float = 0) -> Iterator[Checked]:
        """All statements of a kind ("by_time", "newest", "joint") beside the truth."""
        for name, watched in self.watched.items():
            for life in watched.lives.values():
                for look in life.looks:
                    for owner, said in statements(look, kind) if look.at >= since else ():
                        checked = self._check(name, life, look, owner, said)
                        if checked:
                            yield checked

    def _check(self, reader: str, life: Life, look: Look, owner: str, said: dict[str, Any]
               ) -> Checked | None:
        writer = self.watched[owner].lives.get(said["life"])
        written = writer and writer.at_mono(said["mono"])
        then = written and life.mono_at(written[0])
        if not written or not then:
            return None  # before the first look, or after the last
        wall_then = look.wall - (look.mono - then[0])
        width = written[1] + then[1] + said["within"]
        return Checked(look.at, reader, owner, said["good"], said["error"],
                       said["time"] - wall_then, width)

    def true_offsets(self, name: str, reference: str, since: float = 0) -> list[tuple[float, float]]:
        """How far a guest's clock was ahead of another's, and the width, at each look of its [ns]."""
        found = []
        looks = self.watched[reference].looks
        for look in self.watched[name].looks:
            index = bisect.bisect_right(looks, look.at, key=lambda each: each.at)
            if look.at < since or not 0 < index < len(looks):
                continue
            near = looks[index - 1]
            found.append((look.wall - near.wall - (look.at - near.at), look.width + near.width))
        return found


KINDS = ("by_time", "newest", "joint")
# A program that asks for the time just after its own PC's clock was set has it before dssmd has
# noticed: docs/clocks.md "What is not covered".
NOTICE_NS = 0.25 * SECOND_NS


def expect_true(truth: Truth) -> None:
    """Everything that DSSM stated holds, and what it called good was within the limit."""
    everything = [each for kind in KINDS for each in truth.checked(kind)]
    stated = [each for each in everything if each.stated >= 0]
    good = [each for each in everything if each.good]
    assert good, "nothing was called good"
    print(f"  | {len(everything)} statements, {len(stated)} with a bound, {len(good)} good; medians: bound"
          f" {_median_us(each.stated for each in stated)} us, true {_median_us(abs(each.true) for each in stated)}"
          f" us, known within {_median_us(each.width for each in stated)} us; the worst used"
          f" {max((abs(each.true) - each.width) / max(each.stated, 1) for each in stated):.2f} of its bound", flush=True)
    assert statistics.median(each.width for each in good) < LIMIT_NS / 3, "the truth is not known well enough"
    wrong = [each for each in stated if each.is_false(each.stated)]
    wrong += [each for each in good if not 0 <= each.stated <= LIMIT_NS or each.is_false(LIMIT_NS)]
    late = [(each.at - step) / 1e6 for each in wrong
            for step in truth.watched[each.reader].steps if 0 <= each.at - step < NOTICE_NS]
    if late:
        print(f"  | on a PC whose own clock was set, {len(late)} statements were wrong until dssmd knew, the last"
              f" {max(late):.1f} ms after that", flush=True)
    wrong = [each for each in wrong if not any(
        0 <= each.at - step < NOTICE_NS for step in truth.watched[each.reader].steps)]
    assert not wrong, f"{len(wrong)} of {len(everything)} statements are false, the first ones: {wrong[:5]}"


def _median_us(values: Iterable[float]) -> str:
    found = list(values)
    return f"{statistics.median(found) / 1e3:.0f}" if found else "-"


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


def refused_since(truth: Truth, owner: str, since: float) -> float:
    """After how many seconds the first reading of a PC's samples elsewhere was refused."""
    refusals = [look.at for name, watched in truth.watched.items() if name != owner
                for look in watched.looks if look.at > since
                and look.said["others"].get(owner, {"by_time": {"status": ""}})["by_time"]["status"]
                == "clock_out_of_bounds"]
    assert refusals, f"no reading of {owner}'s samples was refused"
    return (min(refusals) - since) / SECOND_NS


def summary(offsets: Iterable[float]) -> str:
    """A row of the paper's Table I: average, maximum, minimum and standard deviation of the size."""
    sizes = [abs(offset) / 1e3 for offset in offsets]
    return (f"average {statistics.fmean(sizes):.1f} us, max {max(sizes):.1f}, min {min(sizes):.1f},"
            f" sd {statistics.pstdev(sizes):.1f}, n {len(sizes)}")
