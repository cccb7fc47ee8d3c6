#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""starve.py LONGEST_MS PAUSE_MS COMMAND...: runs the command and meanwhile withholds the processors from
some of its processes, others each time, for up to LONGEST_MS, with pauses of up to PAUSE_MS.

This is like an overloaded machine; it reveals tests that need their processes to run at the same time.
(tests/support/stall.cpp stops all of them at once.) The picked processes get SCHED_IDLE of sched(7),
beside busy loops, two on each processor.

Ends with the command's exit status; 2: wrong arguments; 77: this machine does not allow it.
"""

import ctypes
import os
import pathlib
import random
import signal
import subprocess
import sys
import time

LOOPS_PER_PROCESSOR = 2
STARVED = 0.25  # share of the processes, each time
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
AUTOGROUP = pathlib.Path("/proc/sys/kernel/sched_autogroup_enabled")


def prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def parent_of(pid: int) -> int:
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as stat:
            return int(stat.read().rpartition(")")[2].split()[1])
    except OSError:
        return 0  # it has ended


def processes_below(ancestor: int) -> list[int]:
    children: dict[int, list[int]] = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        children.setdefault(parent_of(int(name)), []).append(int(name))
    found: list[int] = []
    to_visit = [ancestor]
    while to_visit:
        below = children.get(to_visit.pop(), [])
        found += below
        to_visit += below
    return found


def reschedule(pids: list[int], only: int, policy: int) -> None:
    """Moves all threads of these processes that are scheduled by `only` to `policy`."""
    for pid in pids:
        try:
            for thread in map(int, os.listdir(f"/proc/{pid}/task")):
                if os.sched_getscheduler(thread) == only:
                    os.sched_setscheduler(thread, policy, os.sched_param(0))
        except OSError:
            continue  # it has ended


def start_loop(processor: int) -> int:
    """A process that uses all available processor time while it runs; initially stopped."""
    pid = os.fork()
    if pid == 0:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        os.sched_setaffinity(0, {processor})
        while True:
            pass
    os.kill(pid, signal.SIGSTOP)
    return pid


def starve(command: subprocess.Popen[bytes], loops: list[int], longest: float, pause: float) -> None:
    while command.poll() is None:
        time.sleep(random.uniform(0, pause))
        pids = [pid for pid in processes_below(os.getpid()) if pid not in loops]
        picked = [pid for pid in pids if random.random() < STARVED]
        reschedule(picked, os.SCHED_OTHER, os.SCHED_IDLE)
        for loop in loops:
            os.kill(loop, signal.SIGCONT)
        time.sleep(random.uniform(0, longest))
        for loop in loops:
            os.kill(loop, signal.SIGSTOP)
        # Also those that a picked process has started meanwhile.
        reschedule(processes_below(os.getpid()), os.SCHED_IDLE, os.SCHED_OTHER)


def main() -> int:
    words = sys.argv[1:]
    if len(words) < 3 or not all(word.isdigit() and int(word) > 0 for word in words[:2]):
        print("usage: starve.py LONGEST_MS PAUSE_MS COMMAND...\n"
              "for example: starve.py 800 800 meson test -C build --timeout-multiplier 5",
              file=sys.stderr)
        return 2
    if AUTOGROUP.exists() and AUTOGROUP.read_text(encoding="ascii").strip() != "0":
        print("starve.py: the kernel shares processors among sessions, not processes; write 0 to "
              f"{AUTOGROUP} for the time being", file=sys.stderr)
        return 77
    priority = os.getpriority(os.PRIO_PROCESS, 0)
    loops = [start_loop(processor) for processor in os.sched_getaffinity(0)
             for _ in range(LOOPS_PER_PROCESSOR)]
    try:
        os.setpriority(os.PRIO_PROCESS, 0, -20)  # so that this process runs in time
        prctl(PR_SET_CHILD_SUBREAPER, 1)         # orphaned processes stay below this one
        with subprocess.Popen(words[2:], preexec_fn=lambda: os.setpriority(
                os.PRIO_PROCESS, 0, priority)) as command:
            starve(command, loops, int(words[0]) / 1000, int(words[1]) / 1000)
        return command.returncode if command.returncode >= 0 else 128 - command.returncode
    except PermissionError as error:
        print(f"starve.py: {error}; run it as root", file=sys.stderr)
        return 77
    finally:
        for loop in loops:
            os.kill(loop, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
