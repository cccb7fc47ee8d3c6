# SPDX-License-Identifier: Apache-2.0
"""The tutorial's commands connect two bare PCs

What docs/tutorial.md says for two real PCs is done literally, clocks included. The last scenario: it leaves
bare PCs.
"""

import re

from lab.guest import Guest
from lab.lab import Lab, await_that
from lab.network import guest_address
from lab.packages import INSTALLED, ROOT, package_file
from lab.timing import PART

CONFIG = "/etc/dssm/dssmd.conf"


def run(lab: Lab) -> None:
    """Connects the first two PCs as the tutorial says, and reads a sample by time."""
    with lab.timing.step(PART + "new PCs"):
        lab.replace_by_bare()
    with lab.spread():
        connect(lab)


def connect(lab: Lab) -> None:
    """All that the tutorial says."""
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


def as_root(commands: str, other: Guest) -> str:
    """What a user types, for a PC without sudo and without a network to install from."""
    lines = [line for line in commands.splitlines() if line != "sudo apt-get install chrony"]
    return with_address("set -e\n" + "\n".join(lines).replace("sudo ", ""), other)


def with_address(text: str, other: Guest) -> str:
    """The text for a PC that cannot look up names; the tutorial allows addresses in their place."""
    text = re.sub(r"#.*", "", text)
    return re.sub(r"\bpc[12]\b", guest_address(other.number), text)
