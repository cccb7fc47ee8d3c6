# SPDX-License-Identifier: Apache-2.0
"""A second run of the playbook, while programs write, changes nothing"""

from lab.lab import Lab
from lab.load import Load


def run(lab: Lab) -> None:
    """Deploys again; the writers lose nothing."""
    writers = [Load(guest, "write", [f"again@{guest.name}"], rate_hz=10) for guest in lab.guests]
    for writer in writers:
        writer.await_ready()
    again = lab.deploy()
    assert again.changed() == {guest.name: 0 for guest in lab.guests}, again.output
    for writer in writers:
        writer.finish()
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm again")
