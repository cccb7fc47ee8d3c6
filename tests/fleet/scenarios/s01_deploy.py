# SPDX-License-Identifier: Apache-2.0
"""The tutorial's commands connect two bare PCs, and one ansible-playbook makes three a vehicle

First what docs/tutorial.md says for two real PCs is done literally, clocks included, and taken back.
Then only the PCs' addresses are configured; they find each other by mDNS, and every PC lists every
stream. A second run of the playbook, while programs write, changes nothing.
"""

import re
import time

from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.load import Load
from lab.network import guest_address
from lab.packages import INSTALLED, ROOT, package_file
from lab.timing import PART

CONFIG = "/etc/dssm/dssmd.conf"


def run(lab: Lab) -> None:
    """Deploys, creates a stream on each PC, compares what the PCs list, and deploys again."""
    with lab.timing.step(PART + "the tutorial's commands, two bare PCs"), lab.spread():
        by_hand(lab)
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
    with lab.timing.step(PART + "site.yml again"):
        again = lab.deploy()
    assert again.changed() == {guest.name: 0 for guest in lab.guests}, again.output
    for writer in writers:
        writer.finish()
    for guest in lab.guests:
        guest.ssh.run("dssmctl rm deployed")
    lab.await_streams()


def by_hand(lab: Lab) -> None:
    """Connects the first two PCs as the tutorial says, reads a sample by time, and removes it all."""
    owner, reader = lab.guests[:2]
    text = (ROOT / "docs/tutorial.md").read_text()
    text = text[text.index("On two real PCs"):]
    server, client, config = re.findall(r"```(?:sh|toml)\n(.*?)```", text, re.DOTALL)[:3]
    assert "local stratum" in server and "server pc1" in client and "listen" in config, text[:2000]
    debs = [package_file(lab.artifacts.packages, name) for name in INSTALLED]
    for guest, commands, other in ((owner, server, reader), (reader, client, owner)):
        guest.ssh.put(debs, "/root/debs")
        guest.ssh.run("apt-get install --yes /root/debs/*.deb")
        guest.ssh.run(as_root(commands, other))
        guest.ssh.run(f"cat >{CONFIG}", stdin=with_address(config, other).encode())
        guest.ssh.run("systemctl restart dssmd")
    await_that(f"{reader.name} is connected to {owner.name}",
               lambda: ("up" in (seen := reader.ssh.run("dssmctl hosts")), seen))
    for guest in (owner, reader):
        guest.ssh.run("dssmctl clock --wait 60")
    owner.ssh.run("dssmctl create by-hand --size 2 --depth 8 && dssmctl pub by-hand payload_hex=0102")
    # A read by time: refused while the clocks are not good.
    await_that("a sample of the other PC is read by time",
               lambda: ((done := reader.ssh.attempt("dssmctl echo by-hand --at -0 --json")).returncode == 0
                        and b'"0102"' in done.stdout, done))
    for guest in (owner, reader):
        guest.ssh.run("dssmctl doctor")
    for guest in (owner, reader):
        guest.ssh.run("apt-get purge --yes dssmd dssm-tools libdssm1")
        guest.ssh.run("rm -rf /root/debs /etc/dssm /etc/chrony/conf.d/dssm.conf && systemctl restart chrony")


def as_root(commands: str, other: Guest) -> str:
    """What a user types, for a PC without sudo and without a network to install from."""
    lines = [line for line in commands.splitlines() if line != "sudo apt-get install chrony"]
    return with_address("set -e\n" + "\n".join(lines).replace("sudo ", ""), other)


def with_address(text: str, other: Guest) -> str:
    """The text for a PC that cannot look up names; the tutorial allows addresses in their place."""
    text = re.sub(r"#.*", "", text)
    return re.sub(r"\bpc[12]\b", guest_address(other.number), text)
