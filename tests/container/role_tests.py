# SPDX-License-Identifier: Apache-2.0
"""The role in ansible/ in those variants that the fleet (tests/fleet) has not: an apt source, another
user than root, IPv6, a firewall, no firewall, and a PC that keeps its streams to itself."""

import errno
import json
import os
import pathlib
import re
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Callable

from apt_source import AptSource, make_key
from container import HERE, PATIENCE_S, Container
from tree import field, repack

ANSIBLE = HERE.parent.parent / "ansible"
PORT = 13776
# A container must not set this machine's clock (-x), and lacks the capability for it.
CHRONYD_DROP_IN = """[Unit]
ConditionCapability=
[Service]
ExecStart=
ExecStart=!/usr/sbin/chronyd -F 1 -x
"""
# In the networks of the vehicle, and in others; a container has the same ones, with .2.
FRIENDS = ("10.77.0.1", "fd77::1")
STRANGERS = ("10.78.0.1", "fd78::1")

# A PC's own firewall. It rejects instead of dropping, so that nobody has to wait for nothing.
NFTABLES = """flush ruleset
table inet filter {
  chain input {
    type filter hook input priority filter; policy drop;
    ct state established,related accept
    iif lo accept
    meta l4proto 58 accept  # ICMPv6
    reject with icmpx type admin-prohibited
  }
}
"""
# Of somebody else, and in the way of whoever loads all rules anew.
FOREIGN_TABLE = "add table inet docker"


def pc_of(address: str) -> str:
    """The container's address in the network of one of ours."""
    return re.sub("1$", "2", address)


def family_of(address: str) -> socket.AddressFamily:
    """IPv4 or IPv6."""
    return socket.AF_INET6 if ":" in address else socket.AF_INET


def connects(address: str) -> bool:
    """Whether one of our addresses gets a TCP connection to dssmd; a closed port is a failure."""
    with socket.socket(family_of(address), socket.SOCK_STREAM) as mine:
        mine.settimeout(PATIENCE_S)
        mine.bind((address, 0))
        try:
            mine.connect((pc_of(address), PORT))
        except OSError as error:
            assert error.errno in (errno.EHOSTUNREACH, errno.EACCES), error
            return False
        return True


def passes(address: str, port: int) -> bool:
    """Whether a datagram of one of our addresses gets through; a closed port is a failure."""
    with socket.socket(family_of(address), socket.SOCK_DGRAM) as mine:
        mine.bind((address, 0))
        mine.connect((pc_of(address), port))
        mine.send(bytes([0x23]) + bytes(47))  # to chronyd a question; others pass it over
        connects(address)  # what comes back on the same way behind a refusal, if there is one
        code = mine.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    assert code in (0, errno.EHOSTUNREACH, errno.EACCES), f"{address} {port}: {os.strerror(code)}"
    return code == 0


class Playbooks:
    """Runs the playbooks on a container as the vehicle's only PC, 'pc1'."""

    def __init__(self, container: Container, variables: dict[str, object]) -> None:
        drop_in = container.path("/etc/systemd/system/chrony.service.d/container.conf")
        drop_in.parent.mkdir()
        drop_in.write_text(CHRONYD_DROP_IN)
        self._container = container
        self.variables: dict[str, object] = {
            "ansible_host": "10.77.0.2", "ansible_ssh_executable": str(HERE / "enter"),
            "ansible_ssh_args": "", "ansible_ssh_transfer_method": "piped",
            "dssm_verify_timeout": 20} | variables

    def attempt(self, playbook: str, **variables: object) -> subprocess.CompletedProcess[str]:
        """Runs a playbook, with more variables as by -e; what it said is in stdout."""
        with tempfile.TemporaryDirectory() as folder:
            inventory = pathlib.Path(folder) / "inventory.json"
            inventory.write_text(json.dumps({"dssm": {"hosts": {"pc1": self.variables}}}))
            return subprocess.run(
                ["ansible-playbook", "-i", inventory, "-e", json.dumps(variables), ANSIBLE / playbook],
                env=os.environ | self._container.environment | {
                    "PATH": os.environ["PATH"], "HOME": folder, "ANSIBLE_NOCOLOR": "1",
                    "ANSIBLE_CONFIG": str(ANSIBLE / "ansible.cfg")},
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def run(self, playbook: str, **variables: object) -> int:
        """Runs one that is to succeed, and returns how many tasks changed something."""
        done = self.attempt(playbook, **variables)
        assert done.returncode == 0, done.stdout[-4000:]
        return int(re.search(r"^pc1 .* changed=([0-9]+) ", done.stdout, re.MULTILINE)[1])

    def refused(self, playbook: str, **variables: object) -> str:
        """Runs one that is to fail, and returns what it says."""
        done = self.attempt(playbook, **variables)
        assert done.returncode != 0, done.stdout[-4000:]
        return done.stdout


class RoleTests:
    """A PC with a firewall, deployed from an apt source by a user who is not root, over IPv6, too."""

    def __init__(self, container: Container, debs: list[pathlib.Path]) -> None:
        self.container = container
        self.version = field(debs[0], "Version")
        self.older = f"{self.version}~older"
        folder = pathlib.Path(tempfile.mkdtemp(dir="/tmp", prefix="dssm-apt-"))
        container.at_end(lambda: shutil.rmtree(folder))
        self.source = AptSource(folder / "source", "10.77.0.1")
        container.at_end(self.source.close)
        for deb in debs:
            older = folder / deb.name.replace(self.version, self.older)
            repack(deb, older, self.older)
            self.source.publish([deb, older])
        self.other_key = make_key(folder / "other", folder / "other.asc")

        container.run("useradd", "--create-home", "--shell", "/bin/bash", "driver")
        container.path("/etc/sudoers.d/driver").write_text("driver ALL=(ALL) NOPASSWD: ALL\n")
        container.path("/etc/nftables.conf").write_text(NFTABLES)
        container.run("systemctl", "enable", "--now", "nftables")
        container.run("nft", FOREIGN_TABLE)
        # This source is all that the PC reaches; Debian's packages are there, too.
        container.path("/etc/apt/sources.list").unlink()
        self.source.publish((container.root / "var/cache/apt/archives").glob("*.deb"))
        container.run("apt-get", "clean")
        self.playbooks = Playbooks(container, {
            "ansible_user": "driver", "ansible_become": True, "dssm_insecure": True,
            "dssm_subnets": ["10.77.0.0/24", "fd77::/64"],
            "dssm_listen": [f"0.0.0.0:{PORT}", f"[::]:{PORT}"], "dssm_users": ["driver"],
            "dssm_apt_uri": self.source.uri, "dssm_apt_key": str(self.source.key)})

    def tests(self) -> list[tuple[str, Callable[[], None]]]:
        """Names and functions."""
        return [
            ("an apt source whose signature is another's installs nothing", self.other_signature),
            ("the role deploys a version of an apt source, as a user with sudo", self.deploy),
            ("a second run changes nothing, although the apt source has a newer version",
             self.deploy_again),
            ("the firewall lets the vehicle's networks in, IPv4 and IPv6", self.let_friends_in),
            ("the firewall keeps other networks out", self.keep_strangers_out),
            ("the firewall is the same after a boot", self.boot),
            ("upgrade.yml brings what is new in the apt source", self.upgrade),
            ("remove.yml closes the firewall and takes the apt source away", self.remove),
        ]

    def installed(self) -> str:
        """The version of dssmd, empty when there is none."""
        listed = self.container.attempt("dpkg-query", "--show", "--showformat=${Version}", "dssmd")
        return listed.stdout if listed.returncode == 0 else ""

    def other_signature(self) -> None:
        """Test."""
        said = self.playbooks.refused("site.yml", dssm_apt_key=str(self.other_key))
        assert "Failed to update apt cache" in said or "NO_PUBKEY" in said, said[-2000:]
        assert not self.installed()

    def deploy(self) -> None:
        """Test."""
        assert self.playbooks.run("site.yml", dssm_version=self.older) > 0
        assert self.installed() == self.older
        assert "dssm" in self.container.run("id", "--name", "--groups", "driver").split()
        # dssmctl as that user, in a new login.
        listed = self.container.run("runuser", "--login", "driver", "--command", "dssmctl hosts")
        assert "pc1" in listed, listed

    def deploy_again(self) -> None:
        """Test."""
        assert self.playbooks.run("site.yml") == 0

    def let_friends_in(self) -> None:
        """Test."""
        for friend in FRIENDS:
            assert connects(friend), friend
            assert passes(friend, 123), friend
            assert passes(friend, 5353), friend

    def keep_strangers_out(self) -> None:
        """Test."""
        for stranger in STRANGERS:
            assert not connects(stranger), stranger
            assert not passes(stranger, 123), stranger
            assert not passes(stranger, 5353), stranger
        tables = self.container.run("nft", "list", "tables")
        assert "table inet docker" in tables, "the PC's rules were loaded anew: " + tables

    def boot(self) -> None:
        """Test."""
        self.container.power_off()
        self.container.boot()
        self.let_friends_in()
        assert not any(map(connects, STRANGERS))

    def upgrade(self) -> None:
        """Test."""
        self.playbooks.run("upgrade.yml")
        assert self.installed() == self.version

    def remove(self) -> None:
        """Test."""
        self.playbooks.run("remove.yml", dssm_remove="pc1", dssm_purge=True)
        assert not self.installed()
        assert not any(map(connects, FRIENDS))
        assert self.container.path("/etc/nftables.conf").read_text() == NFTABLES
        for file in ("apt/sources.list.d/dssm.sources", "apt/keyrings/dssm.asc", "nftables.d/dssm.nft",
                     "dssm", "chrony/conf.d/dssm.conf"):
            assert not self.container.path(f"/etc/{file}").exists(), file


class SecludedTests:
    """A PC without nftables, deployed from a folder, that keeps its streams to itself."""

    def __init__(self, container: Container, debs: list[pathlib.Path]) -> None:
        self.container = container
        container.run("apt-get", "purge", "--yes", "nftables")
        container.run("apt-get", "install", "--yes", "--no-install-recommends", "avahi-daemon", "chrony")
        self.folder = container.root / "srv/debs"
        self.folder.mkdir()
        # What it depends on as well, as for a PC without a network.
        self.extra = []
        for deb in [*debs, *(container.root / "var/cache/apt/archives").glob("*.deb")]:
            shutil.copy(deb, self.folder)
            if deb not in debs:
                self.extra.append(field(deb, "Package"))
        self.playbooks = Playbooks(container, {
            "ansible_user": "root", "dssm_insecure": False, "dssm_subnets": ["fd77::/64"],
            "dssm_packages_dir": str(self.folder), "dssm_extra_packages": self.extra})

    def tests(self) -> list[tuple[str, Callable[[], None]]]:
        """Names and functions."""
        return [
            ("the role deploys a PC without nftables that is to be alone", self.deploy),
            ("a PC with dssm_insecure: false listens at loopback only", self.listen),
        ]

    def deploy(self) -> None:
        """Test."""
        assert self.playbooks.run("site.yml") > 0
        assert "pc1" in self.container.run("dssmctl", "hosts")
        assert not self.container.path("/etc/nftables.d").exists()

    def listen(self) -> None:
        """Test."""
        status = self.container.run("systemctl", "show", "--property", "StatusText", "dssmd")
        assert status.endswith(f"listening at 127.0.0.1:{PORT}, [::1]:{PORT}"), status
        for friend in FRIENDS:
            with socket.socket(family_of(friend)) as mine:
                mine.settimeout(PATIENCE_S)
                assert mine.connect_ex((pc_of(friend), PORT)) == errno.ECONNREFUSED, friend
