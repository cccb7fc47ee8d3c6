# SPDX-License-Identifier: Apache-2.0
"""The half of bench_python.cpp that is written in Python.

Reads lines "OPERATION COUNT" and answers each with the time of one operation in ns, without that of
an empty call.
"""

import sys
import time

import dssm

session = dssm.Session()
small, large = session.reader("small"), session.reader("large")
small_writer = session.writer("small")
value = small.newest().value
newest_ns = small.newest().time_ns


def borrow() -> None:
    with large.borrow() as sample:
        sample.value


OPERATIONS = {
    "read": small.newest,
    "read_value": lambda: small.newest().value,
    "at": lambda: small.at(newest_ns),
    "write": lambda: small_writer.write(value, newest_ns),
    "read_large": large.newest,
    "borrow": borrow,
}


def run(call, count: int) -> float:
    started = time.perf_counter_ns()
    for _ in range(count):
        call()
    return (time.perf_counter_ns() - started) / count


for line in sys.stdin:
    name, count = line.split()
    empty = run(lambda: None, int(count))
    print(run(OPERATIONS[name], int(count)) - empty, flush=True)
