# SPDX-License-Identifier: Apache-2.0
"""The disk image that all guests boot from: a small Debian, made once and cached.

Guests have no network beyond the lab, so the image contains everything that scenarios and the
project's packages need. It does not contain the project, because deployment starts from bare guests.
The image is never modified: each guest has its own copy-on-write file (guest.py).
"""

import contextlib
import fcntl
import hashlib
import os
import pathlib
import re
import shutil
import tempfile
import time
from collections.abc import Iterator

from lab.command import CommandError, run

KERNEL = pathlib.Path("/usr/bin/linux.uml")
MODULES = pathlib.Path("/usr/lib/uml/modules")
KEYRING = pathlib.Path("/usr/share/keyrings/debian-archive-keyring.gpg")
FILES = pathlib.Path(__file__).parent.parent / "image"
SIZE = "1200M"
UNUSED_SECONDS = 3 * 24 * 3600  # then other versions are deleted; a run may still use one

PACKAGES = (
    # The PC: a system, its services, and the tools that scenarios use there.
    "systemd systemd-sysv dbus udev avahi-daemon avahi-utils libnss-mdns chrony openssh-server iproute2"
    " nftables procps kmod sudo ethtool util-linux"
    # Ansible's end on the PC.
    " python3 python3-apt"
    # What the project's packages and the example depend on.
    " libstdc++6 libevent-core-2.1-7 libfmt9 libprotobuf-lite32 libsystemd0 libavahi-client3"
    " libavahi-common3 libtomlplusplus3 libdeflate0 liblz4-1 libzstd1 libdw1 libwebsockets17 zlib1g libpng16-16 adduser"
    " init-system-helpers"
).split()

# Not needed in a guest, and most of what dpkg would write.
EXCLUDED = ("man", "doc", "doc-base", "info", "locale", "lintian", "bug", "zoneinfo", "i18n")

# Output of mmdebstrap and apt-get without a network: for package lists, and for packages.
NO_NETWORK = re.compile("apt-get update .*failed|Failed to fetch|Unable to fetch")

# Not needed in a test, and slow to boot: consoles, timers, hardware that a guest does not have, and
# generators that search for it.
MASKED_UNITS = (
    "getty.target getty@tty1.service console-getty.service serial-getty@.service"
    " apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer fstrim.timer"
    " e2scrub_all.timer e2scrub_reap.service systemd-tmpfiles-clean.timer cryptsetup.target"
    " remote-fs.target systemd-logind.service systemd-binfmt.service proc-sys-fs-binfmt_misc.automount"
    " systemd-pstore.service systemd-machine-id-commit.service systemd-firstboot.service"
    " systemd-update-utmp.service systemd-update-utmp-runlevel.service systemd-journal-flush.service"
    " systemd-udevd.service systemd-udev-trigger.service systemd-udevd-control.socket"
    " systemd-udevd-kernel.socket systemd-udev-settle.service systemd-ask-password-wall.path"
    " systemd-ask-password-console.path dev-hugepages.mount dev-mqueue.mount"
    " sys-kernel-debug.mount sys-kernel-tracing.mount sys-fs-fuse-connections.mount"
    " modprobe@configfs.service modprobe@drm.service modprobe@efi_pstore.service"
    " modprobe@fuse.service systemd-modules-load.service systemd-random-seed.service"
    " systemd-timesyncd.service systemd-hibernate-resume@.service nftables.service"
    " initrd-cleanup.service systemd-fsck-root.service networking.service"
).split()
GENERATORS_KEPT = {"systemd-fstab-generator", "systemd-debug-generator"}


class Image:
    """A built image, with the key for ssh and the hosts' keys."""

    def __init__(self, folder: pathlib.Path) -> None:
        self.disk = folder / "root.ext4"
        self.ssh_key = folder / "ssh_key"
        self.known_hosts = folder / "known_hosts"


def cache_folder() -> pathlib.Path:
    """The folder that keeps images between runs."""
    base = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(base) / "dssm" / "fleet"


class NoNetwork(Exception):
    """No image exists, and none can be made without a network."""


def ensure_image() -> Image:
    """The image for this version of the harness; builds it if necessary.

    Concurrent runs wait for the one that builds. Images that were not used for long are deleted.
    """
    cache = cache_folder()
    cache.mkdir(parents=True, exist_ok=True)
    folder = cache / _fingerprint()
    with _locked(cache / "lock"):
        if not folder.exists():
            with _scratch(cache) as scratch:
                _build(scratch)
                scratch.rename(folder)
        os.utime(folder)
        for other in cache.iterdir():
            if other.is_dir() and time.time() - other.stat().st_mtime > UNUSED_SECONDS:
                shutil.rmtree(other)
    return Image(folder)


def _fingerprint() -> str:
    """A hash of everything that the image depends on."""
    digest = hashlib.sha256(pathlib.Path(__file__).read_bytes())
    for path in sorted(path for path in FILES.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(FILES)} {path.stat().st_mode:o}\n".encode())
        digest.update(path.read_bytes())
    for modules in sorted(MODULES.iterdir()):
        digest.update(modules.name.encode())
    return digest.hexdigest()[:16]


@contextlib.contextmanager
def _locked(path: pathlib.Path) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def _scratch(parent: pathlib.Path) -> Iterator[pathlib.Path]:
    """A new folder, removed afterwards unless it was renamed."""
    path = pathlib.Path(tempfile.mkdtemp(prefix="new-", dir=parent))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _build(folder: pathlib.Path) -> None:
    # In memory, because unpacking to a disk is slower.
    with tempfile.TemporaryDirectory(prefix="dssm-fleet-image-", dir="/dev/shm") as temporary:
        tree = pathlib.Path(temporary) / "tree"
        _bootstrap(tree)
        _install_modules(tree)
        _configure(tree)
        _make_keys(tree, folder)
        run("mke2fs", "-q", "-t", "ext4", "-L", "root", "-d", tree,
            folder / "root.ext4", SIZE, what="make the guests' disk")
    folder.chmod(0o755)


def _bootstrap(tree: pathlib.Path) -> None:
    options = [f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in EXCLUDED]
    try:
        run("mmdebstrap", "--mode=root", "--variant=minbase", "--format=directory", "--quiet",
            f"--keyring={KEYRING}", '--aptopt=Acquire::Languages "none"',
            '--aptopt=Acquire::Retries "3"', "--dpkgopt=force-unsafe-io", *options,
            "--include=" + ",".join(PACKAGES), "bookworm", tree,
            what="make a Debian for the guests", contained=True)
    except CommandError as error:
        if NO_NETWORK.search(str(error)):
            raise NoNetwork(str(error)) from error
        raise


def _install_modules(tree: pathlib.Path) -> None:
    """The guest kernel's modules; netem is one of them."""
    for modules in MODULES.iterdir():
        shutil.copytree(modules, tree / "usr/lib/modules" / modules.name, symlinks=True)
        run("chroot", tree, "depmod", modules.name, what="index the guest kernel's modules")


def _configure(tree: pathlib.Path) -> None:
    shutil.copytree(FILES, tree, dirs_exist_ok=True)
    system = tree / "etc/systemd/system"
    for unit in MASKED_UNITS:
        link = system / unit
        link.unlink(missing_ok=True)
        link.symlink_to("/dev/null")
    generators = tree / "etc/systemd/system-generators"
    generators.mkdir(exist_ok=True)
    for generator in (tree / "usr/lib/systemd/system-generators").iterdir():
        if generator.name not in GENERATORS_KEPT:
            (generators / generator.name).symlink_to("/dev/null")
    (system / "multi-user.target.wants").mkdir(exist_ok=True)
    for target, unit in (("sysinit.target.wants", "lab-network.service"),):
        wants = system / target
        wants.mkdir(exist_ok=True)
        (wants / unit).symlink_to(f"/etc/systemd/system/{unit}")
    default = system / "default.target"
    default.unlink(missing_ok=True)
    default.symlink_to("/lib/systemd/system/multi-user.target")
    # Empty: each guest gets its own from the kernel's command line.
    (tree / "etc/machine-id").write_text("")
    (tree / "etc/hostname").unlink(missing_ok=True)
    hosts = [f"10.99.0.{number} pc{number}" for number in range(1, 10)]
    (tree / "etc/hosts").write_text("\n".join(["127.0.0.1 localhost", "::1 localhost", *hosts, ""]))


def _make_keys(tree: pathlib.Path, folder: pathlib.Path) -> None:
    """A key for ssh to these guests only; one host key for all of them."""
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "dssm fleet tests", "-f", folder / "ssh_key",
        what="make a key for the guests")
    login = tree / "root/.ssh"
    login.mkdir(mode=0o700, exist_ok=True)
    shutil.copy(folder / "ssh_key.pub", login / "authorized_keys")
    for old in (tree / "etc/ssh").glob("ssh_host_*"):
        old.unlink()
    key = tree / "etc/ssh/ssh_host_ed25519_key"
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key, what="make the guests' host key")
    public = key.with_suffix(".pub").read_text().split()[:2]
    (folder / "known_hosts").write_text(f"* {' '.join(public)}\n")
