# SPDX-License-Identifier: Apache-2.0
"""A cut cable loses no sample that the ring still holds after the reconnection

The separated PC is removed from the lists of the others, and they from its list; all return by
themselves.
"""

from lab.dssmd import await_new_samples
from lab.lab import Lab
from lab.load import Load, expect_complete

STREAMS = ["cut:0@pc1", "whole:0@pc2"]


def run(lab: Lab) -> None:
    """Separates pc3 from the others, pulls the cable of pc1, and undoes both."""
    pc1, pc2, pc3 = lab.guests
    writers = [Load(pc1, "write", [STREAMS[0]]).await_ready(),
               Load(pc2, "write", [STREAMS[1]]).await_ready()]
    readers = {guest.name: Load(guest, "read", STREAMS).await_ready() for guest in lab.guests}
    lab.network.part([3], [1, 2])
    lab.await_streams(*STREAMS, on=[pc1, pc2])
    lab.await_streams(on=[pc3])
    lab.network.join()
    lab.await_streams(*STREAMS)
    lab.network.unplug(1)
    lab.await_streams(STREAMS[1], on=[pc2, pc3])
    lab.network.plug(1)
    lab.await_streams(*STREAMS)
    await_new_samples([STREAMS[0]], pc2, pc3)
    await_new_samples([STREAMS[1]], pc1)
    written = {"written": {stream: count for writer in writers
                           for stream, count in writer.finish()["written"].items()}}
    for name, reader in readers.items():
        expect_complete(written, reader.finish(), f"reader on {name}")
    pc1.ssh.run(f"dssmctl rm {STREAMS[0]} && dssmctl rm {STREAMS[1]}")
    lab.await_streams()
