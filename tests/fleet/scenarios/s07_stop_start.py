# SPDX-License-Identifier: Apache-2.0
"""After systemctl stop and start of dssmd, running writers and readers keep their rings

systemd 252 drops the descriptors that it keeps for a service when the service is stopped; the programs
still have theirs.
"""

from lab.dssmd import await_new_samples
from lab.lab import Lab
from lab.load import Load, expect_complete

STREAM = "stopped:0@pc1"


def run(lab: Lab) -> None:
    """Stops and starts dssmd on both ends of a stream."""
    pc1, pc2, pc3 = lab.guests
    writer = Load(pc1, "write", [STREAM]).await_ready()
    readers = [Load(guest, "read", [STREAM]).await_ready() for guest in (pc1, pc2)]
    pc1.ssh.run("systemctl stop dssmd")
    lab.await_streams(on=[pc3])
    pc1.ssh.run("systemctl start dssmd")
    pc2.ssh.run("systemctl stop dssmd && systemctl start dssmd")
    lab.await_streams(STREAM)
    await_new_samples([STREAM], pc2)
    written = writer.finish()
    for reader in readers:
        expect_complete(written, reader.finish(), "reader")
    pc1.ssh.run(f"dssmctl rm {STREAM}")
    lab.await_streams()
