# SPDX-License-Identifier: Apache-2.0
"""Runs the project's Ansible playbooks against the guests, like a person with three PCs."""

import dataclasses
import json
import os
import pathlib
import re
import subprocess
from collections.abc import Iterable

from lab.guest import Guest
from lab.packages import ROOT

FOLDER = ROOT / "ansible"
# What s20 tests; all other scenarios' streams have names that do not begin with x.
RIGHTS = ["local all *", "host:* all [!x]*", "host:pc1 all x*", "host:pc[12] read x*"]
VARIABLES = {"dssm_subnets": ["10.99.0.0/24"], "dssm_tls": True, "dssm_settings": {"rights": RIGHTS}}


@dataclasses.dataclass
class Played:
    """The result of a playbook."""

    succeeded: bool
    output: str

    def changed(self) -> dict[str, int]:
        """The number of tasks that changed something, by PC."""
        counts = re.findall(r"^(\S+) +: ok=\d+ +changed=(\d+) ", self.output, re.MULTILINE)
        return {name: int(count) for name, count in counts}


class Playbooks:
    """The playbooks, with an inventory of the lab's guests."""

    def __init__(self, folder: pathlib.Path, ssh_config: pathlib.Path, guests: Iterable[Guest]) -> None:
        self._home = folder / "ansible"
        self._home.mkdir()
        self._inventory = self._home / "inventory.json"
        self._inventory.write_text(json.dumps({"dssm": {
            "hosts": {guest.name: {"ansible_host": guest.address} for guest in guests},
            # The same connections as those of the scenarios (ssh.py).
            "vars": {"ansible_ssh_args": f"-F {ssh_config}", **VARIABLES},
        }}))

    def play(self, playbook: str, packages: pathlib.Path, *options: str) -> Played:
        """Runs a playbook with the .deb files of a folder; it must succeed."""
        played = self.attempt(playbook, packages, *options)
        assert played.succeeded, f"'{playbook}' failed:\n{played.output}"
        return played

    def attempt(self, playbook: str, packages: pathlib.Path, *options: str) -> Played:
        """Like play(), but the caller checks whether it succeeded."""
        environment = {**os.environ, "ANSIBLE_CONFIG": str(FOLDER / "ansible.cfg"),
                       "ANSIBLE_HOME": str(self._home), "ANSIBLE_NOCOLOR": "1", "LC_ALL": "C.UTF-8"}
        done = subprocess.run(
            ["ansible-playbook", "-i", self._inventory, "-e", f"dssm_packages_dir={packages}", *options,
             FOLDER / playbook], env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=900, check=False)
        return Played(done.returncode == 0, done.stdout)
