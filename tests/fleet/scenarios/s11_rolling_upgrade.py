# SPDX-License-Identifier: Apache-2.0
"""A rolling upgrade under load loses no sample, and stops at a PC that fails its check

It stops after a PC that fails its check after the upgrade, and does not begin while a PC fails it.
Then all PCs are upgraded, one at a time, while each has a writer at 1 kHz and readers of all three.
"""

import pathlib

from lab.dssmd import await_new_samples, main_pid
from lab.guest import Guest
from lab.lab import Lab
from lab.load import Load, expect_complete
from lab.packages import repack
from lab.playbooks import Played
from lab.timing import PART

# Four runs of Ansible, which take much longer on UML guests than on PCs.
ONLY_BY_NAME = "it takes as long as all other scenarios together"
STREAMS = [f"upgraded:0@pc{number}" for number in (1, 2, 3)]
# With this file dssmd runs without errors, but neither finds other hosts nor is found by them.
ISOLATED = {"/lib/systemd/system/dssmd.service.d/isolated.conf": """[Service]
ExecStart=
ExecStart=/usr/sbin/dssmd --config /etc/dssm/dssmd.conf --mdns=false
"""}
SOON = "dssm_verify_timeout=5"
# Skips the clock configuration, which site.yml (s01) has done.
QUICK = ("-e", "dssm_chrony=false")


def run(lab: Lab) -> None:
    """Fails to upgrade, downgrades, and upgrades."""
    before = versions(lab)
    with lab.timing.step(PART + "an upgrade that must stop"):
        stops_at_the_first(lab, repack(lab.artifacts.packages, lab.folder / "isolated", "+1", ISOLATED), before)
    better = repack(lab.artifacts.packages, lab.folder / "better", "+2")
    with lab.timing.step(PART + "an upgrade that must not begin"):
        does_not_begin(lab, better)
    with lab.timing.step(PART + "the downgrade"), lab.spread():
        # upgrade.yml checks the result.
        lab.playbooks.play("site.yml", lab.artifacts.packages, *QUICK, "-e", "dssm_allow_downgrade=true",
                           "-e", "dssm_verify=false", "-l", "pc1")
    assert versions(lab) == before
    upgrades_under_load(lab, better)


def stops_at_the_first(lab: Lab, packages: pathlib.Path, before: list[str]) -> None:
    """pc1 is upgraded and fails its check, so the others stay unchanged."""
    running = [main_pid(guest) for guest in lab.guests]
    played = upgrade(lab, packages, "-e", SOON)
    assert not played.succeeded and "pc1 does not see pc2, pc3" in played.output, played.output
    assert versions(lab) == [before[0] + "+1", *before[1:]]
    assert [main_pid(guest) for guest in lab.guests[1:]] == running[1:]


def does_not_begin(lab: Lab, packages: pathlib.Path) -> None:
    """pc1 fails its check, so no PC is changed."""
    before = versions(lab)
    played = upgrade(lab, packages, "-e", SOON)
    assert not played.succeeded, played.output
    assert versions(lab) == before
    assert set(played.changed().values()) == {0}, played.output


def upgrades_under_load(lab: Lab, packages: pathlib.Path) -> None:
    """All three get the new version and lose nothing."""
    before = versions(lab)
    running = [main_pid(guest) for guest in lab.guests]
    writers = [Load(guest, "write", [stream]).await_ready()
               for guest, stream in zip(lab.guests, STREAMS)]
    readers = {guest.name: Load(guest, "read", STREAMS).await_ready() for guest in lab.guests}
    with lab.timing.step(PART + "upgrade.yml under load"):
        played = upgrade(lab, packages)
    assert played.succeeded, played.output
    # One batch per PC.
    assert played.output.count("TASK [dssm : Install the .deb files]") == len(lab.guests), played.output
    for stream, owner in zip(STREAMS, lab.guests):
        await_new_samples([stream], *(guest for guest in lab.guests if guest is not owner))
    written = {"written": {stream: count for writer in writers
                           for stream, count in writer.finish()["written"].items()}}
    for name, reader in readers.items():
        expect_complete(written, reader.finish(), f"reader on {name}")
    assert versions(lab) == [version + "+2" for version in before]
    assert not set(running) & {main_pid(guest) for guest in lab.guests}
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm upgraded")
    lab.await_streams()


def upgrade(lab: Lab, packages: pathlib.Path, *options: str) -> Played:
    """Runs upgrade.yml; the caller checks the result."""
    with lab.spread():
        return lab.playbooks.attempt("upgrade.yml", packages, *QUICK, *options)


def versions(lab: Lab) -> list[str]:
    """The installed version of dssmd on each PC."""
    def ask(guest: Guest) -> str:
        return guest.ssh.run("dpkg-query --show --showformat='${Version}' dssmd")

    return lab.on_all(ask)
