#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Counts what the test runs of ./check did.

Takes build folders. Reads what meson wrote there: testlog.json, a line for each test program, and
testlog.junit.xml, an entry for each test in them. Names every test that failed, with what it said,
or was skipped, and closes with one line "N passed, N failed" (", N skipped" when there were any). A
program that ended badly without naming a failed test, a crash say, counts as one. Exits with 1 when
a test failed or when there was none.
"""

import json
import pathlib
import sys
import textwrap
import xml.etree.ElementTree as ElementTree

MOST_LINES = 12


def first_lines(text: str | None) -> str:
    """What a test says of its failure, as far as it is worth repeating far from its log."""
    return "\n".join((text or "").strip().splitlines()[:MOST_LINES])


def final_failure(case: ElementTree.Element) -> str:
    """What a program printed that ended without naming a failed test: how it began and ended."""
    printed = case.findtext("system-err") or case.findtext("system-out") or ""
    lines = printed.strip().splitlines()
    if len(lines) > 2 * MOST_LINES:
        lines[MOST_LINES:-MOST_LINES] = ["..."]
    return "\n".join(lines)


def count(folder: pathlib.Path) -> tuple[int, int, int]:
    """Passed, failed and skipped tests of one build folder; prints the latter two."""
    passed = failed = skipped = 0
    for case in ElementTree.parse(folder / "testlog.junit.xml").getroot().iter("testcase"):
        name = f"{folder.parent.name}: {case.get('classname')}.{case.get('name')}"
        troubles = case.findall("failure") + case.findall("error")
        if troubles:
            failed += 1
            print(f"FAILED  {name}")
            for trouble in troubles:
                said = first_lines(trouble.get("message") or trouble.text) or final_failure(case)
                if said:
                    print(textwrap.indent(said, " " * 8))
        elif case.find("skipped") is not None or case.get("result") in ("skipped", "suppressed"):
            skipped += 1
            print(f"SKIPPED {name}")
        else:
            passed += 1
    programs = [json.loads(line) for line in (folder / "testlog.json").read_text().splitlines()]
    bad = [p for p in programs if p["result"] not in ("OK", "EXPECTEDFAIL", "SKIP")]
    for program in bad:
        print(f"FAILED  {folder.parent.name}: {program['name']} ({program['result']})")
    return passed, max(failed, len(bad)), skipped


def main(folders: list[str]) -> int:
    counts = [count(pathlib.Path(folder) / "meson-logs") for folder in folders]
    passed, failed, skipped = (sum(column) for column in zip(*counts))
    print(f"{passed} passed, {failed} failed" + (f", {skipped} skipped" if skipped else ""))
    return 1 if failed or not passed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
