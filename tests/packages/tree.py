# SPDX-License-Identifier: Apache-2.0
"""A temporary bare Debian 12 to install packages in; tests/container boots one, too.

The tree is made once with mmdebstrap and kept in the user's cache. Its apt cache contains all
dependencies of the packages, so they install without a network. Each use mounts an overlay over the
tree, whose changes are in memory.
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
# The minimum of a PC with Debian (minbase, systemd), and compilers for programs that use libdssm. Our
# packages do not depend on compilers, so these hide no missing dependency.
PACKAGES = "systemd,g++,pkg-config,cmake,make"
MAX_AGE_S = 14 * 24 * 3600.0  # then the tree is made again, with updates of Debian

# $1 is the tree, $DEBS our packages, $CACHED names of packages of Debian.
DOWNLOAD = ('set -e; mkdir "$1/debs"; cp $DEBS "$1/debs"; chroot "$1" apt-get clean; '
            'chroot "$1" sh -c "apt-get install --yes --no-install-recommends --download-only '
            '/debs/*.deb $CACHED"; rm -r "$1/debs"')
# Output of mmdebstrap and apt-get without a network: for package lists, and for packages.
NO_NETWORK = re.compile("apt-get update .*failed|Failed to fetch|Unable to fetch")


class Unavailable(Exception):
    """A test cannot run here; the text is the reason."""


def field(deb: pathlib.Path, name: str) -> str:
    """A field of a package, empty if missing."""
    return subprocess.run(["dpkg-deb", "--field", deb, name], check=True, capture_output=True,
                          text=True).stdout.strip()


def repack(deb: pathlib.Path, as_file: pathlib.Path, version: str,
           change: Callable[[pathlib.Path], object] = lambda unpacked: None) -> None:
    """Repacks a package as `as_file`, with another version, and after `change` of its unpacked files."""
    with tempfile.TemporaryDirectory() as folder:
        unpacked = pathlib.Path(folder) / "unpacked"
        subprocess.run(["dpkg-deb", "--raw-extract", deb, unpacked], check=True)
        control = unpacked / "DEBIAN/control"
        # Also in Depends, where packages require others of the same version.
        control.write_text(control.read_text().replace(field(deb, "Version"), version))
        change(unpacked)
        as_file.parent.mkdir(exist_ok=True)
        subprocess.run(["dpkg-deb", "--root-owner-group", "-Znone", "--build", unpacked, as_file],
                       check=True, stdout=subprocess.DEVNULL)


def bare_tree(debs: Iterable[pathlib.Path], packages: str = PACKAGES,
              cached: str = "") -> pathlib.Path:
    """The folder of a bare tree with the dependencies of `debs` in its apt cache; made if necessary.

    `packages` (separated by commas) are installed in it; `cached` (separated by blanks) are in the apt
    cache, with their dependencies.
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
            new.touch()  # its age begins now; mmdebstrap sets the time of Debian's base-files
            for old in cache.iterdir():
                if old != new and time.time() - old.stat().st_mtime > MAX_AGE_S:
                    shutil.rmtree(old)
            if tree.exists():
                shutil.rmtree(tree)
            new.rename(tree)
    finally:
        if new.exists():
            shutil.rmtree(new)
    if tree.exists():  # an old one, if no new one could be made
        return tree
    message = "mmdebstrap could not make a bare Debian:\n" + made.stderr[-2000:]
    raise Unavailable(message) if NO_NETWORK.search(made.stderr) else AssertionError(message)


def mount_overlay(bare: pathlib.Path, scratch: pathlib.Path) -> pathlib.Path:
    """The root of a temporary copy of a bare tree, mounted below `scratch`.

    Call it in a new mount namespace. Unavailable if this system has no overlays.
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
    """Restarts this program in new mount and pid namespaces, so that nothing remains after its end.

    `more` are further namespaces, as options of unshare(1). Returns only on failure, with the reason.
    """
    namespaces = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", *more]
    if os.geteuid() != 0:
        return "this needs root"
    tried = subprocess.run([*namespaces, "true"], capture_output=True, text=True)
    if tried.returncode != 0:
        return "no namespaces can be made here: " + tried.stderr.strip()
    os.execvp("unshare", [*namespaces, sys.executable, *sys.argv, "--in-namespaces"])


class Tree:
    """A temporary copy of a bare tree, mounted below `scratch`. Needs a new mount namespace."""

    def __init__(self, bare: pathlib.Path, scratch: pathlib.Path) -> None:
        """Mounts it. Unavailable if this system has no overlays."""
        self.root = mount_overlay(bare, scratch)
        subprocess.run(["mount", "-t", "proc", "proc", self.root / "proc"], check=True)
        (self.root / "dev/shm").mkdir(exist_ok=True)
        subprocess.run(["mount", "-t", "tmpfs", "tmpfs", self.root / "dev/shm"], check=True)

    def command(self, *words: str) -> list[str]:
        """The command line that runs `words` in the tree, without a network."""
        return ["unshare", "--net", "chroot", str(self.root), *words]

    @property
    def environment(self) -> dict[str, str]:
        """The environment of programs in the tree."""
        return {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin", "HOME": "/root",
                "LC_ALL": "C.UTF-8", "DEBIAN_FRONTEND": "noninteractive"}

    def run(self, *words: str) -> str:
        """Runs a program in the tree and returns its output; a failure is an AssertionError."""
        done = subprocess.run(self.command(*words), env=self.environment, stdin=subprocess.DEVNULL,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert done.returncode == 0, f"{' '.join(words)}: {done.returncode}\n{done.stdout[-4000:]}"
        return done.stdout

    def files(self) -> set[str]:
        """The paths of all files in the tree, except in folders that the kernel or each boot fills."""
        skipped = ("./proc", "./run", "./dev", "./tmp")
        found = subprocess.run(["find", ".", "-xdev"], cwd=self.root, check=True,
                               capture_output=True, text=True).stdout.splitlines()
        return {path[1:] for path in found if not path.startswith(skipped)}
