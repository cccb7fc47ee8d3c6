# SPDX-License-Identifier: Apache-2.0
"""A signed apt source for a test, served by HTTP from this process."""

import functools
import hashlib
import http.server
import pathlib
import shutil
import subprocess
import threading
from collections.abc import Iterable

SUITE, COMPONENT = "bookworm", "main"


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, *_: object) -> None:
        """Logs nothing; apt-get reports errors itself."""


class AptSource:
    """The source. Its files are below the new folder `folder`; `key` is the file of its public key."""

    def __init__(self, folder: pathlib.Path, address: str) -> None:
        """Makes a key, and serves an empty source at a free port of `address`."""
        self._files = folder / "files"
        self._files.mkdir(parents=True)
        self.key = make_key(folder / "gpg", folder / "key.asc")
        self._gpg = gpg_of(folder / "gpg")
        self._server = http.server.ThreadingHTTPServer(
            (address, 0), functools.partial(QuietHandler, directory=str(self._files)))
        self.uri = f"http://{address}:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stops serving."""
        self._server.shutdown()
        self._server.server_close()

    def publish(self, debs: Iterable[pathlib.Path]) -> None:
        """Adds packages."""
        pool = self._files / "pool"
        pool.mkdir(exist_ok=True)
        for deb in debs:
            shutil.copy(deb, pool)
        index = subprocess.run(["dpkg-scanpackages", "--multiversion", "pool"], cwd=self._files,
                               check=True, capture_output=True).stdout
        architecture = subprocess.run(["dpkg", "--print-architecture"], check=True,
                                      capture_output=True, text=True).stdout.strip()
        suite = self._files / "dists" / SUITE
        name = f"{COMPONENT}/binary-{architecture}/Packages"
        (suite / name).parent.mkdir(parents=True, exist_ok=True)
        (suite / name).write_bytes(index)
        release = (f"Suite: {SUITE}\nCodename: {SUITE}\nComponents: {COMPONENT}\n"
                   f"Architectures: {architecture}\nDate: Thu, 01 Jan 2026 00:00:00 UTC\n"
                   f"SHA256:\n {hashlib.sha256(index).hexdigest()} {len(index)} {name}\n")
        (suite / "Release").write_text(release)
        subprocess.run([*self._gpg, "--yes", "--clearsign", "--output", suite / "InRelease",
                        suite / "Release"], check=True, capture_output=True)


def gpg_of(home: pathlib.Path) -> list[str]:
    """The command line of gpg with the keys in `home`, without questions."""
    return ["gpg", "--homedir", str(home), "--batch", "--pinentry-mode", "loopback",
            "--passphrase", ""]


def make_key(home: pathlib.Path, public: pathlib.Path) -> pathlib.Path:
    """Makes a key in the new folder `home`, and returns the file `public` with its public part."""
    home.mkdir(mode=0o700)
    subprocess.run([*gpg_of(home), "--quick-generate-key", "DSSM's tests", "ed25519", "sign", "never"],
                   check=True, capture_output=True)
    subprocess.run([*gpg_of(home), "--armor", "--output", public, "--export"], check=True)
    return public
