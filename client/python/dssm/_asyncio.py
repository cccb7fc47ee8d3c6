# SPDX-License-Identifier: Apache-2.0
"""Waiting for samples in an event loop of asyncio, without a thread.

A reader has a descriptor that becomes readable with each sample; the loop waits for it as for a
socket. One task at a time may wait for a reader.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from types import TracebackType

from dssm._dssm import Reader, Sample
from dssm._errors import InUse

# By the descriptors that tasks wait for: a loop has one callback for each.
_awaited: dict[int, "_Ready"] = {}
_close = Reader.close


class _Ready:
    """While in its `async with` block, sets `event` when there may be new samples."""

    def __init__(self, reader: Reader) -> None:
        self.event = asyncio.Event()
        self.reader = reader
        self._fd = reader.fileno()

    def __enter__(self) -> "_Ready":
        if self._fd in _awaited:
            raise InUse(f"another task waits for samples of '{self.reader.name}': give each task a reader of its own")
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._on_readable)
        _awaited[self._fd] = self
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._stop_waiting()

    def _stop_waiting(self) -> None:
        # The descriptor may be another reader's by now.
        if _awaited.get(self._fd) is not self:
            return
        del _awaited[self._fd]
        if not self._loop.is_closed():
            self._loop.remove_reader(self._fd)

    def on_closing(self) -> None:
        """Before the reader is closed, by this loop's thread or by another one."""
        self._call(self._stop_waiting)

    def on_closed(self) -> None:
        """After it was closed: a task that wakes up earlier finds it open, and waits again."""
        self._call(self.event.set)

    def _call(self, function: Callable[[], None]) -> None:
        if asyncio._get_running_loop() is self._loop:
            function()
        elif not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function)

    def _on_readable(self) -> None:
        if not self.reader.closed:
            self.reader.clear_ready()
        self.event.set()


def close(reader: Reader) -> None:
    """Closes it; a task that waits for it gets the error of a closed reader."""
    waiting = [ready for ready in list(_awaited.values()) if ready.reader is reader]
    for ready in waiting:
        ready.on_closing()
    _close(reader)
    for ready in waiting:
        ready.on_closed()


def leave(reader: Reader, *_: object) -> None:
    """At the end of a `with` block."""
    close(reader)


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
