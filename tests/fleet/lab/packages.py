# SPDX-License-Identifier: Apache-2.0
"""The packages and programs under test, built on this machine."""

import dataclasses
import pathlib
import shutil
from collections.abc import Mapping

from lab.command import run

ROOT = pathlib.Path(__file__).parents[3]
EXAMPLE = "docs/examples/vehicle"
RECORDING = ROOT / EXAMPLE / "data/freiburg-079.carmen.log.gz"

# The project's packages that the role installs.
INSTALLED = ("libdssm1", "dssmd", "dssm-tools")

# The folder of the tests' programs on a guest.
PROGRAMS_FOLDER = "/opt/fleet"


@dataclasses.dataclass
class Artifacts:
    """Everything that was built for the guests."""

    packages: pathlib.Path  # a folder of .deb files, each package once
    programs: list[pathlib.Path]  # the tests' and the example's
    preload: pathlib.Path  # for the guests' kernels; see uml_xstate.c


def build(folder: pathlib.Path, programs: pathlib.Path | None, packages: pathlib.Path | None) -> Artifacts:
    """Builds in the build folder `folder`, except what is already built in `programs` or `packages`."""
    targets = ["tests/fleet/fleet-clock", "tests/fleet/fleet-load", "tests/fleet/uml-xstate.so",
               *(f"{EXAMPLE}/{name}" for name in ("encoder", "lidar", "localizer", "mapper"))]
    if programs is None:
        programs = folder
        if not (folder / "build.ninja").exists():
            run("meson", "setup", folder, ROOT, "-Dunity=on", "-Dunity_size=16", "-Dbenchmarks=false",
                what="configure the build", contained=True)
        run("ninja", "-C", folder, *targets, what="build the fleet's programs", timeout=3600, contained=True)
    if packages is None:
        packages = folder / "packages"
        shutil.rmtree(packages, ignore_errors=True)  # the role accepts only one version
        run(ROOT / "scripts/build-packages", packages, what="build the Debian packages", timeout=3600,
            contained=True)
    for name in INSTALLED:
        package_file(packages, name)
    files = [programs / target for target in targets]
    return Artifacts(packages, [file for file in files if file.suffix != ".so"],
                     next(file for file in files if file.suffix == ".so"))


def package_file(folder: pathlib.Path, package: str) -> pathlib.Path:
    """The package's file in `folder`."""
    files = list(folder.glob(f"{package}_*_amd64.deb"))
    if len(files) != 1:
        raise FileNotFoundError(f"'{folder}' contains {len(files)} files '{package}_*_amd64.deb' where one is "
                                "needed; scripts/build-packages makes them in an empty folder")
    return files[0]


def repack(packages: pathlib.Path, folder: pathlib.Path, suffix: str,
           added: Mapping[str, str] | None = None) -> pathlib.Path:
    """Repacks the packages into `folder`, with a version that is higher by `suffix`.

    `added`: additional files for dssmd, by their paths on the PC.
    """
    folder.mkdir()
    for name in INSTALLED:
        package = package_file(packages, name)
        version = run("dpkg-deb", "--field", package, "Version", what="read a package").strip()
        unpacked = folder / "unpacked"
        run("dpkg-deb", "--raw-extract", package, unpacked, what="unpack a package")
        control = unpacked / "DEBIAN/control"
        control.write_text(control.read_text().replace(version, version + suffix))
        for path, text in (added or {}).items() if name == "dssmd" else ():
            file = unpacked / path.lstrip("/")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        run("dpkg-deb", "--root-owner-group", "-Znone", "--build", unpacked,
            folder / f"{name}_{version}{suffix}_amd64.deb", what="pack a package")
        shutil.rmtree(unpacked)
    return folder
