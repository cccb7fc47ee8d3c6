# SPDX-License-Identifier: Apache-2.0
"""From three bare PCs to a vehicle on which every PC lists every stream

Nothing is configured but where to listen: the PCs find each other by mDNS.
"""

from lab.lab import Lab
from lab.load import Load
from lab.timing import PART


def run(lab: Lab) -> None:
    """Deploys, creates a stream on each PC, and compares what the PCs list."""
    with lab.spread(), lab.timing.step(PART + "deploy to three bare PCs"):
        lab.on_all(lab.deployment.deploy)
    with lab.timing.step(PART + "copy the test's programs"):
        lab.on_all(lab.deployment.install_programs)
    names = {guest.name: f"deployed@{guest.name}" for guest in lab.guests}
    writers = [Load(guest, "write", [names[guest.name]], rate_hz=10) for guest in lab.guests]
    for writer in writers:
        writer.await_ready()
    with lab.timing.step(PART + "until every PC lists every stream"):
        lab.await_streams(*(f"deployed:0@{guest.name}" for guest in lab.guests))
    for writer in writers:
        writer.finish()
    constant = ("payload_bytes", "depth", "cycle_ns", "type", "incarnation")
    listed = [{name: {key: stream[key] for key in constant}
               for name, stream in lab.streams(guest).items()} for guest in lab.guests]
    assert listed[0] == listed[1] == listed[2], listed
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm deployed")
    lab.await_streams()
