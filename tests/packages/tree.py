# SPDX-License-Identifier: Apache-2.0
"""A bare Debian 12 to install packages in, thrown away afterwards; tests/container boots one, too.

The tree is made once with mmdebstrap and kept in the user's cache, with all that the packages depend
on in its apt cache, so that they install without a network. Each use lies over it as an overlay
whose changes are in memory.
"""

import hashlib
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable

RELEASE = "bookworm"
# What a PC with Debian has at least (minbase, systemd), and compilers for programs that use libdssm.
# Our packages depend on nothing of the latter, so they hide no missing dependency.
PACKAGES = "systemd,g++,pkg-config,cmake,make"
MAX_AGE_S = 14 * 24 * 3600.0  # then updates of Debian are taken

# $1 is the tree, $DEBS our packages, $CACHED the names of Debian's.
DOWNLOAD = ('set -e; mkdir "$1/debs"; cp $DEBS "$1/debs"; chroot "$1" apt-get clean; '
            'chroot "$1" sh -c "apt-get install --yes --no-install-recommends --download-only '
            '/debs/*.deb $CACHED"; rm -r "$1/debs"')
# What mmdebstrap and apt-get say when there is no network: of the lists, and of the packages.
NO_NETWORK = re.compile("apt-get update .*failed|Failed to fetch|Unable to fetch")


class Unavailable(Exception):
    """There is no tree, and none can be made here; the text says why."""


def field(deb: pathlib.Path, name: str) -> str:
    """A field of a package, empty when it has none."""
    return subprocess.run(["dpkg-deb", "--field", deb, name], check=True, capture_output=True,
                          text=True).stdout.strip()


def repack(deb: pathlib.Path, as_file: pathlib.Path, version: str,
           change: Callable[[pathlib.Path], object] = lambda unpacked: None) -> None:
    """Packs a package anew as `as_file`, with another version, and with what `change` does to it."""
    with tempfile.TemporaryDirectory() as folder:
        unpacked = pathlib.Path(folder) / "unpacked"
        subprocess.run(["dpkg-deb", "--raw-extract", deb, unpacked], check=True)
        control = unpacked / "DEBIAN/control"
        # Also in Depends, where packages ask for others of the same version.
        control.write_text(control.read_text().replace(field(deb, "Version"), version))
        change(unpacked)
        as_file.parent.mkdir(exist_ok=True)
        subprocess.run(["dpkg-deb", "--root-owner-group", "-Znone", "--build", unpacked, as_file],
                       check=True, stdout=subprocess.DEVNULL)


def bare_tree(debs: Iterable[pathlib.Path], packages: str = PACKAGES,
              cached: str = "") -> pathlib.Path:
    """The folder of a bare tree whose apt cache has what `debs` depend on; made if need be.

    `packages` are installed in it, with commas between them; `cached`, with blanks, are in the apt
    cache with what they depend on.
    """
    debs = sorted(debs)
    depends = [field(deb, "Depends") for deb in debs]
    recipe = repr((RELEASE, packages, cached, DOWNLOAD, depends))
    home = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
    cache = home / "dssm" / "packages"
    tree = cache / hashlib.sha256(recipe.encode()).hexdigest()[:16]
    if tree.exists() and time.time() - tree.stat().st_mtime < MAX_AGE_S:
        return tree
    cache.mkdir(parents=True, exist_ok=True)
    new = cache / f"new-{os.getpid()}"
    try:
        made = subprocess.run(
            ["mmdebstrap", "--quiet", "--mode=root", "--variant=minbase", f"--include={packages}",
             "--skip=cleanup/apt", "--dpkgopt=force-unsafe-io", f"--customize-hook={DOWNLOAD}",
             RELEASE, new],
            env=os.environ | {"DEBS": " ".join(map(str, debs)), "CACHED": cached}, capture_output=True, text=True)
        if made.returncode == 0:
            new.touch()  # its age begins now; mmdebstrap takes the time of Debian's base-files
            for old in cache.iterdir():
                if old != new and time.time() - old.stat().st_mtime > MAX_AGE_S:
                    shutil.rmtree(old)
            if tree.exists():
                shutil.rmtree(tree)
            new.rename(tree)
    finally:
        if new.exists():
            shutil.rmtree(new)
    if tree.exists():  # an old one if no new one could be made
        return tree
    said = "mmdebstrap could not make a bare Debian:\n" + made.stderr[-2000:]
    raise Unavailable(said) if NO_NETWORK.search(made.stderr) else AssertionError(said)


def mount_overlay(bare: pathlib.Path, scratch: pathlib.Path) -> pathlib.Path:
    """The root of a throw-away copy of a bare tree, mounted below `scratch`.

    For a mount namespace of its own. Unavailable when this system has no overlays.
    """
    for name in ("upper", "work", "root"):
        (scratch / name).mkdir()
    options = f"lowerdir={bare},upperdir={scratch}/upper,workdir={scratch}/work"
    mounted = subprocess.run(["mount", "-t", "overlay", "-o", options, "overlay", scratch / "root"],
                             capture_output=True, text=True)
    if mounted.returncode != 0:
        raise Unavailable("no overlay can be mounted here: " + mounted.stderr.strip())
    return scratch / "root"


def enter_namespaces(*more: str) -> str:
    """Starts this program anew in mount and pid namespaces of its own, so that nothing outlives it.

    `more` are further namespaces, as options of unshare(1). Returns only when that cannot be done: why.
    """
    namespaces = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", *more]
    if os.geteuid() != 0:
        return "this takes root"
    tried = subprocess.run([*namespaces, "true"], capture_output=True, text=True)
    if tried.returncode != 0:
        return "no namespaces can be made here: " + tried.stderr.strip()
    os.execvp("unshare", [*namespaces, sys.executable, *sys.argv, "--in-namespaces"])


class Tree:
    """A throw-away copy of a bare tree, mounted below `scratch`. For a mount namespace of its own."""

    def __init__(self, bare: pathlib.Path, scratch: pathlib.Path) -> None:
        """Mounts it. Unavailable when this system has no overlays."""
        self.root = mount_overlay(bare, scratch)
        subprocess.run(["mount", "-t", "proc", "proc", self.root / "proc"], check=True)
        (self.root / "dev/shm").mkdir(exist_ok=True)
        subprocess.run(["mount", "-t", "tmpfs", "tmpfs", self.root / "dev/shm"], check=True)

    def command(self, *words: str) -> list[str]:
        """What runs `words` in the tree, without a network."""
        return ["unshare", "--net", "chroot", str(self.root), *words]

    @property
    def environment(self) -> dict[str, str]:
        """The environment of programs in the tree."""
        return {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin", "HOME": "/root",
                "LC_ALL": "C.UTF-8", "DEBIAN_FRONTEND": "noninteractive"}

    def run(self, *words: str) -> str:
        """Runs a program in the tree and returns what it says; a failure of it is an AssertionError."""
        done = subprocess.run(self.command(*words), env=self.environment, stdin=subprocess.DEVNULL,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert done.returncode == 0, f"{' '.join(words)}: {done.returncode}\n{done.stdout[-4000:]}"
        return done.stdout

    def files(self) -> set[str]:
        """The paths of all that is in the tree, but for what the kernel or each boot puts there."""
        passed_over = ("./proc", "./run", "./dev", "./tmp")
        found = subprocess.run(["find", ".", "-xdev"], cwd=self.root, check=True,
                               capture_output=True, text=True).stdout.splitlines()
        return {path[1:] for path in found if not path.startswith(passed_over)}
