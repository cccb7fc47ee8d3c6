# SPDX-License-Identifier: Apache-2.0
"""One ansible-playbook makes three bare PCs a vehicle

Only the PCs' addresses are configured; they find each other by mDNS, and every PC lists every stream.
"""

import time

from lab.lab import Lab
from lab.load import Load
from lab.timing import PART


def run(lab: Lab) -> None:
    """Deploys, creates a stream on each PC, and compares what the PCs list."""
    with lab.timing.step(PART + "copy the test's programs"):
        lab.install_programs()
    started = time.monotonic()
    with lab.timing.step(PART + "site.yml, three bare PCs"):
        lab.deploy()
    writers = [Load(guest, "write", [f"deployed@{guest.name}"], rate_hz=10) for guest in lab.guests]
    for writer in writers:
        writer.await_ready()
    lab.await_streams(*(f"deployed:0@{guest.name}" for guest in lab.guests))
    print(f"  | from three bare PCs to a complete 'dssmctl ls' on each: {time.monotonic() - started:.1f} s",
          flush=True)
    constant = ("payload_bytes", "depth", "cycle_ns", "type", "incarnation")
    listed = [{name: {key: stream[key] for key in constant}
               for name, stream in lab.streams(guest).items()} for guest in lab.guests]
    assert listed[0] == listed[1] == listed[2], listed
    for writer in writers:
        writer.finish()
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm deployed")
    lab.await_streams()
