# SPDX-License-Identifier: Apache-2.0
"""A PC whose certificate is revoked is refused by the others, and comes back with a new one

The others go on meanwhile.
"""

import json

from lab.certificates import certify, revoke
from lab.guest import Guest
from lab.lab import Lab, await_that


def run(lab: Lab) -> None:
    """Revokes the certificate of the last PC, and gives it another one."""
    pc1, pc2, pc3 = lab.guests
    assert not host(pc1, pc2.name)["insecure"], "the connection is not encrypted"
    revoke(lab, pc3.name)
    for guest in (pc1, pc2):
        await_that(f"{guest.name} does not see {pc3.name} any more",
                   lambda guest=guest: (host(guest, pc3.name)["state"] != "up", host(guest, pc3.name)))
    await_that(f"{pc3.name} is told why", lambda: (
        "certificate revoked" in (host(pc3, pc1.name)["error"] or ""), host(pc3, pc1.name)))
    assert host(pc1, pc2.name)["state"] == "up", "the others are connected"
    certify(lab, pc3, pc3.name)
    pc3.ssh.run("systemctl reload dssmd")
    for guest in lab.guests:
        for other in lab.guests:
            if guest is other:
                continue
            await_that(f"{guest.name} sees {other.name} again", lambda guest=guest, other=other: (
                host(guest, other.name)["state"] == "up", host(guest, other.name)))
    lab.await_streams()


def host(guest: Guest, name: str) -> dict[str, object]:
    """What `guest` shows about the host `name`."""
    hosts = json.loads(guest.ssh.run("dssmctl hosts --json"))["hosts"]
    return next((one for one in hosts if one["host"] == name), {"state": "unknown", "error": None, "insecure": None})
