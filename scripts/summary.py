#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Counts what the test runs of ./check did.

Reads the JUnit files that meson writes for each build folder, names every test that failed or was
skipped, and closes with one line "N passed, N failed" (", N skipped" when there were any). Exits
with 1 when a test failed or when there was none.
"""

import sys
import xml.etree.ElementTree as ElementTree


def main(paths: list[str]) -> int:
    passed = failed = skipped = 0
    for path in paths:
        variant = path.split("/")[0]
        for case in ElementTree.parse(path).getroot().iter("testcase"):
            name = f"{variant}: {case.get('classname')}.{case.get('name')}"
            if case.find("failure") is not None or case.find("error") is not None:
                failed += 1
                print(f"FAILED  {name}")
            elif case.find("skipped") is not None or case.get("result") == "skipped":
                skipped += 1
                print(f"SKIPPED {name}")
            else:
                passed += 1
    line = f"{passed} passed, {failed} failed"
    print(line + (f", {skipped} skipped" if skipped else ""))
    return 1 if failed or not passed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
