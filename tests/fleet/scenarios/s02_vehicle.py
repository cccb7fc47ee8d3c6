# SPDX-License-Identifier: Apache-2.0
"""The vehicle over three PCs draws the same map, bit for bit, as on one

As in the paper: the encoder on pc1, LIDAR and localizer on pc2, the mapper on pc3.
"""

import hashlib
import subprocess

from lab.guest import Guest
from lab.lab import Lab
from lab.packages import PROGRAMS_FOLDER, RECORDING

# Rings hold the whole drive; readers wait for missing samples and fail if a sample was lost.
SOURCE = (f"--log {PROGRAMS_FOLDER}/{RECORDING.name} --to 60 --life 1000 --stamps recording --speed 0")
LOCALIZER = "localizer --late --complete --deadline 600"
MAPPER = "mapper --late --complete --deadline 600 --timeout 600 --out /tmp/map.png"
COMMANDS = (f"encoder {SOURCE}", f"lidar {SOURCE}", LOCALIZER, MAPPER)
STREAMS = ("odometry", "lidar", "pose")


def run(lab: Lab) -> None:
    """Draws the map twice and compares."""
    pc1, pc2, pc3 = lab.guests
    over_three = drive([pc1, pc2, pc2, pc3])
    for guest in (pc1, pc2):
        guest.ssh.run(f"for stream in {' '.join(STREAMS)}; do dssmctl rm $stream@{guest.name}; done; true")
    lab.await_streams()
    on_one = drive([pc3] * 4)
    assert len(on_one) > 1000, "the map is empty"
    assert over_three == on_one, (f"the maps differ: {hashlib.sha256(over_three).hexdigest()} from "
                                  f"three PCs, {hashlib.sha256(on_one).hexdigest()} from one")
    pc3.ssh.run(f"for stream in {' '.join(STREAMS)}; do dssmctl rm $stream; done")
    lab.await_streams()


def drive(places: list[Guest]) -> bytes:
    """Runs the four programs, each on its PC, and returns the map that they draw."""
    running: list[tuple[Guest, str, subprocess.Popen[str]]] = []
    for guest, command in zip(places, COMMANDS):
        running.append((guest, command, guest.ssh.start(f"{PROGRAMS_FOLDER}/{command}")))
    for guest, command, process in running:
        out, err = process.communicate(timeout=180)
        assert process.returncode == 0, (f"{guest.name}: '{command}' ended with {process.returncode}:\n"
                                         f"{out}{err}")
    return places[-1].ssh.read("cat /tmp/map.png")
