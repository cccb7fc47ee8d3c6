# SPDX-License-Identifier: Apache-2.0
"""Reads what climate.cpp wrote through the installed dssmd, then writes and reads a sample itself."""

import dataclasses

import dssm


@dataclasses.dataclass
class Climate:
    temperature_c: float


with dssm.Session() as session, session.reader("climate", Climate) as reader:
    assert reader.newest().value.temperature_c == 21.5
    with session.writer("climate", Climate) as writer:
        tid = writer.write(Climate(22.5))
    with reader.borrow(tid) as sample:
        assert sample.value["temperature_c"] == 22.5
