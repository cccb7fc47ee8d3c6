# SPDX-License-Identifier: Apache-2.0
"""Sessions, types, reads, writes, views and waits of the Python package, with a dssmd."""

import asyncio
import ctypes
import dataclasses
import datetime
import gc
import os
import select
import signal
import subprocess
import sys
import threading
import time
import unittest.mock
from decimal import Decimal
from typing import Annotated

import dssm
import numpy as np
from support import BUILD, PATIENT_S, Case, Daemon, await_that, python


@dataclasses.dataclass
class Pose:
    x: float
    y: float


@dataclasses.dataclass
class Odometry:
    pose: Pose
    ticks: np.uint16
    ranges: Annotated[np.ndarray, ("f4", 3)]
    valid: bool


def odometry(x: float) -> Odometry:
    return Odometry(Pose(x, 2.0), 7, np.array([1, 2, 3], "f4"), True)


SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND


class Sessions(Case):
    def test_no_daemon(self):
        with self.assertRaises(dssm.NoDaemon) as caught:
            dssm.Session("/nonexistent/dssmd.sock")
        self.assertIn("/nonexistent/dssmd.sock", str(caught.exception))
        self.assertEqual(caught.exception.code, "no_daemon")

    def test_streams_hosts_and_daemon(self):
        with self.session.create("listed", "f8", depth=8, cycle=0.5) as writer:
            writer.write(1.5, T0)
            stream = {stream.name: stream for stream in self.session.streams()}["listed:0@pc1"]
            self.assertEqual((stream.host, stream.depth, stream.cycle), ("pc1", 8, 0.5))
            self.assertEqual((stream.newest_tid, stream.newest_time_ns), (0, T0))
            users = self.session.stream("listed").users
            self.assertEqual([(user.pid, user.role) for user in users], [(os.getpid(), "writer")])
        self.assertEqual([host.name for host in self.session.hosts()], ["pc1"])
        self.assertEqual(self.session.hosts()[0].state, "self")
        self.assertEqual(self.session.daemon().host, "pc1")
        self.assertTrue(self.session.is_connected)
        self.assertEqual(dssm.__version__, self.session.daemon().version)

    def test_errors_have_codes_and_text(self):
        with self.assertRaises(dssm.NotFound) as caught:
            self.session.reader("nothing")
        self.assertIn("nothing", str(caught.exception))
        self.assertIsInstance(caught.exception, dssm.Error)
        with self.assertRaises(dssm.InvalidArgument):
            self.session.create("a" * 40, "f8", depth=8, cycle=0.1)
        with self.assertRaises(dssm.NotFound):
            self.session.remove("nothing")

    def test_remove(self):
        self.session.create("removed", "f8", depth=8, cycle=0.1).close()
        self.session.remove("removed")
        self.assertNotIn("removed:0@pc1", [stream.name for stream in self.session.streams()])

    def test_properties(self):
        with self.session.create("calibrated", "f8", depth=8, cycle=0.1) as writer, self.session.reader("calibrated") as reader:
            self.assertIsNone(self.session.property("calibrated"))
            self.assertIsNone(reader.property())
            writer.set_property(b"focus 3\0")
            self.assertEqual(self.session.property("calibrated"), b"focus 3\0")
            self.assertEqual(reader.property(), b"focus 3\0")
            self.session.set_property("calibrated", b"")
            self.assertIsNone(reader.property())
        with self.assertRaises(dssm.NotFound):
            self.session.property("nothing")

    def test_closed_objects_raise(self):
        session = dssm.Session()
        writer = session.create("closing", "f8", depth=8, cycle=0.1)
        reader = session.reader("closing")
        session.close()
        writer.write(1.0, T0)
        self.assertEqual(reader.newest().value, 1.0)  # both outlive the session
        reader.close()
        writer.close()
        self.assertTrue(reader.closed and writer.closed)
        for call in (session.streams, reader.newest, lambda: writer.write(1.0), lambda: reader.depth):
            with self.assertRaises(dssm.Closed):
                call()

    def test_what_objects_show(self):
        session = dssm.Session()
        writer = session.create("shown", Pose, depth=8, cycle=0.1)
        reader = session.reader("shown")
        scalar = session.create("scalar", "f8", depth=8, cycle=0.1)
        self.assertEqual(repr(session), f"<dssm.Session {self.daemon.socket_path} connected>")
        self.assertEqual(repr(reader), "<dssm.Reader shown:0@pc1: 'Pose' (16 bytes, aligned to 8), nothing written>")
        self.assertEqual(repr(scalar), "<dssm.Writer scalar:0@pc1: 8 bytes, nothing written>")
        for _ in range(3):
            writer.write((1.0, 2.0))
        self.assertEqual(repr(reader), "<dssm.Reader shown:0@pc1: 'Pose' (16 bytes, aligned to 8), newest tid 2>")
        self.assertEqual(repr(writer), repr(reader).replace("Reader", "Writer"))
        for each in (reader, writer, scalar, session):
            each.close()
        self.assertEqual([repr(each) for each in (reader, writer, session)],
                         ["<dssm.Reader closed>", "<dssm.Writer closed>", "<dssm.Session closed>"])

    def test_playback_clock(self):
        clock = self.session.playback_clock()
        clock.set_paused(True)
        clock.set_time(1000.0)
        self.assertEqual((clock.now(), clock.paused), (1000.0, True))
        clock.sleep_until(999.0)
        clock.reset()
        self.assertLess(abs(clock.now() - time.time()), PATIENT_S)

    def test_clock(self):
        before = time.time_ns()
        now = dssm.clock_now()
        self.assertLessEqual(before, now.time_ns)
        self.assertLessEqual(now.time_ns, time.time_ns())

    def test_dssmctl_knows_the_script(self):
        with self.session.create("ours", "f8", depth=8, cycle=0.1):
            self.assertEqual(self.session.stream("ours").users[0].program, os.path.basename(sys.argv[0]))


class Types(Case):
    def create(self, name, type, **options):
        writer = self.session.create(name, type, depth=16, cycle=0.1, **options)
        self.addCleanup(writer.close)
        reader = self.session.reader(name)
        self.addCleanup(reader.close)
        return writer, reader

    def test_dataclass(self):
        writer, reader = self.create("dataclass", Odometry)
        self.assertEqual(writer.type.name, "Odometry")
        # The layout of struct { struct { double x, y; } pose; uint16_t ticks; float ranges[3]; bool valid; }
        self.assertEqual([(f.name, f.kind, f.offset_bytes, f.count) for f in writer.type.fields],
                         [("pose.x", "float64", 0, 1), ("pose.y", "float64", 8, 1), ("ticks", "uint16", 16, 1),
                          ("ranges", "float32", 20, 3), ("valid", "bool", 32, 1)])
        self.assertEqual((writer.payload_bytes, writer.type.alignment_bytes), (40, 8))
        writer.write(odometry(1.0), T0)
        value = reader.newest().value
        self.assertEqual((value.pose.x, value["pose"]["y"], value.ticks, value.valid), (1.0, 2.0, 7, True))
        np.testing.assert_array_equal(value.ranges, [1, 2, 3])
        self.assertEqual(self.session.reader("dataclass", Odometry).newest().value.pose.x, 1.0)

    def test_values_of_all_forms_are_written(self):
        writer, reader = self.create("forms", np.dtype([("a", "i4"), ("b", [("c", "f8"), ("d", "S4")]), ("e", "u1", 2)]))
        expected = (1, (2.5, b"abc"), [3, 4])
        forms = [expected, {"a": 1, "b": {"c": 2.5, "d": b"abc"}, "e": [3, 4]}]
        array = np.zeros((), writer.dtype)
        array[...] = (1, (2.5, b"abc"), [3, 4])
        forms += [array, array[()]]
        for form in forms:
            with self.subTest(form=type(form)):
                writer.write(form, T0)
                value = reader.newest().value
                self.assertEqual((value.a, value.b.c, value.b.d, list(value.e)), (1, 2.5, b"abc", [3, 4]))
        writer.write(reader.newest().value, T0)  # what was read
        self.assertEqual(reader.newest().value.b.c, 2.5)

    def test_wrong_values_name_the_field(self):
        writer, _ = self.create("wrong", np.dtype([("a", "i4"), ("b", [("c", "f8", 2)])]))
        for value, text in (({"a": 1}, "missing: \\['b'\\]"), ({"a": 1, "b": {"c": [1, 2]}, "z": 3}, "unknown: \\['z'\\]"),
                            ({"a": 1, "b": {"c": [1, 2, 3]}}, "b.c has the shape \\(2,\\)"), ((1,), "2 fields")):
            with self.subTest(value=value), self.assertRaisesRegex(ValueError, text):
                writer.write(value)
        with self.assertRaises(TypeError):
            writer.write(3)
        self.assertEqual(writer.newest_tid, dssm.NO_TID)

    def test_values_that_do_not_fit_are_refused(self):
        """numpy would write other ones: 70000 becomes 4464 in an int16, and 1.5 becomes 1."""
        numbers = np.dtype([("n", "i2"), ("u", "u8"), ("f", "f4"), ("b", "?"), ("s", "S3"), ("v", "V2"),
                            ("a", "u1", 3), ("p", [("x", "i4")], 2)])
        writer, reader = self.create("fitting", numbers)
        good = {"n": -32768, "u": 2**64 - 1, "f": 1e38, "b": True, "s": "abc", "v": b"ab", "a": [0, 1, 255], "p": [(1,), (2,)]}
        writer.write(good, T0)
        value = reader.newest().value
        self.assertEqual((value.n, value.u, value.b, value.s, list(value.a)), (-32768, 2**64 - 1, True, b"abc", [0, 1, 255]))
        writer.write(good | {"n": 3.0, "u": Decimal(7), "f": float("inf"), "b": 0, "s": b"a", "a": np.array([1.0, 2.0, 3.0])}, T0)
        value = reader.newest().value
        self.assertEqual((value.n, value.u, value.f, value.b, value.s, list(value.a)), (3, 7, np.inf, False, b"a", [1, 2, 3]))
        whole = "n: .* does not fit into int16, which holds whole numbers from -32768 to 32767"
        for field, bad, text in (
                ("n", 70000, "^n: 70000 does not fit into int16, which holds whole numbers from -32768 to 32767$"),
                ("n", np.int64(70000), whole), ("n", 1.5, whole), ("n", float("nan"), whole), ("n", float("inf"), whole),
                ("n", 10**30, whole), ("n", Decimal("1.5"), whole),
                ("u", -1, "^u: -1 does not fit into uint64"), ("u", np.int8(-1), "^u: -1 "), ("u", 2.0**64, "^u: "),
                ("f", 1e39, "^f: 1e\\+39 does not fit into float32"), ("f", Decimal("1e400"), "^f: 1E\\+400 does not fit"), ("b", 2, "^b: 2 does not fit into bool"),
                ("s", b"abcd", "^s: b'abcd' has 4 bytes, and there is space for 3$"), ("s", "é", "^s: .*ASCII"),
                ("v", b"abc", "^v: b'abc' has 3 bytes, and there is space for 2$"),
                ("a", [1, 2, 256], "^a\\[2\\]: 256 does not fit into uint8"), ("a", np.array([1, -2, 3]), "^a\\[1\\]: -2 "),
                ("a", [1, 2], "^a has the shape \\(3,\\), not \\(2,\\)"), ("a", [[1], [2, 3], 4], "^a: .*inhomogeneous"),
                ("p", [(1,), (2**31,)], "^p\\[1\\].x: 2147483648 does not fit into int32"), ("p", [(1,)], "^p has 2 elements")):
            with self.subTest(field=field, bad=bad), self.assertRaisesRegex(ValueError, text):
                writer.write(good | {field: bad})
        for field, bad in (("n", "3"), ("n", None), ("f", "1"), ("f", 1j), ("s", 3), ("u", np.datetime64(3, "ns")), ("a", [1, None, 2])):
            with self.subTest(field=field, bad=bad), self.assertRaisesRegex(TypeError, f"^{field}"):
                writer.write(good | {field: bad})
        wider = np.zeros((), [("n", "i8")])
        wider["n"] = 70000
        narrow, _ = self.create("narrow", np.dtype([("n", "i2")]))
        scalar, _ = self.create("scalars", "u1")
        array, of_array = self.create("arrays", ("u8", (2,)))
        for bad in (wider, wider[()], (70000,)):
            with self.subTest(bad=bad), self.assertRaisesRegex(ValueError, "^n: 70000"):
                narrow.write(bad)
        with self.assertRaisesRegex(ValueError, "^the sample: 256 does not fit into uint8"):
            scalar.write(256)
        with self.assertRaisesRegex(ValueError, "^the sample\\[1\\]: -1 "):
            array.write([1, -1])
        array.write([1, 2**63 + 1], T0)  # of which numpy makes floats
        self.assertEqual(list(of_array.newest().value), [1, 2**63 + 1])
        self.assertEqual([w.newest_tid for w in (writer, narrow, scalar, array)], [1, dssm.NO_TID, dssm.NO_TID, 0])

    def test_scalars_and_arrays(self):
        writer, reader = self.create("scalar", np.float32)
        writer.write(0.5, T0)
        self.assertIsInstance(reader.newest().value, np.float32)
        self.assertEqual(reader.newest().value, 0.5)
        writer, reader = self.create("array", ("u2", (3,)))
        writer.write([1, 2, 65535], T0)
        np.testing.assert_array_equal(reader.newest().value, np.array([1, 2, 65535], "u2"))
        with self.assertRaisesRegex(ValueError, "shape \\(3,\\), not \\(2,\\)"):
            writer.write([1, 2])

    def test_bytes_of_different_lengths(self):
        writer, reader = self.create("bytes", np.dtype("V100"))
        self.assertEqual(writer.type.fields, [])
        writer.write(b"abc", T0)
        sample = reader.newest()
        self.assertEqual((sample.value.tobytes(), sample.payload_bytes), (b"abc", 3))
        writer.write(np.arange(100, dtype="u1"), T0)
        np.testing.assert_array_equal(reader.newest().value, np.arange(100))
        history = reader.history(T0, T0 + 1)
        self.assertEqual(list(history.payload_bytes), [3, 100])
        self.assertEqual(history.value[0].tobytes(), b"abc" + bytes(97))
        with self.assertRaisesRegex(ValueError, "at most 100 bytes"):
            writer.write(bytes(101))

    def test_arrays_of_structs(self):
        point = np.dtype([("x", "f4"), ("id", "u1"), ("v", "i2", 2)], align=True)
        cloud = np.dtype([("n", "u4"), ("points", point, 3)], align=True)
        writer, reader = self.create("cloud", cloud)
        value = np.zeros((), cloud)
        value["n"] = 3
        value["points"]["x"] = [1, 2, 3]
        value["points"]["v"][1] = [5, 6]
        writer.write(value, T0)
        read = reader.newest().value
        np.testing.assert_array_equal(read.points["x"], [1, 2, 3])
        np.testing.assert_array_equal(read["points"]["v"], [[0, 0], [5, 6], [0, 0]])
        self.assertEqual(reader.dtype["points"].shape, (3,))
        self.assertEqual(reader.dtype.itemsize, cloud.itemsize)

    def test_ctypes(self):
        class Twist(ctypes.Structure):
            _fields_ = [("linear", ctypes.c_double), ("angular", ctypes.c_float)]

        writer, reader = self.create("ctypes", Twist)
        self.assertEqual((writer.type.name, writer.payload_bytes), ("Twist", 16))
        writer.write((1.0, 0.25), T0)
        self.assertEqual(reader.newest().value.angular, 0.25)

    def test_types_of_other_programs(self):
        # What a C++ program describes with DSSM_DESCRIBE: padding, structs, and arrays of structs.
        fields = [dssm.Field("stamp", "int64", 8), dssm.Field("p.x", "float32", 20, 2, 12),
                  dssm.Field("p.k", "uint8", 24, 2, 12), dssm.Field("name", "char", 44, 5, 1),
                  dssm.Field("q[0].v", "int16", 50, 2, 2), dssm.Field("q[1].v", "int16", 56, 2, 2)]
        writer, reader = self.create("described", dssm.TypeInfo("Foreign", 64, 8, fields))
        raw = bytearray(64)
        raw[8:16] = (42).to_bytes(8, "little")
        raw[20:24], raw[32:36] = np.float32(1.5).tobytes(), np.float32(2.5).tobytes()
        raw[24], raw[36], raw[44:47] = 9, 10, b"cam"
        raw[56:60] = np.array([7, 8], "<i2").tobytes()
        writer.write(np.frombuffer(raw, reader.dtype)[0], T0)
        value = reader.newest().value
        self.assertEqual((value.stamp, value.name), (42, b"cam"))
        self.assertEqual((list(value.p["x"]), list(value.p["k"])), ([1.5, 2.5], [9, 10]))
        np.testing.assert_array_equal(value.q["v"], [[0, 0], [7, 8]])

    def test_wrong_type_shows_both(self):
        self.create("typed", Pose)

        @dataclasses.dataclass
        class Other:
            x: float
            y: np.int64

        for wanted in (Other, np.dtype([("x", "f8"), ("y", "i8")]), np.dtype([("x", "f8")])):
            with self.subTest(wanted=wanted), self.assertRaises(dssm.TypeMismatch) as caught:
                self.session.reader("typed", wanted)
            self.assertIn("float64 y at 8", str(caught.exception))
            if wanted is not Other and len(wanted) == 2:
                self.assertIn("int64 y at 8", str(caught.exception))
        with self.assertRaises(dssm.TypeMismatch):
            self.session.writer("typed", Other)
        self.session.reader("typed", np.dtype([("x", "f8"), ("y", "f8")])).close()  # a dtype has no name

    def test_a_wrong_dtype_is_shown_under_no_name_of_the_stream(self):
        scan = np.dtype([("range", "f4", 2)])
        self.create("scans", dssm.type_info(scan, "Scan"))
        self.create("nameless", scan)
        shown = "^open 'scans:0@pc1': the stream carries 'Scan' \\(8 bytes.*, this program wants "
        for stream, wanted, text in (
                ("scans", "f8", shown + "dtype float64 \\(8 bytes"), ("scans", np.dtype([("x", "f8")]), shown + "a type without a name \\(8"),
                ("scans", Pose, shown + "'Pose' \\(16"), ("scans", ("i4", 2), shown + "dtype \\('<i4', \\(2,\\)\\) \\(8"),
                ("nameless", Pose, "the stream carries a type without a name \\(8 .* wants 'Pose'")):
            with self.subTest(stream=stream, wanted=wanted), self.assertRaisesRegex(dssm.TypeMismatch, text):
                self.session.reader(stream, wanted)

    def test_unnamed_types_are_compared_too(self):
        self.create("unnamed", np.dtype([("x", "f8")]))
        with self.assertRaises(dssm.TypeMismatch):
            self.session.reader("unnamed", np.dtype([("x", "i8")]))
        with self.assertRaises(dssm.TypeMismatch):
            self.session.create("unnamed", np.dtype([("x", "i8")]), depth=16, cycle=0.1)

    def test_types_that_streams_cannot_have(self):
        for type in (np.dtype("c16"), np.dtype(">f8"), np.dtype("U4"), object, np.dtype("M8[ns]"), "nonsense"):
            with self.subTest(type=type), self.assertRaises(dssm.InvalidArgument):
                self.session.create("impossible", type, depth=8, cycle=0.1)

        @dataclasses.dataclass
        class Unsized:
            name: str

        with self.assertRaisesRegex(dssm.InvalidArgument, "Unsized.name.*Annotated"):
            self.session.create("impossible", Unsized, depth=8, cycle=0.1)

    def test_history_of_create(self):
        with self.session.create("lived", "f8", life=10, cycle=0.1) as writer:
            self.assertEqual((writer.depth, writer.cycle), (121, 0.1))
        with self.session.create("lived2", "f8", life=datetime.timedelta(seconds=10), cycle=np.timedelta64(100, "ms")) as w:
            self.assertEqual(w.depth, 121)
        for options in ({}, {"life": 10}, {"cycle": 1}, {"life": 10, "cycle": 1, "depth": 3}):
            with self.subTest(options=options), self.assertRaises(TypeError):
                self.session.create("unlived", "f8", **options)

    def test_create_names_what_is_missing(self):
        for arguments, options, text in (
                (("x",), {}, "needs type"), (("x", "f8"), {}, "needs cycle"), (("x", "f8"), {"depth": 8}, "needs cycle"),
                (("x", "f8"), {"cycle": 0.1}, "either life \\[s\\] or depth"), (("x", "f8"), {"cycle": 0.1, "depth": 2.5}, "depth is a whole number")):
            with self.subTest(options=options), self.assertRaisesRegex(TypeError, text):
                self.session.create(*arguments, **options)
        for depth in (-1, 1 << 64):
            with self.subTest(depth=depth), self.assertRaisesRegex(ValueError, f"not {depth}$"):
                self.session.create("x", "f8", cycle=0.1, depth=depth)


class Reads(Case):
    def setUp(self):
        super().setUp()
        self.writer = self.session.create("x", np.dtype([("v", "i8")]), depth=8, cycle=1)
        self.reader = self.session.reader("x")
        self.addCleanup(self.reader.close)
        self.addCleanup(lambda: self.writer.close())  # some tests replace it
        self.addCleanup(lambda: self.session.remove("x"))

    def fill(self, count):
        """Values 0, 1, 2 ... at seconds 0, 1, 2 ... after T0; the ring holds 7."""
        for i in range(count):
            self.writer.write((i,), T0 + i * SECOND)

    def test_nothing_is_written_yet(self):
        reader = self.reader
        for read in (reader.newest, reader.next, reader.previous, lambda: reader.tid(3), lambda: reader.at(T0),
                     lambda: reader.nearest(T0), lambda: reader.neighbours(T0), lambda: reader.find(T0),
                     lambda: reader.at_or_after(T0), lambda: reader.info(0)):
            self.assertIsNone(read())
        self.assertEqual((reader.newest_tid, reader.cursor), (dssm.NO_TID, dssm.NO_TID))
        self.assertEqual(len(reader.history(T0, T0 + SECOND)), 0)
        with self.assertRaises(dssm.NotYet), reader.borrow():
            pass

    def test_in_order(self):
        self.fill(3)
        self.assertEqual(self.reader.next().tid, 2)  # a new reader begins with the newest one
        self.assertIsNone(self.reader.next())
        self.assertEqual(self.reader.previous().value.v, 1)
        self.reader.seek(dssm.NO_TID)
        self.assertEqual([self.reader.next().value.v for _ in range(3)], [0, 1, 2])
        self.assertEqual(self.reader.cursor, 2)
        self.fill(9)
        self.assertEqual(self.reader.next().tid, 5)
        self.assertEqual(self.reader.lost_samples, 2)

    def test_by_tid(self):
        self.fill(10)
        sample = self.reader.tid(5)
        self.assertEqual((sample.tid, sample.time_ns, sample.value.v), (5, T0 + 5 * SECOND, 5))
        self.assertEqual(sample.time, np.datetime64(T0 + 5 * SECOND, "ns"))
        self.assertEqual(self.reader.info(5).time_ns, T0 + 5 * SECOND)
        self.assertIsNone(self.reader.tid(10))
        with self.assertRaises(dssm.TooOld) as caught:
            self.reader.tid(1)
        self.assertIn("x:0@pc1", str(caught.exception))
        self.assertIn("sample 1", str(caught.exception))

    def test_by_time(self):
        self.fill(5)
        at = self.reader.at
        self.assertEqual(at(T0 + 2 * SECOND).tid, 2)
        self.assertEqual(at(T0 + 2 * SECOND - 1).tid, 1)
        self.assertEqual(at(np.datetime64(T0 + 2 * SECOND - 1, "ns")).tid, 1)
        self.assertEqual(at(np.datetime64(1_700_000_003, "s")).tid, 3)
        self.assertEqual(at(np.int64(T0)).tid, 0)
        self.assertEqual(self.reader.at_or_after(T0 + 1).tid, 1)
        self.assertIsNone(self.reader.at_or_after(T0 + 5 * SECOND))
        self.assertEqual(self.reader.nearest(T0 + SECOND // 2 + 1).tid, 1)
        self.assertEqual(self.reader.find(T0 + SECOND).tid, 1)
        before, after = self.reader.neighbours(T0 + SECOND)
        self.assertEqual((before.value.v, after.value.v), (1, 2))
        self.assertIsNone(self.reader.neighbours(T0 + 4 * SECOND))
        with self.assertRaises(dssm.TooOld):
            at(T0 - 1)
        self.assertEqual(at(T0 + 5 * SECOND, 1).tid, 4)
        for age in (0.999, datetime.timedelta(milliseconds=999), np.timedelta64(999, "ms")):
            with self.subTest(age=age), self.assertRaises(dssm.Stale):
                at(T0 + 5 * SECOND, max_age=age)
        self.assertEqual(self.reader.cursor, dssm.NO_TID)
        self.assertEqual(self.reader.next().tid, 4)

    def test_times_are_exact_or_refused(self):
        self.fill(1)
        for time_ in (1.5, True, "now", None, datetime.datetime.now()):
            with self.subTest(time=time_), self.assertRaises(TypeError):
                self.reader.at(time_)
        for time_ in (1 << 63, np.datetime64("NaT"), np.datetime64("3000-01-01")):
            with self.subTest(time=time_), self.assertRaises(ValueError):
                self.reader.at(time_)
        for age in (-1, float("nan")):
            with self.subTest(age=age), self.assertRaises(ValueError):
                self.reader.at(T0, age)
        with self.assertRaises(TypeError):
            self.reader.at(T0, "1 s")
        with self.assertRaises(TypeError):
            self.reader.tid("x")

    def test_copies_do_not_change(self):
        self.fill(1)
        sample = self.reader.newest()
        for i in range(20):
            self.writer.write((100 + i,))
        self.assertEqual(sample.value.v, 0)
        sample.value.v = 7  # a copy is the program's own
        self.assertEqual(sample.value["v"], 7)

    def test_history(self):
        self.fill(10)
        self.reader.tid(6)
        history = self.reader.history(T0 + 5 * SECOND, T0 + 8 * SECOND)
        self.assertEqual(list(history.tid), [5, 6, 7])
        self.assertEqual(list(history.time_ns), [T0 + i * SECOND for i in (5, 6, 7)])
        self.assertEqual(list(history.value["v"]), [5, 6, 7])
        self.assertEqual(list(history["value"]["v"]), [5, 6, 7])
        self.assertEqual(self.reader.cursor, 6)
        everything = self.reader.history(0, T0 + 100 * SECOND)
        self.assertEqual(list(everything.tid), list(range(3, 10)))
        self.assertEqual(len(self.reader.history(T0 + 8 * SECOND, T0 + 8 * SECOND)), 0)
        self.assertEqual(len(self.reader.history(T0 + 20 * SECOND, T0 + 30 * SECOND)), 0)
        self.assertEqual(len(self.reader.history(0, T0)), 0)

    def test_history_leaves_a_new_reader_new(self):
        self.fill(3)
        self.assertEqual(len(self.reader.history(0, T0 + 9 * SECOND)), 3)
        self.reader.at(T0)  # nor does a read by time after it
        self.assertEqual(self.reader.next().tid, 2)

    def test_history_has_no_shared_memory(self):
        self.fill(3)
        history = self.reader.history(0, T0 + 9 * SECOND)
        for i in range(20):
            self.writer.write((100 + i,))
        self.assertEqual(list(history.value["v"]), [0, 1, 2])

    def test_joint(self):
        self.fill(3)
        with self.session.create("y", "f4", depth=8, cycle=0.1) as other, self.session.reader("y") as second:
            self.assertIsNone(dssm.read_joint(T0, [self.reader, second]))
            other.write(2.5, T0 + SECOND)
            joint = dssm.read_joint(T0 + SECOND, [self.reader, second])
            self.assertEqual((joint[0].value.v, joint[1].value, joint.clock_error_ns), (1, 2.5, 0))
            with self.assertRaises(dssm.TooOld) as caught:
                dssm.read_joint(T0, [self.reader, second])
            self.assertIn("'y:0@pc1'", str(caught.exception))
            with self.assertRaises(dssm.Stale):
                dssm.read_joint(T0 + 3 * SECOND, [self.reader, second], max_age=1.5)

    def test_time_and_error_of_writes(self):
        before = time.time_ns()
        self.assertEqual(self.writer.write((1,)), 0)
        self.assertLessEqual(before, self.reader.newest().time_ns)
        self.assertLessEqual(self.reader.newest().time_ns, time.time_ns())
        self.assertEqual(self.writer.write((1,), clock_error_ns=1000), 1)
        self.assertEqual(self.reader.newest().clock_error_ns, 1000)
        self.writer.write((1,), clock_error_ns=dssm.FOREIGN_CLOCK)
        self.assertEqual(self.reader.newest().clock_error_ns, dssm.FOREIGN_CLOCK)
        with self.assertRaises(TypeError):
            self.writer.write((1,), clock_error_ns=0.001)

    def restart_stream(self):
        """Removes and creates the stream; the writer is the new one's."""
        self.writer.close()
        self.session.remove("x")
        self.writer = self.session.create("x", np.dtype([("v", "i8")]), depth=8, cycle=1)

    def test_reads_continue_after_a_restart(self):
        self.fill(3)
        self.assertEqual(self.reader.next().tid, 2)
        self.restart_stream()
        self.writer.write((50,), T0 + 100 * SECOND)
        await_that(lambda: self.reader.newest().value.v == 50)
        self.assertEqual((self.reader.newest().tid, self.reader.restarts), (0, 1))

    def test_a_read_of_a_tid_raises_restarted(self):
        self.fill(3)
        self.assertEqual(self.reader.tid(2).value.v, 2)
        self.restart_stream()
        self.writer.write((50,), T0 + 100 * SECOND)
        with self.assertRaises(dssm.Restarted):
            await_that(lambda: self.reader.tid(0).value.v == 50)

    # --- in place

    def test_borrow(self):
        self.fill(3)
        with self.reader.borrow() as sample:
            self.assertEqual((sample.tid, sample.value.v, sample.time_ns), (2, 2, T0 + 2 * SECOND))
            self.assertTrue(sample.still_valid())
            self.assertEqual(sample.payload.tobytes(), (2).to_bytes(8, "little"))
        with self.reader.borrow(1) as sample:
            self.assertEqual(sample.value["v"], 1)
        with self.assertRaises(dssm.Closed):
            sample.value
        self.fill(10)
        with self.assertRaises(dssm.TooOld):
            self.reader.borrow(1)

    def test_borrow_is_read_only(self):
        self.fill(1)
        with self.reader.borrow() as sample:
            for change in (lambda: sample.value.__setitem__("v", 1), lambda: setattr(sample.value, "v", 1),
                           lambda: sample.payload.__setitem__(0, 1)):
                with self.assertRaises(ValueError):
                    change()
            with self.assertRaises(ValueError):
                sample.payload.setflags(write=True)
            self.assertEqual(sample.value.v, 0)

    def test_borrow_is_the_ring_itself(self):
        self.fill(1)
        with self.assertRaises(dssm.Overwritten), self.reader.borrow() as sample:
            view = sample.value
            self.assertEqual(view["v"], 0)
            self.fill(9)
            self.assertNotEqual(view["v"], 0)  # the writer's bytes show: nothing was copied

    def test_overwritten_borrow_raises(self):
        self.fill(1)
        with self.assertRaises(dssm.Overwritten) as caught, self.reader.borrow() as sample:
            self.fill(9)
            self.assertFalse(sample.still_valid())
        self.assertIn("sample 0", str(caught.exception))

    def test_overwritten_borrow_replaces_what_it_caused(self):
        self.fill(1)
        with self.assertRaises(dssm.Overwritten) as caught, self.reader.borrow():
            self.fill(9)
            raise ValueError("by torn data")
        self.assertIsInstance(caught.exception.__context__, ValueError)
        self.fill(1)
        with self.assertRaises(KeyboardInterrupt), self.reader.borrow():
            self.fill(9)
            raise KeyboardInterrupt
        with self.assertRaises(KeyError), self.reader.borrow():
            raise KeyError("not overwritten")

    def test_views_outlive_reader_block_and_session(self):
        self.fill(1)
        session = dssm.Session()
        reader = session.reader("x")
        with reader.borrow() as sample:
            kept = sample.payload[2:]
            first = sample.value
        reader.close()
        session.close()
        del sample, reader, session
        gc.collect()
        self.assertEqual((kept.tobytes(), first["v"]), (bytes(6), 0))

    def test_views_of_an_old_ring_block_its_end(self):
        self.fill(1)
        with self.reader.borrow() as sample:
            kept = sample.payload
        for value in (50, 60):
            self.restart_stream()
            self.writer.write((value,), T0 + 100 * SECOND)
            with self.assertRaisesRegex(dssm.InUse, "delete it"):
                await_that(lambda: self.reader.newest().value.v == value)
        self.assertEqual(kept.tobytes(), bytes(8))
        del kept, sample
        await_that(lambda: self.reader.newest().value.v == 60)

    def test_short_samples_in_place(self):
        with self.session.create("short", np.dtype("V64"), depth=8, cycle=0.1) as writer, self.session.reader("short") as reader:
            writer.write(b"abc")
            with reader.borrow() as sample:
                self.assertEqual(sample.value.tobytes(), b"abc")

    # --- threads

    def test_waiting_does_not_hold_the_gil(self):
        """The waiting thread is woken by a write of another thread, which needs the GIL for it."""
        woken = []
        thread = threading.Thread(target=lambda: woken.append(self.reader.wait(PATIENT_S)))
        thread.start()
        started = time.monotonic()
        self.writer.write((1,))
        thread.join()
        self.assertEqual(woken, [True])
        self.assertLess(time.monotonic() - started, PATIENT_S)

    def test_waits_end(self):
        self.assertFalse(self.reader.wait(0))
        self.assertFalse(self.reader.wait(0.01))
        self.assertFalse(self.reader.wait_for_tid(5, 0.01))
        self.assertFalse(dssm.wait_any([self.reader], 0.01))
        self.assertIsNone(self.reader.next(wait=0.01))
        self.fill(3)
        self.assertTrue(self.reader.wait())
        self.assertTrue(self.reader.wait_for_tid(2))
        self.assertTrue(dssm.wait_any([self.reader]))
        self.assertEqual(self.reader.next(wait=True).tid, 2)

    def test_another_thread_is_refused(self):
        """While a thread waits in a reader, calls of other ones raise InUse and change nothing."""
        result = []
        thread = threading.Thread(target=lambda: result.append(self.reader.wait(PATIENT_S)))
        thread.start()

        def refused():
            try:
                self.reader.newest()
                return False
            except dssm.InUse:
                return True

        await_that(refused)
        for call in (self.reader.next, self.reader.close, lambda: self.reader.wait(0), lambda: self.reader.tid(0),
                     lambda: self.reader.history(0, 1), self.reader.borrow, lambda: self.reader.seek(0),
                     lambda: dssm.wait_any([self.reader], 0), lambda: dssm.read_joint(0, [self.reader])):
            with self.assertRaises(dssm.InUse):
                call()
        self.writer.write((1,))
        thread.join()
        self.assertEqual(result, [True])
        self.assertEqual(self.reader.newest().value.v, 1)  # usable again

    def test_iteration(self):
        def write():
            for i in range(5):
                self.reader_is_at.wait(PATIENT_S)
                self.reader_is_at.clear()
                self.writer.write((i,))

        self.reader_is_at = threading.Event()
        self.reader_is_at.set()
        thread = threading.Thread(target=write)
        thread.start()
        values = []
        for sample in self.reader:
            values.append(int(sample.value.v))
            self.reader_is_at.set()
            if len(values) == 5:
                break
        thread.join()
        self.assertEqual(values, [0, 1, 2, 3, 4])

    def test_awaited_stream(self):
        opened = []
        thread = threading.Thread(target=lambda: opened.append(self.session.reader("later", wait=PATIENT_S)))
        thread.start()
        with self.session.create("later", "f8", depth=8, cycle=0.1):
            thread.join()
        self.assertEqual(opened[0].name, "later:0@pc1")
        with self.assertRaises(dssm.NotFound):
            self.session.reader("never", wait=0.05)

    def test_notice_of_a_long_wait(self):
        notices = []
        session = dssm.Session(on_notice=notices.append)
        with self.assertRaises(dssm.NotFound):
            session.reader("never", wait=3)
        self.assertEqual(len(notices), 1)
        self.assertIn("waiting for 'never:0'", notices[0])

    def test_descriptor(self):
        poll = select.poll()
        poll.register(self.reader, select.POLLIN)
        self.reader.clear_ready()
        self.assertEqual(poll.poll(0), [])
        self.writer.write((1,))
        self.assertEqual(len(poll.poll(PATIENT_S * 1000)), 1)
        self.reader.clear_ready()
        self.assertEqual(self.reader.next().value.v, 1)


class OtherHosts(Case):
    """Streams of pc1, read on pc2."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.pc2 = Daemon("pc2", [cls.daemon])
        cls.addClassCleanup(cls.pc2.close)

    def setUp(self):
        super().setUp()
        self.there = dssm.Session(self.pc2.socket_path, request_timeout=PATIENT_S)
        self.addCleanup(self.there.close)

    def create(self, name, samples):
        """A stream of pc1 with that many samples of 64 KiB, a second apart."""
        writer = self.session.create(name, ("u1", (65536,)), depth=1024, cycle=1)
        self.addCleanup(writer.close)
        payload = np.zeros(65536, "u1")
        for i in range(samples):
            payload[0] = i
            writer.write(payload, T0 + i * SECOND)
        return writer

    def reader(self, name, **options):
        reader = self.there.reader(name + "@pc1", wait=PATIENT_S, **options)
        self.addCleanup(reader.close)
        return reader

    def test_the_past_of_another_host_arrives_when_it_is_read(self):
        for name, wait in (("past", PATIENT_S), ("past2", True)):
            with self.subTest(wait=wait):
                self.create(name, 200)
                reader = self.reader(name)
                self.assertEqual(list(reader.history(T0, T0 + 200 * SECOND, wait=wait).tid), list(range(200)))
                self.assertEqual(reader.at(T0 + 3 * SECOND).tid, 3)  # it is here now
                self.assertEqual(reader.cursor, dssm.NO_TID)

    def test_reads_raise_arriving_until_it_is_here(self):
        for name, call in (("tid", lambda r: r.tid(0)), ("at", lambda r: r.at(T0)), ("nearest", lambda r: r.nearest(T0)),
                           ("find", lambda r: r.find(T0)), ("history", lambda r: r.history(T0, T0 + SECOND)),
                           ("joint", lambda r: dssm.read_joint(T0, [r]))):
            with self.subTest(name=name):
                self.create("early_" + name, 100)
                reader = self.reader("early_" + name)
                await_that(lambda: reader.newest())
                with self.assertRaises(dssm.Arriving) as caught:
                    call(reader)
                self.assertIn("on its way", str(caught.exception))

    def test_single_reads_wait(self):
        for name, call in (("at", lambda r: r.at(T0, wait=PATIENT_S)), ("at2", lambda r: r.at(T0, None, True)),
                           ("joint", lambda r: dssm.read_joint(T0, [r], wait=PATIENT_S)[0]),
                           ("tid", lambda r: r.tid(0) if r.wait_for_sample(0, PATIENT_S) else None)):
            with self.subTest(name=name):
                self.create("waited_" + name, 100)
                self.assertEqual(call(self.reader("waited_" + name)).tid, 0)

    def test_waits_for_history_end(self):
        """The history does not arrive while pc1 does not answer."""
        self.create("stopped", 100)
        reader = self.reader("stopped")
        await_that(lambda: reader.newest())
        self.daemon.stop()
        try:
            for call in (lambda: reader.at(T0, wait=0.05), lambda: reader.history(T0, T0 + SECOND, wait=0.05),
                         lambda: dssm.read_joint(T0, [reader], wait=0.05)):
                started = time.monotonic()
                with self.assertRaises(dssm.Arriving):
                    call()
                self.assertGreaterEqual(time.monotonic() - started, 0.05)
            self.assertFalse(reader.wait_for_sample(0, 0.01))
        finally:
            self.daemon.resume()
        self.assertEqual(reader.at(T0, wait=PATIENT_S).tid, 0)

    def test_fetch_history(self):
        """It is here when the reader is."""
        self.create("fetched", 10)
        reader = self.reader("fetched", fetch_history=True)
        # The open waits for it for a second, which may not be enough on a busy PC.
        self.assertEqual(len(reader.history(T0, T0 + 10 * SECOND, wait=PATIENT_S)), 10)
        self.assertEqual(reader.at(T0).value[0], 0)
        self.assertEqual(dssm.read_joint(T0 + SECOND, [reader])[0].tid, 1)


INTERRUPTED = """
import os, sys, time
import dssm
import numpy as np
session = dssm.Session()
reader = session.reader("interrupted")
print("ready", flush=True)
try:
    {call}
except KeyboardInterrupt:
    print("interrupted", reader.newest_tid, flush=True)
"""


class Interrupts(Case):
    def test_ctrl_c_ends_each_wait(self):
        with self.session.create("interrupted", "f8", depth=8, cycle=0.1):
            for call in ("reader.wait()", "reader.wait_for_tid(99)", "next(reader)", "dssm.wait_any([reader])",
                         "reader.next(wait=True)", "session.reader('never', wait=True)",
                         "session.playback_clock().sleep_until(time.time() + 1e6)"):
                with self.subTest(call=call):
                    process = python(INTERRUPTED.format(call=call))
                    self.assertEqual(process.stdout.readline(), "ready\n")
                    time.sleep(0.05)  # at any moment, before the wait or in it
                    process.send_signal(signal.SIGINT)
                    out, err = process.communicate(timeout=PATIENT_S)
                    if "KeyboardInterrupt" in err:  # it came between the line and the call
                        continue
                    self.assertEqual(out, f"interrupted {dssm.NO_TID}\n", err)

    def test_a_handler_that_returns_does_not_end_a_wait(self):
        program = """
import signal, dssm
handled = []
signal.signal(signal.SIGUSR1, lambda *_: (handled.append(1), print("handled", flush=True)))
reader = dssm.Session().reader("handled")
print("ready", flush=True)
print(reader.wait(), len(handled))
"""
        with self.session.create("handled", "f8", depth=8, cycle=0.1) as writer:
            process = python(program)
            self.assertEqual(process.stdout.readline(), "ready\n")
            process.send_signal(signal.SIGUSR1)
            self.assertEqual(process.stdout.readline(), "handled\n")
            writer.write(1.0)
            self.assertEqual(process.communicate(timeout=PATIENT_S)[0], "True 1\n")

    def test_processes_end_with_everything_open(self):
        program = """
import threading, dssm
session = dssm.Session()
writer = session.create("left", "f8", depth=8, cycle=0.1)
reader = session.reader("left")
reader.fileno()
writer.write(1.0)
kept = reader.borrow()
view = kept.payload
threading.Thread(target=reader.wait_for_tid, args=(99,), daemon=True).start()
print("end")
"""
        process = python(program)
        out, err = process.communicate(timeout=PATIENT_S)
        self.assertEqual((out, err, process.returncode), ("end\n", "", 0))


class Asyncio(Case):
    def setUp(self):
        super().setUp()
        self.writer = self.session.create("async", "i8", depth=1024, cycle=0.1)
        self.addCleanup(self.writer.close)
        self.reader = self.session.reader("async")
        self.addCleanup(self.reader.close)
        self.reader.seek(self.reader.newest_tid)

    def test_async_for(self):
        async def read():
            values = []
            async for sample in self.reader:
                values.append(int(sample.value))
                if len(values) == 50:
                    return values

        async def write():
            for i in range(50):
                self.writer.write(i)
                await asyncio.sleep(0 if i % 10 else 0.001)

        async def both():
            return (await asyncio.gather(read(), write()))[0]

        self.assertEqual(asyncio.run(asyncio.wait_for(both(), PATIENT_S)), list(range(50)))

    def test_wait_async(self):
        async def run():
            self.assertFalse(await self.reader.wait_async(0.01))
            waiting = asyncio.create_task(self.reader.wait_async())
            await asyncio.sleep(0)
            self.writer.write(3)
            self.assertTrue(await waiting)
            self.assertTrue(await self.reader.wait_async(0))  # still not read
            self.assertEqual(self.reader.next().value, 3)

        asyncio.run(asyncio.wait_for(run(), PATIENT_S))

    def test_closing_ends_waiting(self):
        async def iterate():
            async for _ in self.reader:
                self.fail("there is no sample")

        async def run(wait, close):
            waiting = asyncio.create_task(wait())
            await asyncio.sleep(0)
            await close()
            with self.assertRaises(dssm.Closed):
                await waiting

        async def close():
            self.reader.close()

        for wait in iterate, lambda: self.reader.wait_async():
            for end in close, lambda: asyncio.to_thread(self.reader.close):
                self.reader = self.session.reader("async")
                self.reader.seek(self.reader.newest_tid)
                asyncio.run(asyncio.wait_for(run(wait, end), PATIENT_S))

    def test_closing_by_a_thread_that_is_slow_ends_waiting(self):
        closes = dssm._asyncio._close

        def slow_close(reader):
            time.sleep(0.2)  # the loop does what the thread has left it before
            closes(reader)

        async def run():
            waiting = asyncio.create_task(self.reader.wait_async())
            await asyncio.sleep(0)
            await asyncio.to_thread(self.reader.close)
            with self.assertRaises(dssm.Closed):
                await waiting

        with unittest.mock.patch.object(dssm._asyncio, "_close", slow_close):
            asyncio.run(asyncio.wait_for(run(), PATIENT_S))

    def test_several_readers_in_one_loop(self):
        async def first(reader):
            async for sample in reader:
                return int(sample.value)

        async def run():
            others = [self.session.reader("async") for _ in range(3)]
            for reader in others:
                reader.seek(reader.newest_tid)
            tasks = [asyncio.create_task(first(reader)) for reader in others]
            await asyncio.sleep(0)
            self.writer.write(9)
            return await asyncio.gather(*tasks)

        self.assertEqual(asyncio.run(asyncio.wait_for(run(), PATIENT_S)), [9, 9, 9])

    def test_two_tasks_on_one_reader_are_refused(self):
        async def run():
            waiting = asyncio.create_task(self.reader.wait_async())
            await asyncio.sleep(0)
            with self.assertRaises(dssm.InUse):
                await self.reader.wait_async(0)
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)
            self.assertFalse(await self.reader.wait_async(0))

        asyncio.run(asyncio.wait_for(run(), PATIENT_S))


class WithOtherPrograms(Case):
    def test_dssmctl_shows_the_fields(self):
        with self.session.create("shown", Odometry, depth=8, cycle=0.1) as writer:
            echo = subprocess.Popen([BUILD / "client/dssmctl/dssmctl", "echo", "shown", "--count", "1"],
                                    stdout=subprocess.PIPE, text=True)

            def ended():
                writer.write(odometry(1.25))
                return echo.poll() is not None

            await_that(ended)
            shown = echo.communicate()[0]
            self.assertIn("1.25", shown)
            self.assertIn("pose", shown)

    def test_streams_survive_dssmd(self):
        with self.session.create("kept", "f8", depth=8, cycle=0.1) as writer, self.session.reader("kept") as reader:
            self.daemon.kill()
            writer.write(1.0)
            self.assertEqual(reader.newest().value, 1.0)
            self.daemon.start()
            await_that(lambda: self.session.is_connected)
            writer.write(2.0)
            self.assertEqual(reader.newest().value, 2.0)
