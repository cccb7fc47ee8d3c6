# SPDX-License-Identifier: Apache-2.0
"""Waiting for samples in an event loop of asyncio, without a thread.

A reader has a descriptor that becomes readable with each sample; the loop waits for it as for a
socket. One task at a time may wait for a reader.
"""

import asyncio
from collections.abc import AsyncIterator
from types import TracebackType

from dssm._dssm import Reader, Sample
from dssm._errors import InUse

# Descriptors that a task waits for: a loop has one callback for each.
_awaited: set[int] = set()


class _Ready:
    """While in its `async with` block, sets `event` when there may be new samples."""

    def __init__(self, reader: Reader) -> None:
        self.event = asyncio.Event()
        self._reader = reader
        self._fd = reader.fileno()

    def __enter__(self) -> "_Ready":
        if self._fd in _awaited:
            raise InUse(f"another task waits for samples of '{self._reader.name}': give each task a reader of its own")
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._on_readable)
        _awaited.add(self._fd)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        _awaited.discard(self._fd)
        if not self._loop.is_closed():
            self._loop.remove_reader(self._fd)

    def _on_readable(self) -> None:
        if self._reader.closed:  # its descriptor is closed, too
            self._loop.remove_reader(self._fd)
        else:
            self._reader.clear_ready()
        self.event.set()


async def samples(reader: Reader) -> AsyncIterator[Sample]:
    """The samples after the cursor, for `async for`."""
    with _Ready(reader) as ready:
        while True:
            ready.event.clear()
            while (sample := reader.next()) is not None:
                yield sample
            await ready.event.wait()


async def wait(reader: Reader, timeout: float | None = None) -> bool:
    """Waits until there is a sample after the cursor; whether there is one."""
    with _Ready(reader) as ready:
        try:
            async with asyncio.timeout(timeout):
                while True:
                    ready.event.clear()
                    if reader.wait(0):
                        return True
                    await ready.event.wait()
        except TimeoutError:
            return reader.wait(0)
