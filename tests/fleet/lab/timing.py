# SPDX-License-Identifier: Apache-2.0
"""Where the time goes: a table of steps and how long each took."""

import contextlib
import json
import time
from collections.abc import Iterator


class Timing:
    """Steps in the order in which they ended."""

    def __init__(self, steps: list[tuple[str, float]] | None = None) -> None:
        self._steps = steps or []

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measures what happens within the `with` block, also when it fails."""
        started = time.monotonic()
        try:
            yield
        finally:
            self._steps.append((name, time.monotonic() - started))

    def pack(self) -> str:
        """For another process to go on with; see unpack()."""
        return json.dumps(self._steps)

    @staticmethod
    def unpack(text: str) -> "Timing":
        """What pack() gave."""
        return Timing([(name, seconds) for name, seconds in json.loads(text)])

    def table(self) -> str:
        """A line for each step, and the sum."""
        lines = [f"{seconds:7.1f} s  {name}" for name, seconds in self._steps]
        total = sum(seconds for _, seconds in self._steps)
        return "\n".join(["Where the time went:", *lines, f"{total:7.1f} s  together"])
