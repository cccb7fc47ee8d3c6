# SPDX-License-Identifier: Apache-2.0
"""Runs programs of this machine; errors name the aim, the command and its output."""

import pathlib
import shlex
import subprocess


class CommandError(Exception):
    """A program failed; the text contains the command and its output."""


# Namespaces in which all processes end with the first one.
CONTAINED = ("unshare", "--pid", "--mount", "--fork", "--kill-child=SIGKILL", "--mount-proc")


def run(*command: str | pathlib.Path, what: str, timeout: float = 600, contained: bool = False) -> str:
    """Runs `command` and returns its stdout. `what` is the aim, for the error's text.

    `contained`: if this program ends early, so do all processes of the command.
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
