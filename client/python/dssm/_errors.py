# SPDX-License-Identifier: Apache-2.0
"""The exceptions of DSSM. docs/errors.md describes when each code of dssmd and the library is used."""


class Error(Exception):
    """A failure; its text says what was tried, on what, why it failed and what to do."""

    code = "system"
    """The code's name as in C++, such as 'not_found'."""


class InvalidArgument(Error, ValueError):
    """The caller's input is wrong: a name, a size, a type."""

    code = "invalid_argument"


class NotFound(Error, LookupError):
    """There is no such stream, host or file."""

    code = "not_found"


class TypeMismatch(Error, TypeError):
    """The stream has another type; the text has both descriptions."""

    code = "type_mismatch"


class LimitExceeded(Error):
    """A configured limit of dssmd, or one of the format."""

    code = "limit_exceeded"


class NoMemory(Error, MemoryError):
    """The PC has no memory for it, or no space on the disk."""

    code = "no_memory"


class NoPermission(Error):
    """The operating system or dssmd refuses this user."""

    code = "no_permission"


class NoDaemon(Error):
    """Nothing listens at dssmd's socket."""

    code = "no_daemon"


class Unavailable(Error):
    """dssmd, or what holds a stream's lock, does not answer; a retry helps."""

    code = "unavailable"


class ProtocolError(Error):
    """The other side has another protocol version, or a file is damaged."""

    code = "protocol"


class Conflict(Error):
    """Two things have one name, or a stream is in use and has another type or history."""

    code = "conflict"


class Closed(Error):
    """The object was closed."""

    code = "closed"


class InUse(Error):
    """Another thread uses the reader or writer, or a borrowed sample still shows its memory."""

    code = "in_use"


class ReadError(Error):
    """A read has no sample to return, and None does not describe why."""

    code = "read"


class NotYet(ReadError):
    """The sample is not written yet; only borrow() raises it, other reads return None."""

    code = "not_yet"


class TooOld(ReadError):
    """The stream no longer has the sample."""

    code = "too_old"


class Lapped(ReadError):
    """The writer overtook each attempt to copy the sample."""

    code = "lapped"


class Restarted(ReadError):
    """The stream has a new ring, whose tids begin at 0 again."""

    code = "restarted"


class ClockOutOfBounds(ReadError):
    """Two hosts' clocks may be further apart than is allowed."""

    code = "clock_out_of_bounds"


class Arriving(ReadError):
    """The sample is on its way from another host: read it again later, or with wait=."""

    code = "arriving"


class Lost(ReadError):
    """The network could not carry the sample, or it was not recorded."""

    code = "lost"


class Stale(ReadError):
    """The sample is older than the maximum age."""

    code = "stale"


class TooShort(ReadError):
    """The borrowed sample has fewer bytes than the type."""

    code = "too_short"


class Overwritten(ReadError):
    """A borrowed sample was overwritten: what was computed with it is void."""

    code = "overwritten"


def _subclasses(error: type[Error]) -> dict[str, type[Error]]:
    error.__module__ = "dssm"  # tracebacks show the name that programs use
    found = {error.code: error}
    for each in error.__subclasses__():
        found |= _subclasses(each)
    return found


_BY_CODE = _subclasses(Error)


def by_code(code: str) -> type[Error]:
    """The exception for a code."""
    return _BY_CODE.get(code, Error)
