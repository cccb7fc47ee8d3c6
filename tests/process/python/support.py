# SPDX-License-Identifier: Apache-2.0
"""A dssmd for the tests of the Python package, and their results by name for meson (TAP)."""

import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import unittest
from collections.abc import Callable, Sequence

# Meson sets the folders; the package is not installed there, but complete.
BUILD = pathlib.Path(os.environ["DSSM_BUILD_ROOT"])
SOURCE = pathlib.Path(os.environ["DSSM_SOURCE_ROOT"])
PATIENT_S = 60.0  # for what happens at once on a machine that is not busy


class Daemon:
    """A dssmd with a folder of its own, on loopback only; of other hosts it connects to `peers`."""

    def __init__(self, name: str = "pc1", peers: Sequence["Daemon"] = ()) -> None:
        self._folder = tempfile.mkdtemp(prefix="dssm-test-")
        self._flags = ["--name", name] + [word for peer in peers for word in ("--peer", peer.address)]
        self.socket_path = f"{self._folder}/dssmd.sock"
        self.start()

    def start(self) -> None:
        """Starts it and waits until it is ready."""
        notify = f"{self._folder}/notify"
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
            ready.bind(notify)
            ready.settimeout(PATIENT_S)
            self._process = subprocess.Popen(
                # It ends with the test, also if that crashes.
                ["setpriv", "--pdeathsig", "KILL", BUILD / "daemon/dssmd", "--runtime-dir", self._folder, "--chronyd", "127.0.0.1:1",
                 "--mdns=false", "--listen", "127.0.0.1:0", *self._flags], env=os.environ | {"NOTIFY_SOCKET": notify})
            while b"READY=1" not in (message := ready.recv(4096)):
                pass
        self.address = re.search(r"listening at ([\d.:]+)", message.decode())[1]
        os.unlink(notify)

    def kill(self) -> None:
        """Ends it without a chance to clean up."""
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        """Stops it until resume(), as if its host did not answer."""
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """Ends it and removes its folder."""
        self.kill()
        shutil.rmtree(self._folder)


class Case(unittest.TestCase):
    """Tests with one dssmd for all of the class."""

    daemon: Daemon

    @classmethod
    def setUpClass(cls) -> None:
        cls.daemon = Daemon()
        os.environ["DSSM_SOCKET"] = cls.daemon.socket_path
        cls.addClassCleanup(cls.daemon.close)

    def setUp(self) -> None:
        import dssm

        self.session = dssm.Session(request_timeout=PATIENT_S)
        self.addCleanup(self.session.close)


def python(program: str, *arguments: str) -> subprocess.Popen[str]:
    """Starts a program that is given as text."""
    return subprocess.Popen([sys.executable, "-c", program, *arguments], stdin=subprocess.PIPE,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def await_that(holds: Callable[[], object]) -> None:
    """Waits until `holds` returns something true."""
    end = time.monotonic() + PATIENT_S
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.005)


class TapResult(unittest.TestResult):
    """Prints a line for each test, as meson's protocol `tap` expects it."""

    _count = 0

    def _print(self, test: unittest.TestCase, word: str, text: str = "", directive: str = "") -> None:
        self._count += 1
        name = test.id().removeprefix("__main__.").replace("#", "")
        print(f"{word} {self._count} - {name}{directive}", flush=True)
        for line in text.splitlines():
            print(f"# {line}", flush=True)

    def addSuccess(self, test: unittest.TestCase) -> None:  # noqa: N802
        super().addSuccess(test)
        self._print(test, "ok")

    def addFailure(self, test, err) -> None:  # noqa: N802
        super().addFailure(test, err)
        self._print(test, "not ok", self.failures[-1][1])

    def addError(self, test, err) -> None:  # noqa: N802
        super().addError(test, err)
        self._print(test, "not ok", self.errors[-1][1])

    def addSubTest(self, test, subtest, err) -> None:  # noqa: N802
        super().addSubTest(test, subtest, err)
        if err is not None:
            text = (self.failures if issubclass(err[0], test.failureException) else self.errors)[-1][1]
            self._print(subtest, "not ok", text)

    def addSkip(self, test: unittest.TestCase, reason: str) -> None:  # noqa: N802
        super().addSkip(test, reason)
        self._print(test, "ok", directive=f" # SKIP {reason}")


def main(names: list[str]) -> int:
    """Runs the tests of the modules named."""
    suite = unittest.defaultTestLoader.loadTestsFromNames(names)
    pattern = os.environ.get("DSSM_TEST")  # to run some tests by hand
    tests = [test for test in _flat(suite) if not pattern or pattern in test.id()]
    print(f"1..{len(tests)}", flush=True)
    result = TapResult()
    unittest.TestSuite(tests).run(result)
    return 0 if result.wasSuccessful() and result.testsRun == len(tests) else 1


def _flat(suite: unittest.TestSuite) -> list[unittest.TestCase]:
    tests: list[unittest.TestCase] = []
    for each in suite:
        tests += _flat(each) if isinstance(each, unittest.TestSuite) else [each]
    return tests


if __name__ == "__main__":
    sys.path.insert(0, str(pathlib.Path(__file__).parent))
    sys.exit(main(sys.argv[1:]))
