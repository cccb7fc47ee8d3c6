# SPDX-License-Identifier: Apache-2.0
"""A PC sees and changes only what the others allow it

The lab's PCs are deployed with rights: all streams are for all PCs, but for those whose names begin
with x; these only pc1 and pc2 may read, and only pc1 may write.
"""

import json

from lab.guest import Guest
from lab.lab import Lab, await_that

STREAM = "x-private"


def run(lab: Lab) -> None:
    """Creates a stream on the first PC and tries to use it from the others."""
    pc1, pc2, pc3 = lab.guests
    pc1.ssh.run(f"dssmctl create {STREAM} --size 8 --depth 8")
    await_that(f"{pc2.name} sees the stream", lambda: (STREAM in streams(pc2), streams(pc2)))
    assert STREAM not in streams(pc3), "pc3 sees a stream that it may not see"
    refused(pc3, f"info {STREAM}@{pc1.name}")
    refused(pc3, f"echo {STREAM}@{pc1.name}")
    refused(pc2, f"rm {STREAM}@{pc1.name}")
    shown = json.loads(pc1.ssh.run(f"dssmctl rights {STREAM} --json"))
    assert [right["who"] for right in shown["rights"]] == ["local", "host:pc1", "host:pc[12]"], shown
    pc1.ssh.run(f"dssmctl rm {STREAM}")


def streams(guest: Guest) -> list[str]:
    """The names of all streams that `guest` lists."""
    return [stream["name"] for stream in json.loads(guest.ssh.run("dssmctl ls --json"))["streams"]]


def refused(guest: Guest, words: str) -> None:
    """Runs dssmctl, which must fail and name the key that does not allow it."""
    done = guest.ssh.attempt(f"dssmctl {words}")
    assert done.returncode == 1 and b"dssmd's key 'rights' does not allow it" in done.stderr, done
