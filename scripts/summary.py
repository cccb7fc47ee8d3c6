#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Counts the results of the tests of ./check.

    scripts/summary.py [--steps PASSED FAILED] FOLDER...

Reads what meson wrote in these build folders: testlog.json, a line for each test program, and
testlog.junit.xml, an entry for each test in them. Names every test that failed, with its output, or
was skipped, and closes with one line "N passed, N failed" (", N skipped" when there were any). A
program that failed without naming a failed test, for example in a crash, counts as one. --steps adds
steps that are not tests. Exits with 1 when something failed or when there was nothing to count.
"""

import argparse
import json
import pathlib
import sys
import textwrap
import xml.etree.ElementTree as ElementTree

MAX_LINES = 12


def first_lines(text: str | None) -> str:
    """The beginning of a test's failure message."""
    return "\n".join((text or "").strip().splitlines()[:MAX_LINES])


def beginning_and_end(printed: str) -> str:
    """The first and the last lines of a program's output, if it is long."""
    lines = printed.strip().splitlines()
    if len(lines) > 2 * MAX_LINES:
        lines[MAX_LINES:-MAX_LINES] = ["..."]
    return "\n".join(lines)


def unfinished(program: dict) -> str:
    """What GoogleTest's program printed in a test that did not end; empty if each did."""
    printed = program.get("stdout", "")
    begin = printed.rfind("[ RUN ")
    test = printed[begin:] if begin >= 0 else ""
    if not test or any(end in test for end in ("[       OK ]", "[  FAILED  ]", "[  SKIPPED ]")):
        return ""
    return beginning_and_end(test + "\n".join(program.get("stderr", "").splitlines()[-MAX_LINES:]))


def count(folder: pathlib.Path) -> tuple[int, int, int]:
    """Passed, failed and skipped tests of one build folder; prints the latter two."""
    passed = failed = skipped = 0
    for case in ElementTree.parse(folder / "testlog.junit.xml").getroot().iter("testcase"):
        name = f"{folder.parent.name}: {case.get('classname')}.{case.get('name')}"
        failures = case.findall("failure") + case.findall("error")
        if failures:
            failed += 1
            print(f"FAILED  {name}")
            for failure in failures:
                text = first_lines(failure.get("message") or failure.text)
                text = text or beginning_and_end(
                    case.findtext("system-err") or case.findtext("system-out") or ""
                )
                if text:
                    print(textwrap.indent(text, " " * 8))
        elif case.find("skipped") is not None or case.get("result") in ("skipped", "suppressed"):
            skipped += 1
            print(f"SKIPPED {name}")
        else:
            passed += 1
    programs = [json.loads(line) for line in (folder / "testlog.json").read_text().splitlines()]
    bad = [p for p in programs if p["result"] not in ("OK", "EXPECTEDFAIL", "SKIP")]
    for program in bad:
        print(f"FAILED  {folder.parent.name}: {program['name']} ({program['result']})")
        if text := unfinished(program):
            print(textwrap.indent(text, " " * 8))
    return passed, max(failed, len(bad)), skipped


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", nargs=2, type=int, default=(0, 0), metavar=("PASSED", "FAILED"))
    parser.add_argument("folder", nargs="*", type=pathlib.Path)
    options = parser.parse_args()
    counts = [(*options.steps, 0), *(count(folder / "meson-logs") for folder in options.folder)]
    passed, failed, skipped = (sum(column) for column in zip(*counts))
    print(f"{passed} passed, {failed} failed" + (f", {skipped} skipped" if skipped else ""))
    return 1 if failed or not passed else 0


if __name__ == "__main__":
    sys.exit(main())
