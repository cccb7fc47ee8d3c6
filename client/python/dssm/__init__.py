# SPDX-License-Identifier: Apache-2.0
"""DSSM: streams of timestamped samples between the programs and PCs of a vehicle.

    import dssm

    session = dssm.Session()
    reader = session.reader("lidar")
    sample = reader.at(t)

Times are ints of nanoseconds since 1970, as of time.time_ns(); where one is an argument, also a
numpy.datetime64. Durations are float seconds, a datetime.timedelta or a numpy.timedelta64.

Reads copy. They return a Sample, or None while there is no such sample yet; each other result is an
exception of ReadError. A reader or writer belongs to one thread at a time: another one gets InUse.
Calls that can wait release the interpreter's lock, and Ctrl-C interrupts waits for samples.
"""

from collections.abc import Sequence
from typing import Any

from dssm import _asyncio, _dssm
from dssm._dssm import (
    FOREIGN_CLOCK, NO_TID, UNKNOWN_CLOCK_ERROR, Borrowed, ClockReading, DaemonInfo, Field, HostInfo,
    PlaybackClock, Reader, RecordedOutput, RecordedReader, RecordedStreamInfo, RecordedTrigger, Recording,
    RecordingCursor, RecordingWriter, Sample, SampleInfo, Session, StreamInfo, StreamUser, TypeInfo, Writer,
    __version__, clock_now, wait_any,
)
from dssm._errors import (
    Arriving, ClockOutOfBounds, Closed, Conflict, Error, InUse, InvalidArgument, Lapped, LimitExceeded, Lost,
    NoDaemon, NoMemory, NoPermission, NotFound, NotYet, Overwritten, ProtocolError, ReadError, Restarted, Stale,
    TooOld, TooShort, TypeMismatch, Unavailable,
)
from dssm._types import type_and_dtype as _type_and_dtype

__all__ = [
    "Arriving", "Borrowed", "ClockOutOfBounds", "ClockReading", "Closed", "Conflict", "DaemonInfo", "Error",
    "FOREIGN_CLOCK", "Field", "HostInfo", "InUse", "InvalidArgument", "JointSamples", "Lapped", "LimitExceeded",
    "Lost", "NO_TID", "NoDaemon", "NoMemory", "NoPermission", "NotFound", "NotYet", "Overwritten", "PlaybackClock",
    "ProtocolError", "ReadError", "Reader", "RecordedOutput", "RecordedReader", "RecordedStreamInfo",
    "RecordedTrigger", "Recording", "RecordingCursor", "RecordingWriter", "Restarted", "Sample", "SampleInfo",
    "Session", "Stale", "StreamInfo", "StreamUser", "TooOld", "TooShort", "TypeInfo", "TypeMismatch",
    "UNKNOWN_CLOCK_ERROR", "Unavailable", "Writer", "__version__", "clock_now", "read_joint", "type_info",
    "wait_any",
]


class JointSamples(tuple[Sample, ...]):
    """The samples of a joint read, in the order of the readers."""

    clock_error_ns: int
    """How far the time of any of them may be from this PC's clock [ns]; UNKNOWN_CLOCK_ERROR."""


def read_joint(time: Any, readers: Sequence[Reader] | Sequence[RecordedReader], *, max_error: Any = None,
               max_age: Any = None, wait: Any = False) -> JointSamples | None:
    """The sample of each stream that at(time) returns: of all of them or none.

    All readers are of live streams, or all of recordings. None while one of the streams has no sample.
    Raises as at(); also ClockOutOfBounds when the time of a sample may be further than `max_error` from
    this PC's clock. Cursors are kept.

    wait: for samples that are on their way from another host, True waits without a limit, a duration at
    most so long; then Arriving is raised.
    """
    readers = list(readers)
    recorded = bool(readers) and isinstance(readers[0], RecordedReader)
    read = _dssm._read_joint_recorded if recorded else _dssm._read_joint
    result = read(time, readers, max_error, max_age, wait)
    if result is None:
        return None
    samples = JointSamples(result[0])
    samples.clock_error_ns = result[1]
    return samples


def type_info(type: Any, name: str | None = None) -> TypeInfo:
    """The description of a numpy.dtype, of what numpy makes one of, or of a dataclass.

    A dataclass and a ctypes.Structure have their name, so that C++ programs with a struct of that name
    can use the stream; `name` gives another one. A dtype has none, which matches each name.
    """
    info = _type_and_dtype(type)[0]
    if name is None:
        return info
    return TypeInfo(name, info.payload_bytes, info.alignment_bytes, info.fields)


# What needs asyncio is written in Python.
Reader.__aiter__ = _asyncio.samples  # type: ignore[method-assign, assignment]
Reader.wait_async = _asyncio.wait  # type: ignore[method-assign]
Reader.close = _asyncio.close  # type: ignore[method-assign]
Reader.__exit__ = _asyncio.leave  # type: ignore[method-assign]
