# SPDX-License-Identifier: Apache-2.0
"""A table of steps and their durations."""

import contextlib
import time
from collections.abc import Iterator


PART = "  of that: "  # begins the name of a step that is part of another


class Timing:
    """Steps in the order of their ends."""

    def __init__(self) -> None:
        self._steps: list[tuple[str, float]] = []

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measures the `with` block, also when it fails."""
        started = time.monotonic()
        try:
            yield
        finally:
            self._steps.append((name, time.monotonic() - started))

    def table(self) -> str:
        """One line per step, and the sum."""
        lines = [f"{seconds:7.1f} s  {name}" for name, seconds in self._steps]
        total = sum(seconds for name, seconds in self._steps if not name.startswith(PART))
        return "\n".join(["Where the time went:", *lines, f"{total:7.1f} s  total"])
