# SPDX-License-Identifier: Apache-2.0
"""Certificates of the fleet, whose authority the role has made on the first PC"""

from lab.guest import Guest
from lab.lab import Lab

AUTHORITY = "--ca /etc/dssm/ca"
CREDENTIALS = "/etc/dssm/credentials"


def certify(lab: Lab, guest: Guest, name: str, folder: str = CREDENTIALS) -> None:
    """Gives a PC a certificate as the host `name`; its key stays there."""
    request = guest.ssh.read(f"dssmctl pki request --host {name} --credentials {folder}")
    bundle = lab.guests[0].ssh.read(f"dssmctl pki issue - {AUTHORITY}", stdin=request)
    guest.ssh.run(f"dssmctl pki install - --credentials {folder}", stdin=bundle)


def revoke(lab: Lab, name: str) -> None:
    """Revokes all certificates of `name`, on all PCs."""
    revoked = lab.guests[0].ssh.read(f"dssmctl pki revoke {name} {AUTHORITY}")
    for guest in lab.guests:
        guest.ssh.run("dssmctl pki install - && systemctl reload dssmd", stdin=revoked)
