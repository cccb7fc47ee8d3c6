# SPDX-License-Identifier: Apache-2.0
"""Results of a test program that meson does not run, in the files that meson would write.

scripts/summary.py counts what is in FOLDER/meson-logs: testlog.junit.xml has an entry for each test,
testlog.json a line for the whole program. Both are written again after each test, so a program that
is killed leaves its results so far, and counts as failed (INTERRUPT).

    with Report("packages", folder) as report:
        if report.run("the packages are built", build):
            report.run("they install", install)
        else:
            report.skip("they install", "there are no packages")
    sys.exit(report.exit_status)
"""

import json
import pathlib
import time
import traceback
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable


class Skip(Exception):
    """Raised by a test that cannot run here; its text says why."""


class Report:
    """The tests of one program. Not for several threads at once.

    Leaving the `with` block completes the files; an exception that leaves it counts as a failed test.
    """

    def __init__(self, program: str, folder: pathlib.Path) -> None:
        """Takes the program's name, which stands before each test's, and where the files go."""
        self._program = program
        self._logs = folder / "meson-logs"
        self._suite = ElementTree.Element("testsuite", name=program)
        self._passed = self._failed = 0

    def run(self, name: str, test: Callable[[], object]) -> bool:
        """Runs a test, prints its result, and returns whether it passed.

        A test fails by any exception but Skip, an AssertionError say.
        """
        started = time.monotonic()
        try:
            test()
        except Skip as reason:
            self._note(name, started, "skipped", str(reason))
            return False
        except Exception:  # any exception fails this test only; the others still run
            self._note(name, started, "failure", traceback.format_exc())
            return False
        self._note(name, started)
        return True

    def skip(self, name: str, reason: str) -> None:
        """Notes a test that cannot run."""
        self._note(name, time.monotonic(), "skipped", reason)

    @property
    def exit_status(self) -> int:
        """0 when no test failed, else 1."""
        return 1 if self._failed else 0

    def __enter__(self) -> "Report":
        self._write("INTERRUPT")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: types.TracebackType | None) -> None:
        if error is not None:
            text = "".join(traceback.format_exception(kind, error, trace))
            self._note("the program ends normally", time.monotonic(), "failure", text)
        if self._failed:
            self._write("FAIL")
        else:
            self._write("OK" if self._passed else "SKIP")

    def _note(self, name: str, started: float, outcome: str = "", text: str = "") -> None:
        seconds = time.monotonic() - started
        case = ElementTree.SubElement(self._suite, "testcase", classname=self._program, name=name,
                                      time=f"{seconds:.3f}")
        if outcome:
            ElementTree.SubElement(case, outcome, message=text.strip().rpartition("\n")[2]).text = text
        self._failed += outcome == "failure"
        self._passed += not outcome
        word = {"": "OK", "skipped": "SKIP", "failure": "FAIL"}[outcome]
        print(f"{word:4} {seconds:7.2f} s  {self._program}: {name}", flush=True)
        if text:
            print("  | " + text.strip().replace("\n", "\n  | "), flush=True)
        self._write("INTERRUPT")

    def _write(self, result: str) -> None:
        """Writes both files; `result` is the program's, as meson names them."""
        self._logs.mkdir(parents=True, exist_ok=True)
        suites = ElementTree.Element("testsuites")
        suites.append(self._suite)
        ElementTree.ElementTree(suites).write(self._logs / "testlog.junit.xml", encoding="utf-8",
                                              xml_declaration=True)
        line = {"name": self._program, "result": result}
        (self._logs / "testlog.json").write_text(json.dumps(line) + "\n")
