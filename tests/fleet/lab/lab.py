# SPDX-License-Identifier: Apache-2.0
"""The lab that a scenario gets: guests, their network, and actions on all of them."""

import concurrent.futures
import json
import os
import pathlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from lab.guest import Guest
from lab.image import Image
from lab.network import Network, guest_address, guest_name
from lab.packages import PROGRAMS_FOLDER, RECORDING, Artifacts
from lab.playbooks import Playbooks, Played
from lab.ssh import write_config
from lab.timing import Timing

T = TypeVar("T")
GUESTS = 3
TIMEOUT_SECONDS = 60  # for events that must happen even on a busy machine


class Lab:
    """Three PCs on one switch, pc1 to pc3, initially off. Its folder is in memory."""

    def __init__(self, image: Image, artifacts: Artifacts, timing: Timing, folder: pathlib.Path
                 ) -> None:
        self.network = Network(GUESTS)
        numbers = range(1, GUESTS + 1)
        self.ssh_config = write_config(folder, image, {guest_name(number): guest_address(number)
                                                       for number in numbers})
        self.guests = [Guest(number, image, artifacts.preload, folder, self.ssh_config)
                       for number in numbers]
        self.artifacts = artifacts
        self.playbooks = Playbooks(folder, self.ssh_config, self.guests)
        self.timing = timing
        self.folder = folder
        self._is_vehicle = False
        self.all_cores = os.sched_getaffinity(0)
        # Concurrent runs use different cores.
        self._core = sorted(self.all_cores)[folder.stat().st_ino % len(self.all_cores)]

    def __getitem__(self, name: str) -> Guest:
        """The guest of that name."""
        return next(guest for guest in self.guests if guest.name == name)

    def on_all(self, action: Callable[[Guest], T]) -> list[T]:
        """Calls `action` for all guests at the same time; returns the results in their order."""
        with concurrent.futures.ThreadPoolExecutor(len(self.guests)) as pool:
            return list(pool.map(action, self.guests))

    @contextmanager
    def spread(self) -> Iterator[None]:
        """Gives the guests all cores for heavy work. Otherwise they share one: User Mode Linux
        switches between host processes at each system call, which is cheapest on one core."""
        try:
            for guest in self.guests:
                guest.pin(self.all_cores)
            yield
        finally:
            for guest in self.guests:
                guest.pin({self._core})

    def boot(self) -> None:
        """Switches all guests on and waits until they are up."""
        for guest in self.guests:
            guest.power_on(self.all_cores)
        with self.spread():
            self.on_all(Guest.await_running)

    def shut_down(self) -> None:
        """Cuts the power of all guests."""
        for guest in self.guests:
            guest.power_off()

    def install_programs(self) -> None:
        """Copies the files that only tests need: their programs, the example's programs, the recording."""
        def install(guest: Guest) -> None:
            guest.ssh.put([*self.artifacts.programs, RECORDING], PROGRAMS_FOLDER)
            guest.ssh.run("sync")  # the PC keeps only this after a power loss

        self.on_all(install)

    def deploy(self) -> Played:
        """Runs site.yml, which makes the PCs a vehicle if they are not."""
        with self.spread():
            played = self.playbooks.play("site.yml", self.artifacts.packages)
            self._is_vehicle = True
            self.on_all(lambda guest: guest.ssh.run("sync"))
            return played

    def reset(self) -> None:
        """Replaces the PCs after a failed scenario by newly deployed ones with fresh disks."""
        self.replace_by_bare()
        self.install_programs()
        self.deploy()

    def replace_by_bare(self) -> None:
        """Replaces the PCs by bare ones with fresh disks."""
        for guest in self.guests:
            guest.ssh.abandon()
        self.shut_down()
        self._is_vehicle = False
        self.network.join()
        for guest in self.guests:
            self.network.plug(guest.number)
            guest.wipe()
        self.boot()

    def check_tidy(self) -> None:
        """Fails if a passed scenario has left programs or streams behind."""
        left = {guest.name: running for guest in self.guests if (running := guest.ssh.abandon())}
        assert not left, f"the scenario has left programs running: {left}"
        if self._is_vehicle:
            self.await_streams()
        self.on_all(Guest.await_running)

    def streams(self, guest: Guest) -> dict[str, dict[str, Any]]:
        """The output of `dssmctl ls` there, by full name."""
        listed = json.loads(guest.ssh.run("dssmctl ls --json"))["streams"]
        return {stream["stream"]: stream for stream in listed}

    def await_streams(self, *names: str, on: list[Guest] | None = None) -> float:
        """Waits until each guest lists exactly these streams; returns how long that took [s]."""
        started = time.monotonic()
        for guest in on or self.guests:
            await_that(f"{guest.name} lists exactly {', '.join(sorted(names)) or 'nothing'}",
                       lambda guest=guest: (set(found := self.streams(guest)) == set(names),
                                            sorted(found)))
        return time.monotonic() - started


def await_that(what: str, check: Callable[[], tuple[bool, object]],
               seconds: float = TIMEOUT_SECONDS) -> None:
    """Polls `check` until its first result is True; the second result is for the error's text."""
    deadline = time.monotonic() + seconds
    while True:
        true, seen = check()
        if true:
            return
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {seconds:.0f} s: {what}; last seen: {seen}")
        time.sleep(0.05)
