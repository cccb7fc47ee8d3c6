# SPDX-License-Identifier: Apache-2.0
"""Tests variants of the role in ansible/ that the fleet (tests/fleet) does not cover: an apt source,
another user than root, IPv6, a firewall, no firewall, and a PC that other PCs cannot use."""

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
from container import HERE, TIMEOUT_S, Container
from service_tests import get, wait_until
from tree import field, repack

ANSIBLE = HERE.parent.parent / "ansible"
PORT = 13776
APT_CACHE = "var/cache/apt/archives"  # below a container's root
# A container must not set this machine's clock (-x), and lacks the capability for it.
CHRONYD_DROP_IN = """[Unit]
ConditionCapability=
[Service]
ExecStart=
ExecStart=!/usr/sbin/chronyd -F 1 -x
"""
# Our addresses in the networks of the vehicle, and in other networks; the container's end with 2.
FRIENDS = ("10.77.0.1", "fd77::1")
STRANGERS = ("10.78.0.1", "fd78::1")

# The PC's firewall. It rejects instead of dropping, so that tests need not wait for a timeout.
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
# A table of another program, which a reload of all rules would remove.
FOREIGN_TABLE = "add table inet docker"


def pc_of(address: str) -> str:
    """The container's address in the same network as our `address`."""
    return re.sub("1$", "2", address)


def family_of(address: str) -> socket.AddressFamily:
    """IPv4 or IPv6."""
    return socket.AF_INET6 if ":" in address else socket.AF_INET


def connects(address: str) -> bool:
    """Whether a TCP connection from our `address` to dssmd succeeds; a closed port is an error."""
    with socket.socket(family_of(address), socket.SOCK_STREAM) as mine:
        mine.settimeout(TIMEOUT_S)
        mine.bind((address, 0))
        try:
            mine.connect((pc_of(address), PORT))
        except OSError as error:
            assert error.errno in (errno.EHOSTUNREACH, errno.EACCES), error
            return False
        return True


def passes(address: str, port: int) -> bool:
    """Whether a datagram from our `address` passes; a closed port is an error."""
    with socket.socket(family_of(address), socket.SOCK_DGRAM) as mine:
        mine.bind((address, 0))
        mine.connect((pc_of(address), port))
        mine.send(bytes([0x23]) + bytes(47))  # a request for chronyd; other services ignore it
        connects(address)  # its answer arrives after a rejection of the datagram, if any
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
        """Runs a playbook with variables as for -e; its output is in stdout."""
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
        """Runs a playbook that must succeed; returns the number of tasks that changed something."""
        done = self.attempt(playbook, **variables)
        assert done.returncode == 0, done.stdout[-4000:]
        return int(re.search(r"^pc1 .* changed=([0-9]+) ", done.stdout, re.MULTILINE)[1])

    def refused(self, playbook: str, **variables: object) -> str:
        """Runs a playbook that must fail; returns its output."""
        done = self.attempt(playbook, **variables)
        assert done.returncode != 0, done.stdout[-4000:]
        return done.stdout


class RoleTests:
    """A PC with a firewall, deployed from an apt source by a user other than root, also with IPv6."""

    def __init__(self, container: Container, debs: list[pathlib.Path]) -> None:
        self.container = container
        self.version = field(debs[0], "Version")
        self.older = f"{self.version}~older"
        folder = pathlib.Path(tempfile.mkdtemp(dir="/tmp", prefix="dssm-apt-"))
        # gpg's agent may remove its sockets there at the same time.
        container.at_end(lambda: shutil.rmtree(folder, ignore_errors=True))
        self.source = AptSource(folder / "source", "10.77.0.1")
        container.at_end(self.source.close)
        olders = [folder / deb.name.replace(self.version, self.older) for deb in debs]
        for deb, older in zip(debs, olders):
            repack(deb, older, self.older)
        # The PC reaches only this source, which also contains the packages of Debian.
        container.path("/etc/apt/sources.list").unlink()
        self.source.publish([*debs, *olders, *(container.root / APT_CACHE).glob("*.deb")])
        container.run("apt-get", "clean")
        self.other_key = make_key(folder / "other", folder / "other.asc")

        container.run("useradd", "--create-home", "--shell", "/bin/bash", "driver")
        container.path("/etc/sudoers.d/driver").write_text("driver ALL=(ALL) NOPASSWD: ALL\n")
        container.path("/etc/nftables.conf").write_text(NFTABLES)
        container.run("systemctl", "enable", "--now", "nftables")
        container.run("nft", FOREIGN_TABLE)
        self.playbooks = Playbooks(container, {
            "ansible_user": "driver", "ansible_become": True, "dssm_insecure": True,
            "dssm_subnets": ["10.77.0.0/24", "fd77::/64"],
            "dssm_listen": [f"0.0.0.0:{PORT}", f"[::]:{PORT}"], "dssm_users": ["driver"],
            "dssm_apt_uri": self.source.uri, "dssm_apt_key": str(self.source.key)})

    def tests(self) -> list[tuple[str, Callable[[], None]]]:
        """Names and functions."""
        return [
            ("an apt source with a signature by another key installs nothing", self.other_signature),
            ("the role deploys a given version from an apt source, as a user with sudo", self.deploy),
            ("a second run changes nothing, although the apt source has a newer version",
             self.deploy_again),
            ("the firewall accepts the vehicle's networks, IPv4 and IPv6", self.accept_friends),
            ("the firewall rejects other networks", self.reject_strangers),
            ("the firewall is the same after a boot", self.boot),
            ("upgrade.yml installs the newest version of the apt source", self.upgrade),
            ("remove.yml closes the firewall and removes the apt source", self.remove),
        ]

    def installed(self) -> str:
        """The installed version of dssmd, empty if none."""
        listed = self.container.attempt("dpkg-query", "--show", "--showformat=${Version}", "dssmd")
        return listed.stdout if listed.returncode == 0 else ""

    def other_signature(self) -> None:
        """Test."""
        output = self.playbooks.refused("site.yml", dssm_apt_key=str(self.other_key))
        assert "Failed to update apt cache" in output or "NO_PUBKEY" in output, output[-2000:]
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

    def accept_friends(self) -> None:
        """Test."""
        for friend in FRIENDS:
            assert connects(friend), friend
            assert passes(friend, 123), friend
            assert passes(friend, 5353), friend

    def reject_strangers(self) -> None:
        """Test."""
        for stranger in STRANGERS:
            assert not connects(stranger), stranger
            assert not passes(stranger, 123), stranger
            assert not passes(stranger, 5353), stranger
        tables = self.container.run("nft", "list", "tables")
        assert "table inet docker" in tables, "the PC's rules were reloaded: " + tables

    def boot(self) -> None:
        """Test."""
        self.container.power_off()
        self.container.boot()
        self.accept_friends()
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


class IsolatedTests:
    """A PC without nftables, deployed from a folder, that other PCs cannot use."""

    # Installed from the folder with our packages, as for a PC without a network. Few of all that they
    # need, because each takes time. The name of libcap2-bin's file has an epoch.
    EXTRA = ("libevent-core-2.1-7", "libfmt9", "libwebsockets17", "libcap2-bin")
    # The variables of the second deployment.
    CHANGED = {"dssm_view": {"listen": "127.0.0.1:8766"}, "dssm_alerts": True,
               "dssm_grafana_provisioning": "/etc/grafana/provisioning"}

    def __init__(self, container: Container, debs: list[pathlib.Path]) -> None:
        self.container = container
        container.run("apt-get", "purge", "--yes", "nftables")
        folder = container.root / "srv/debs"
        folder.mkdir()
        cached = {deb.name.split("_")[0]: deb for deb in (container.root / APT_CACHE).glob("*.deb")}
        # prometheus is there for dssm_alerts.
        for deb in [*debs, *(cached.pop(name) for name in (*self.EXTRA, "prometheus"))]:
            shutil.copy(deb, folder)
        container.run("apt-get", "install", "--yes", "--no-install-recommends", *cached)
        self.playbooks = Playbooks(container, {
            "ansible_user": "root", "dssm_insecure": False, "dssm_subnets": ["fd77::/64"],
            "dssm_packages_dir": str(folder), "dssm_extra_packages": self.EXTRA,
            "dssm_packages": ["libdssm1", "dssmd", "dssm-tools", "dssm-record", "dssm-view"]})

    def tests(self) -> list[tuple[str, Callable[[], None]]]:
        """Names and functions."""
        return [
            ("the role refuses dssm_alerts without dssm-view, and changes nothing", self.refuse),
            ("the role deploys an isolated PC without nftables", self.deploy),
            ("a PC with dssm_insecure: false listens only at loopback", self.listen),
            ("the role runs the recorder where it is configured", self.record),
            ("the role runs the view, by default at port 8765", self.view),
            ("the role moves the view to another port", self.move_view),
            ("the role stops and disables a recorder that is no longer configured", self.stop_recorder),
            ("a second run from a folder changes nothing", self.deploy_again),
            ("the role has Prometheus watch the vehicle", self.watch),
            ("the role has Grafana show the vehicle", self.show),
        ]

    def refuse(self) -> None:
        """Test."""
        output = self.playbooks.refused("site.yml", dssm_packages=["dssmd"], dssm_alerts=True)
        assert "does not contain dssm-view" in output, output[-2000:]
        assert not self.container.path("/var/cache/dssm").exists()

    def deploy(self) -> None:
        """Test."""
        settings = {"black_box": True, "quota": "1GiB", "trigger": ["high: a.b > 1"]}
        assert self.playbooks.run("site.yml", dssm_record=settings) > 0
        assert "pc1" in self.container.run("dssmctl", "hosts")
        assert not self.container.path("/etc/nftables.d").exists()

    def listen(self) -> None:
        """Test."""
        status = self.container.run("systemctl", "show", "--property", "StatusText", "dssmd")
        assert status.endswith(f"listening at 127.0.0.1:{PORT}, [::1]:{PORT}"), status
        for friend in FRIENDS:
            with socket.socket(family_of(friend)) as mine:
                mine.settimeout(TIMEOUT_S)
                assert mine.connect_ex((pc_of(friend), PORT)) == errno.ECONNREFUSED, friend

    def record(self) -> None:
        """Test."""
        wait_until(lambda: self.container.attempt("dssmctl", "trigger", "test").returncode == 0,
                   "no black box waits for triggers")

    def has_page(self, port: int) -> bool:
        """Whether the view serves its page at the port."""
        return "<title>" in get(self.container, f"http://127.0.0.1:{port}/")

    def view(self) -> None:
        """Test."""
        wait_until(lambda: self.has_page(8765), "it does not listen where it does by default")

    def move_view(self) -> None:
        """Test."""
        assert self.playbooks.run("site.yml", **self.CHANGED) > 0
        wait_until(lambda: self.has_page(8766), "it does not listen at the new port")
        assert not self.has_page(8765)

    def stop_recorder(self) -> None:
        """Test."""
        unit = self.container.run("systemctl", "show", "--property=ActiveState,UnitFileState",
                                  "dssm-record")
        assert unit.split() == ["ActiveState=inactive", "UnitFileState=disabled"], unit

    def deploy_again(self) -> None:
        """Test."""
        assert self.playbooks.run("site.yml", **self.CHANGED) == 0

    def watch(self) -> None:
        """Test."""
        prometheus = "http://127.0.0.1:9090/api/v1/"
        wait_until(lambda: "DssmHostDown" in get(self.container, prometheus + "rules"),
                   "Prometheus has no alert rules")
        wait_until(lambda: '"host":"pc1"' in get(self.container,
                                                 prometheus + "query?query=dssm_host_up"),
                   "Prometheus has no metrics")

    def show(self) -> None:
        """Test: Debian has no Grafana that could show it."""
        dashboards = "/etc/grafana/provisioning/dashboards"
        self.container.run("grep", "-x", f" *path: {dashboards}/dssm", f"{dashboards}/dssm.yaml")
        self.container.run("grep", "dssm_host_up", f"{dashboards}/dssm/dssm-dashboard.json")
