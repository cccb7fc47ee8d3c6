# SPDX-License-Identifier: Apache-2.0
"""What is tested, made on this machine, and how it gets onto bare guests."""

import dataclasses
import os
import pathlib

from lab.command import run
from lab.guest import Guest

ROOT = pathlib.Path(__file__).parents[3]
EXAMPLE = "docs/examples/vehicle"
RECORDING = ROOT / EXAMPLE / "data/freiburg-079.carmen.log.gz"

# The project's packages that a PC of a vehicle has.
INSTALLED = ("libdssm1", "dssmd", "dssm-tools")

# Where the test's own programs are on a guest.
PROGRAMS_FOLDER = "/opt/fleet"

CONFIGURATION = """\
listen = ["0.0.0.0:13776"]
insecure = true
"""


@dataclasses.dataclass
class Artifacts:
    """All that was built for the guests."""

    packages: list[pathlib.Path]  # .deb files
    programs: list[pathlib.Path]  # the test's own, and the example's
    preload: pathlib.Path  # for the guests' kernels; see uml_xstate.c


def build(folder: pathlib.Path, packages: pathlib.Path | None) -> Artifacts:
    """Builds in `folder`, which meson knows or will; `packages`: a folder with packages that are built."""
    if not (folder / "build.ninja").exists():
        run("meson", "setup", folder, ROOT, "-Dunity=on", "-Dunity_size=16", "-Dbenchmarks=false",
            what="configure the build")
    targets = ["tests/fleet/fleet-load", "tests/fleet/uml-xstate.so",
               *(f"{EXAMPLE}/{name}" for name in ("encoder", "lidar", "localizer", "mapper"))]
    run("ninja", "-C", folder, *targets, what="build the fleet's programs", timeout=3600)
    if packages is None:
        packages = folder / "packages"
        run(ROOT / "scripts/build-packages", packages, what="build the Debian packages", timeout=3600)
    files = [folder / target for target in targets]
    return Artifacts([newest(packages, name) for name in INSTALLED],
                     [file for file in files if file.suffix != ".so"],
                     next(file for file in files if file.suffix == ".so"))


def newest(folder: pathlib.Path, package: str) -> pathlib.Path:
    """The package's file in `folder`; the newest where there are several versions."""
    files = sorted(folder.glob(f"{package}_*_amd64.deb"), key=os.path.getmtime)
    if not files:
        raise FileNotFoundError(f"no '{package}_*_amd64.deb' in '{folder}'; scripts/build-packages "
                                "makes them")
    return files[-1]


class Deployment:
    """Makes a bare PC one of the vehicle: packages, configuration, a running dssmd."""

    def __init__(self, artifacts: Artifacts) -> None:
        self._artifacts = artifacts

    def deploy(self, guest: Guest) -> None:
        """Installs and starts everything on one PC, which may be new or have it already."""
        guest.ssh.put(self._artifacts.packages, "/tmp/packages")
        guest.ssh.run(f"cat > /tmp/dssmd.conf <<'END'\n{CONFIGURATION}END\n"
                      "mkdir -p /etc/dssm && cp /tmp/dssmd.conf /etc/dssm/dssmd.conf &&"
                      " DEBIAN_FRONTEND=noninteractive dpkg --force-confold --force-unsafe-io"
                      " --install /tmp/packages/*.deb && systemctl is-active dssmd.service && sync")

    def install_programs(self, guest: Guest) -> None:
        """Copies what only the test needs: its load, the example's programs, the recording."""
        guest.ssh.put([*self._artifacts.programs, RECORDING], PROGRAMS_FOLDER)
        guest.ssh.run("sync")  # a PC that loses its power keeps no more than that
