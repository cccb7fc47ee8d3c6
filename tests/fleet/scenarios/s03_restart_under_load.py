# SPDX-License-Identifier: Apache-2.0
"""Restart and kill -9 of dssmd under 3 writers at 500 Hz lose no sample on any PC

Each sample is read once, in order and untorn by readers on the writers' PC and on both others; the
readers' rings stay the same. Local readers are not affected and continue while dssmd is stopped. A
stream that no program has open, and so no program can give back, keeps all its samples, too.
"""

from lab.dssmd import await_new_samples, await_restarted, kill_dssmd, main_pid
from lab.lab import Lab
from lab.load import Load, expect_complete, print_silences

STREAMS = [f"load{number}:0@pc1" for number in (1, 2, 3)]
ALONE = "alone:0@pc1"
# At 1 kHz the guests, which share a core, have no time left to catch up.
RATE_HZ = 500


def run(lab: Lab) -> None:
    """Restarts and kills the writers' dssmd, then those of the readers."""
    pc1, pc2, pc3 = lab.guests
    alone = Load(pc1, "write", [ALONE], RATE_HZ).await_ready().finish()
    writers = [Load(pc1, "write", [stream], RATE_HZ).await_ready() for stream in STREAMS]
    readers = {guest.name: Load(guest, "read", STREAMS, RATE_HZ).await_ready() for guest in lab.guests}
    pc1.ssh.run("systemctl restart dssmd")
    await_new_samples(STREAMS, pc2, pc3)
    stopped = main_pid(pc1)
    pc1.ssh.run(f"kill -STOP {stopped}")
    readers[pc1.name].await_more(len(STREAMS) * RATE_HZ)
    pc1.ssh.run(f"kill -KILL {stopped}")
    await_restarted(pc1, stopped)
    await_new_samples(STREAMS, pc2, pc3)
    pc2.ssh.run("systemctl restart dssmd")
    kill_dssmd(pc3)
    await_new_samples(STREAMS, pc2, pc3)
    written = {"written": {stream: count for writer in writers
                           for stream, count in writer.finish()["written"].items()}}
    for name, reader in readers.items():
        read = reader.finish()
        print_silences(read, f"reader on {name}")
        expect_complete(written, read, f"reader on {name}")
    lab.await_streams(*STREAMS, ALONE)
    for guest in (pc1, pc2):
        found = Load(guest, "read", [ALONE], RATE_HZ).await_ready().finish()
        expect_complete(alone, found, f"reader on {guest.name}")
    for stream in (*STREAMS, ALONE):
        pc1.ssh.run(f"dssmctl rm {stream}")
    lab.await_streams()
