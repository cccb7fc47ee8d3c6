# SPDX-License-Identifier: Apache-2.0
"""The true values of the guests' clocks, measured from outside, and DSSM's statements about them.

Queries each guest's fleet-clock (fleet_clock.cpp) some 30 times a second. An answer contains the
clocks of the guest and statements about the samples of the others; each sample contains the clocks of
its writer.

The reference is this machine's monotonic clock. A User Mode Linux kernel derives its
CLOCK_MONOTONIC_RAW from it, so the difference of the two is constant after the boot. A guest reads its
clocks between the time at which a request is sent and the time at which the answer is received; all
answers together bound that difference. So a computed clock value has a width, and a statement is false
only if it is false for all values within that width.
"""

import bisect
import collections
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
CALIBRATION = 300  # requests to each guest, one after the other, at the start
MAX_PENDING = 300  # requests that wait for an answer
QUICK_NS = 150_000  # slower readings of a guest's clocks are not used as measurements
LIMIT_NS = 1_500_000  # dssmd's default clock_limit
NEAR_NS = LIMIT_NS / 3
NEAR_SECONDS = 5  # longer than a sample counts by what was measured before
STEADY_SECONDS = 1.5  # recovered after this time with good statements only
RECOVERY_SECONDS = 180
SECOND_NS = 10**9


@dataclasses.dataclass
class Observation:
    """A guest's clocks, all in ns, and the answer that contains them."""

    came: int  # when the answer was received
    wall: int
    mono: int
    raw: int
    within: int
    answer: dict[str, Any]

    def status_of(self, owner: str) -> str:
        """The status of a read by time of another guest's samples; "closed": the stream is not open yet."""
        status: str = self.answer["others"].get(owner, {"by_time": {"status": "closed"}})["by_time"]["status"]
        return status

    def bound_of(self, owner: str) -> int:
        """The bound of such a read whose status is "ok"; 0: unknown."""
        bound: int = self.answer["others"][owner]["by_time"]["error"]
        return max(bound, 0)


@dataclasses.dataclass
class Offset:
    """How far a guest's clock was ahead of another's. In ns."""

    came: int
    ns: float
    width: float


@dataclasses.dataclass
class Checked:
    """A statement on the PC `reader` about a sample of `owner`, with the true value. In ns."""

    came: int
    reader: str
    owner: str
    good: bool
    stated: int  # -1: unknown
    true: float  # the sample's time minus that PC's
    width: float

    def is_false(self, claim: int) -> bool:
        """Whether the true value certainly exceeds `claim`."""
        return abs(self.true) - self.width > claim


class ProgramRun:
    """The observations of one run of fleet-clock."""

    def __init__(self) -> None:
        self.observations: list[Observation] = []
        self._ahead_min, self._ahead_max = -math.inf, math.inf

    def add(self, observation: Observation, sent: int) -> None:
        """Adds the answer to a request that was sent at `sent`."""
        self._ahead_min = max(self._ahead_min, sent - observation.raw - observation.within)
        self._ahead_max = min(self._ahead_max, observation.came - observation.answer["raw_end"])
        if not self.observations or self.observations[-1].raw < observation.raw:
            self.observations.append(observation)

    def ahead(self) -> tuple[float, float]:
        """This machine's monotonic clock minus the guest's raw one, and its width."""
        assert self._ahead_min <= self._ahead_max, (
            "the guest's raw clock and this machine's clock drift: their difference is at least"
            f" {self._ahead_min:.0f} ns by one answer and at most {self._ahead_max:.0f} ns by another, within"
            f" {(self.observations[-1].came - self.observations[0].came) / SECOND_NS:.0f} s")
        return ((self._ahead_min + self._ahead_max) / 2, (self._ahead_max - self._ahead_min) / 2)

    def wall_at(self, raw: float, observation: Observation) -> tuple[float, float] | None:
        """The wall clock of `observation` at the raw time `raw`, and its width: by how much the PC slewed in
        between."""
        index = bisect.bisect_right(self.observations, raw, key=lambda each: each.raw) - 1
        if index < 0:
            return None
        before = self.observations[index]
        slewed = abs((observation.mono - before.mono) - (observation.raw - before.raw))
        return observation.wall - (observation.raw - raw), observation.within + slewed


class Watched:
    """The observations of one guest."""

    def __init__(self, guest: Guest) -> None:
        self.guest = guest
        self.runs: dict[int, ProgramRun] = {}
        self.steps: list[int] = []  # when this harness set its clock

    @property
    def last(self) -> ProgramRun:
        """The current run."""
        return next(reversed(self.runs.values())) if self.runs else ProgramRun()


class Truth:
    """Observes the guests within `with watching()`; the results are checked afterwards."""

    def __init__(self, guests: Iterable[Guest]) -> None:
        self.watched = {guest.name: Watched(guest) for guest in guests}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._asked: dict[int, tuple[str, int, bool]] = {}  # by number: guest, when [ns], to step
        self._numbers = itertools.count()
        self._steps: list[tuple[str, int]] = []  # to request
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
        """Runs fleet-clock on all guests and queries them until the end of the block."""
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

    def await_good(self, *names: str, bound_ns: int = LIMIT_NS) -> int:
        """Waits until these guests, or all, have accepted each other's samples for STEADY_SECONDS and stated
        at most this bound, and returns when that began."""
        begin = time.monotonic_ns()
        wanted = names or tuple(self.watched)

        def check() -> tuple[bool, object]:
            bad, since = self._last_not_good(wanted, begin, bound_ns)
            return time.monotonic_ns() - since > STEADY_SECONDS * SECOND_NS, bad

        await_that(f"{', '.join(wanted)} accept each other's clocks", check, RECOVERY_SECONDS)
        return self._last_not_good(wanted, begin, bound_ns)[1]

    def await_refused(self, owner: str, since: int) -> float:
        """Waits until a read by time of a guest's samples is refused on another PC; returns the seconds from
        `since` to the first refusal."""
        def refused() -> list[int]:
            return [observation.came for name, watched in self.watched.items() if name != owner
                    for observation in reversed(watched.last.observations) if observation.came > since
                    and observation.status_of(owner) == "clock_out_of_bounds"]

        await_that(f"reads of {owner}'s samples by time are refused", lambda: (bool(refused()), None))
        return (min(refused()) - since) / SECOND_NS

    def statuses(self, reader: str, owner: str, since: int) -> dict[str, int]:
        """How often reads of `owner`'s samples had each status since then."""
        return dict(collections.Counter(observation.status_of(owner) for observation in self.watched[reader].last.observations
                                        if observation.came > since))

    def refuses(self, reader: str, owner: str) -> bool:
        """Whether the last read of `owner`'s samples was refused."""
        observations = self.watched[reader].last.observations
        return bool(observations) and observations[-1].status_of(owner) == "clock_out_of_bounds"

    def share_good(self, reader: str, owner: str, since: int) -> float:
        """The share of good reads of `owner`'s samples since then."""
        statuses = self.statuses(reader, owner, since)
        return statuses.get("ok", 0) / max(sum(statuses.values()), 1)

    def refused_while_near(self, reader: str, owner: str, since: int) -> list[str]:
        """The reads of `owner`'s samples that were refused since then, although both clocks had been within
        NEAR_NS of each other for NEAR_SECONDS: when, and what was stated about the newest sample."""
        far = [offset.came for offset in self.true_offsets(reader, owner, since - NEAR_SECONDS * SECOND_NS)
               if abs(offset.ns) > NEAR_NS]
        refused = [observation for observation in self.watched[reader].last.observations
                   if observation.came > since and observation.status_of(owner) == "clock_out_of_bounds"]
        return [f"on {reader} at {each.came / SECOND_NS:.2f} s, newest {each.answer['others'][owner]['newest']}"
                for each in refused if bisect.bisect_left(far, each.came - NEAR_SECONDS * SECOND_NS)
                == bisect.bisect_right(far, each.came)]

    def unnoticed_steps(self, reader: str) -> list[tuple[int, float]]:
        """From when to when the dssmd there may not have noticed that its clock was set: until reads are refused."""
        refused = sorted(each.came for run in self.watched[reader].runs.values() for each in run.observations
                         if any(each.status_of(owner) == "clock_out_of_bounds" for owner in each.answer["others"]))
        spans = []
        for step in self.watched[reader].steps:
            index = bisect.bisect_right(refused, step)
            first = refused[index] if index < len(refused) else math.inf
            spans.append((step, min(first, step + NOTICE_NS)))
        return spans

    def longest_silence(self) -> float:
        """The longest time [s] in which a guest did not answer: because this machine is busy, for example."""
        return max(after.came - before.came for watched in self.watched.values() for run in watched.runs.values()
                   for before, after in itertools.pairwise(run.observations)) / SECOND_NS

    def count(self) -> int:
        """How many statements were observed."""
        return sum(1 for watched in self.watched.values() for run in watched.runs.values()
                   for observation in run.observations for kind in KINDS for _ in statements(observation, kind))

    def _last_not_good(self, names: Iterable[str], begin: int, bound_ns: int) -> tuple[str, int]:
        last = ("nothing", begin)
        for name in names:
            observations = self.watched[name].last.observations
            if not observations or observations[-1].came < time.monotonic_ns() - SECOND_NS:
                return f"{name} does not answer", time.monotonic_ns()
            for owner in names:
                for observation in reversed(observations) if owner != name else ():
                    if observation.came < last[1]:
                        break
                    status = observation.status_of(owner)
                    if status == "ok" and observation.bound_of(owner) > bound_ns:
                        status = f"within {observation.bound_of(owner)} ns"
                    if status != "ok":
                        last = (f"{name} reads {owner}: {status}", observation.came)
                        break
        return last

    def _calibrate(self, name: str) -> None:
        """Sends many requests; the quickest answer gives the smallest width."""
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
        self._asked.pop(number - MAX_PENDING, None)
        self._asked[number] = (name, time.monotonic_ns(), step != 0)
        try:
            self._socket.sendto(f"{number} {step}".encode(), (self.watched[name].guest.address, PORT))
        except OSError:
            pass  # its power is off

    def _take_answer(self) -> None:
        try:
            data = self._socket.recv(65536)
        except OSError:
            return  # no program listens there
        came = time.monotonic_ns()
        answer = json.loads(data)
        asked = self._asked.pop(answer["number"], None)
        if asked is None:
            return
        name, sent, stepped = asked
        watched = self.watched[name]
        observation = Observation(came, answer["wall"], answer["mono"], answer["raw"], answer["within"], answer)
        if stepped:
            watched.steps.append(came)
        watched.runs.setdefault(answer["instance"], ProgramRun()).add(observation, sent)

    # --- results ---

    def checked(self, kind: str) -> Iterator[Checked]:
        """All statements of a kind (KINDS), with the true values."""
        for name, watched in self.watched.items():
            for run in watched.runs.values():
                for observation in run.observations:
                    for owner, statement in statements(observation, kind):
                        checked = self._check(name, run, observation, owner, statement)
                        if checked:
                            yield checked

    def _check(self, reader: str, run: ProgramRun, observation: Observation, owner: str, statement: dict[str, Any]
               ) -> Checked | None:
        writer = self.watched[owner].runs.get(statement["instance"])
        if writer is None:
            return None  # it ended before it was observed
        writer_ahead, writer_width = writer.ahead()
        ahead, width = run.ahead()
        wall = run.wall_at(statement["raw"] + writer_ahead - ahead, observation)
        if wall is None:
            return None  # written before the first observation
        return Checked(observation.came, reader, owner, statement["good"], statement["error"],
                       statement["time"] - wall[0],
                       width + writer_width + wall[1] + statement["within"])

    def true_offsets(self, name: str, reference: str, since: int) -> list[Offset]:
        """The offset of a guest's clock from another's at each quick observation."""
        found = []
        own, other = self.watched[name].last, self.watched[reference].last
        (own_ahead, own_width), (other_ahead, other_width) = own.ahead(), other.ahead()
        for observation in own.observations:
            raw = observation.raw + own_ahead - other_ahead
            index = bisect.bisect_right(other.observations, raw, key=lambda each: each.raw) - 1
            near = other.observations[max(index, 0)]
            if observation.came > since and index >= 0 and max(observation.within, near.within) < QUICK_NS:
                found.append(Offset(observation.came, observation.wall - (near.wall + raw - near.raw),
                                    own_width + other_width + (observation.within + near.within) / 2))
        return found


# Reads by time; of the newest sample; and of all others' samples together.
KINDS = ("by_time", "newest", "joint")
# Just after this PC's clock was set, a program may read the time before dssmd has noticed the step, which
# is when reads there are refused: docs/clocks.md "What is not covered". At most:
NOTICE_NS = 0.25 * SECOND_NS
# And after its last answer, chronyd may have slewed a wrong clock for a second at its maxslewrate
# (83,333 ppm); same section. The times of such a clock are never accepted.
SLEWED_NS = SECOND_NS / 12


def expect_true(truth: Truth) -> None:
    """Checks that all statements of DSSM are true, and that accepted samples were within the limit."""
    everything = [each for kind in KINDS for each in truth.checked(kind)]
    stated = [each for each in everything if each.stated >= 0]
    good = [each for each in everything if each.good]
    assert good, "no sample was accepted"
    print(f"  | {len(everything)} statements, {len(stated)} with a bound, {len(good)} good; of those with a bound, in"
          f" us: stated {spread(each.stated for each in stated)}; true {spread(abs(each.true) for each in stated)};"
          f" known within {spread(each.width for each in stated)}", flush=True)
    known = statistics.median(each.width for each in good)
    assert known < LIMIT_NS / 2, f"the true values are only known within {known / 1e3:.0f} us"
    wrong = [each for each in stated if each.is_false(
        each.stated + (SLEWED_NS if not each.good and is_slewed(truth, each) else 0))]
    wrong += [each for each in good if not 0 <= each.stated <= LIMIT_NS or each.is_false(LIMIT_NS)]
    unnoticed = {reader: truth.unnoticed_steps(reader) for reader in truth.watched}
    late = {id(each): each.came - begin for each in wrong for begin, end in unnoticed[each.reader]
            if begin <= each.came <= end}
    if late:
        print(f"  | on the PC whose clock was set, {len(late)} statements were wrong before its dssmd noticed, the"
              f" last one {max(late.values()) / 1e6:.1f} ms after that", flush=True)
    wrong = [each for each in wrong if id(each) not in late]
    groups: dict[tuple[str, str, bool], list[Checked]] = {}
    for each in wrong:
        groups.setdefault((each.reader, each.owner, each.good), []).append(each)
    assert not wrong, f"{len(wrong)} of {len(everything)} statements are false: " + "; ".join(
        f"on {reader} about {owner}, {'good' if good else 'not good'}: {len(found)} from"
        f" {found[0].came / SECOND_NS:.2f} to {found[-1].came / SECOND_NS:.2f} s, for example {found[0]}"
        for (reader, owner, good), found in groups.items())


def is_slewed(truth: Truth, checked: Checked) -> bool:
    """Whether one of both clocks may still be slewed: after it was set, or the reference that it follows."""
    return any(0 <= checked.came - step < RECOVERY_SECONDS * SECOND_NS / 2
               for watched in truth.watched.values() for step in watched.steps)


def spread(values_ns: Iterable[float]) -> str:
    """Median and greatest, in us."""
    values = sorted(values_ns)
    return f"median {statistics.median(values) / 1e3:.0f}, max {values[-1] / 1e3:.0f}"


def statements(observation: Observation, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """The statements about samples in one answer, by their owners."""
    if kind == "joint":
        joint = observation.answer.get("joint", {})
        for owner, sample in joint.get("samples", {}).items():
            yield owner, {**sample, "good": True, "error": joint["error"]}
        return
    for owner, answers in observation.answer["others"].items():
        if answers[kind]["status"] == "ok":
            yield owner, answers[kind]


def summary(offsets: list[Offset]) -> str:
    """A row of the paper's Table I: average, maximum, minimum and standard deviation of the size."""
    sizes = [abs(offset.ns) / 1e3 for offset in offsets]
    return (f"average {statistics.fmean(sizes):.1f} us, max {max(sizes):.1f}, min {min(sizes):.1f}, std dev"
            f" {statistics.pstdev(sizes):.1f}, of {len(sizes)}, known within {max(offset.width for offset in offsets) / 1e3:.1f}")
