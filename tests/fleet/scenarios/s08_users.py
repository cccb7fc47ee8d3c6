# SPDX-License-Identifier: Apache-2.0
"""User A writes, user B reads, a user outside the group is refused; a container needs only the socket

The container is a root directory with the system's libraries, read-only, and only the socket of /run,
in its own namespaces.
"""

from lab.lab import Lab
from lab.load import Load, expect_complete
from lab.packages import PROGRAMS_FOLDER

STREAM = "shared:0@pc1"
GROUP = "dssm"
CONTAINER = "/tmp/container"

MAKE_CONTAINER = f"""set -e
mkdir -p {CONTAINER}
mount -t tmpfs container {CONTAINER}
cd {CONTAINER}
mkdir -p usr opt/fleet run/dssm proc dev
mount --bind -o ro /usr usr
mount --bind -o ro {PROGRAMS_FOLDER} opt/fleet
ln -s usr/lib usr/lib64 usr/bin .
touch run/dssm/dssmd.sock
mount --bind /run/dssm/dssmd.sock run/dssm/dssmd.sock
"""


def run(lab: Lab) -> None:
    """Creates users and a container that share a stream."""
    pc1 = lab["pc1"]
    pc1.ssh.run(f"useradd --groups {GROUP} alice; useradd --groups {GROUP} bob; useradd stranger")
    pc1.ssh.run(MAKE_CONTAINER)
    try:
        writer = Load(pc1, "write", [STREAM], prefix="runuser -u alice --").await_ready()
        bob = Load(pc1, "read", [STREAM], prefix="runuser -u bob --").await_ready()
        inside = Load(pc1, "read", [STREAM], prefix=f"unshare --ipc --net --uts chroot {CONTAINER}")
        inside.await_ready()
        refused = pc1.ssh.attempt("runuser -u stranger -- dssmctl ls")
        assert refused.returncode != 0 and b"this user may not" in refused.stderr, refused
        written = writer.finish()
        expect_complete(written, bob.finish(), "bob")
        expect_complete(written, inside.finish(), "the container")
    finally:
        pc1.ssh.run(f"umount --recursive {CONTAINER}; userdel alice; userdel bob; userdel stranger")
    pc1.ssh.run(f"dssmctl rm {STREAM}")
    lab.await_streams()
