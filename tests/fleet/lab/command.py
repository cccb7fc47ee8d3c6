# SPDX-License-Identifier: Apache-2.0
"""Running programs of this machine, with failures that say what was tried and what it said."""

import pathlib
import shlex
import subprocess


class CommandError(Exception):
    """A program ended badly; the text holds the command and its output."""


# Namespaces in which all processes end with the first one.
CONTAINED = ("unshare", "--pid", "--mount", "--fork", "--kill-child=SIGKILL", "--mount-proc")


def run(*command: str | pathlib.Path, what: str, timeout: float = 600, contained: bool = False) -> str:
    """Runs `command` and returns its stdout. `what` names the aim, for the failure's text.

    `contained`: when this ends early, so does all that the command has started.
    """
    words = [*(CONTAINED if contained else ()), *map(str, command)]
    try:
        done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True,
                              timeout=timeout, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CommandError(f"cannot {what}: {error}") from error
    if done.returncode:
        raise CommandError(f"cannot {what}: '{shlex.join(words)}' ended with {done.returncode}:\n"
                           f"{done.stdout[-4000:]}{done.stderr[-4000:]}")
    return done.stdout
