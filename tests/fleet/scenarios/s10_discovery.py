# SPDX-License-Identifier: Apache-2.0
"""PCs find each other while Avahi restarts, with two dssmd on one PC, and with two PCs of one name"""

import json

from lab.certificates import certify
from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.load import Load

SECOND = ("--runtime-dir=/run/second --name second --listen 0.0.0.0:13800"
          " --credentials /etc/dssm/second")


def run(lab: Lab) -> None:
    """Kills Avahi, starts a second dssmd, and gives two PCs one name."""
    pc1, pc2, pc3 = lab.guests
    avahi_dies(lab, pc1)
    second_dssmd(lab, pc2)
    one_name(lab, pc2, pc3)


def avahi_dies(lab: Lab, guest: Guest) -> None:
    """Streams stay listed without Avahi; a dssmd that starts meanwhile is found after Avahi's start."""
    guest.ssh.run("systemctl stop avahi-daemon.socket avahi-daemon")
    guest.ssh.run("systemctl restart dssmd")
    writer = Load(guest, "write", ["lonely:0@" + guest.name], rate_hz=10).await_ready()
    guest.ssh.run("systemctl start avahi-daemon.socket avahi-daemon")
    lab.await_streams(f"lonely:0@{guest.name}")
    guest.ssh.run("kill -9 $(systemctl show --property=MainPID --value avahi-daemon);"
                  " systemctl reset-failed avahi-daemon; systemctl restart avahi-daemon")
    lab.await_streams(f"lonely:0@{guest.name}")
    writer.finish()
    guest.ssh.run("dssmctl rm lonely")
    lab.await_streams()


def second_dssmd(lab: Lab, guest: Guest) -> None:
    """A second dssmd on one PC is a separate host."""
    certify(lab, guest, "second", "/etc/dssm/second")
    guest.ssh.run(f"systemd-run --unit=second-dssmd --property=Type=notify /usr/sbin/dssmd {SECOND}")
    writer = Load(guest, "write", ["other:0@second"], rate_hz=10,
                  prefix="env DSSM_SOCKET=/run/second/dssmd.sock").await_ready()
    lab.await_streams("other:0@second")
    writer.finish()
    guest.ssh.run("systemctl stop second-dssmd")
    lab.await_streams()


def one_name(lab: Lab, first: Guest, second: Guest) -> None:
    """Two PCs of one name are listed as two hosts."""
    rename(lab, second, first.name)
    pc1 = lab["pc1"]

    def check() -> tuple[bool, object]:
        hosts = json.loads(pc1.ssh.run("dssmctl hosts --json"))["hosts"]
        same = [host for host in hosts if host["host"] == first.name and host["state"] == "up"]
        return len({host["id"] for host in same}) == 2, hosts

    await_that(f"{pc1.name} lists two hosts of the name {first.name}", check)
    rename(lab, second, second.name)
    lab.await_streams()


def rename(lab: Lab, guest: Guest, name: str) -> None:
    """Changes the name of a PC, both of the machine and of its dssmd."""
    certify(lab, guest, name)
    configure = f"""sed -i 's/^name = .*/name = "{name}"/' /etc/dssm/dssmd.conf"""
    guest.ssh.run(f"systemctl stop dssmd && hostname {name} && {configure} &&"
                  " systemctl restart avahi-daemon && systemctl start dssmd")
