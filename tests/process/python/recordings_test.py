# SPDX-License-Identifier: Apache-2.0
"""Recordings: written and read by the Python package, and by dssmctl."""

import pathlib
import subprocess
import tempfile

import dssm
import numpy as np
from support import BUILD, PATIENT_S, Case

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
POINT = np.dtype([("x", "f8"), ("n", "i4")], align=True)


class Recordings(Case):
    def setUp(self):
        super().setUp()
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.file = pathlib.Path(folder.name) / "drive.mcap"

    def write(self, count=10):
        with dssm.RecordingWriter(self.file) as recording:
            points = recording.add_stream("points@pc1", POINT, depth=16, cycle=1, incarnation=1, property=b"p")
            level = recording.add_stream("level@pc1", "f4", depth=16, cycle=1, incarnation=2)
            for i in range(count):
                points.write((i / 2, i), T0 + i * SECOND)
                level.write(i, T0 + i * SECOND + SECOND // 2)
        return dssm.Recording(self.file)

    def test_what_was_written_is_read(self):
        recording = self.write()
        streams = {stream.name: stream for stream in recording.streams}
        self.assertEqual(set(streams), {"points:0@pc1", "level:0@pc1"})
        points = streams["points:0@pc1"]
        self.assertEqual((points.samples, points.first_tid, points.last_tid), (10, 0, 9))
        self.assertEqual((points.first_time_ns, points.last_time_ns), (T0, T0 + 9 * SECOND))
        self.assertEqual((points.depth, points.cycle, points.incarnation), (16, 1.0, 1))
        self.assertEqual(recording.property(0), b"p")
        self.assertEqual([pathlib.Path(file) for file in recording.files], [self.file])
        self.assertEqual((recording.triggers, recording.warnings), ([], []))

    def test_the_calls_of_a_live_reader(self):
        reader = self.write().reader("points")
        self.assertEqual([int(sample.value.n) for sample in reader], list(range(10)))
        self.assertIsNone(reader.next())
        self.assertEqual(reader.previous().tid, 8)
        self.assertEqual(reader.at(T0 + 3 * SECOND + 1).value.x, 1.5)
        self.assertEqual(reader.cursor, 8)
        self.assertEqual(reader.at_or_after(T0 + 3 * SECOND + 1).tid, 4)
        self.assertEqual(reader.nearest(T0 + 3 * SECOND + 1).tid, 3)
        before, after = reader.neighbours(T0 + 3 * SECOND + 1)
        self.assertEqual((before.tid, after.tid), (3, 4))
        self.assertEqual((reader.tid(5).value.n, reader.info(5).time_ns), (5, T0 + 5 * SECOND))
        self.assertEqual(reader.newest().tid, 9)
        self.assertEqual(reader.property(), b"p")
        with self.assertRaises(dssm.TooOld):
            reader.at(T0 - 1)
        with self.assertRaises(dssm.Stale):
            reader.at(T0 + 20 * SECOND, max_age=1)
        reader.close()
        with self.assertRaises(dssm.Closed):
            reader.newest()

    def test_history(self):
        reader = self.write().reader("points")
        history = reader.history(T0 + 2 * SECOND, T0 + 5 * SECOND)
        self.assertEqual((list(history.tid), list(history.value["n"])), ([2, 3, 4], [2, 3, 4]))
        self.assertEqual(len(reader.history(T0 + 20 * SECOND, T0 + 21 * SECOND)), 0)
        self.assertEqual(len(reader.history(0, T0 + 100 * SECOND)), 10)
        self.assertEqual(reader.next().tid, 0)  # a reader of its own read them

    def test_joint(self):
        recording = self.write()
        readers = [recording.reader("points"), recording.reader("level")]
        joint = dssm.read_joint(T0 + 3 * SECOND, readers)
        self.assertEqual((joint[0].value.n, joint[1].value), (3, 2.0))

    def test_all_samples_in_order(self):
        recording = self.write(3)
        order = [(recording.streams[stream].name, sample.tid) for stream, sample in recording]
        self.assertEqual(order, [("points:0@pc1", 0), ("level:0@pc1", 0), ("points:0@pc1", 1), ("level:0@pc1", 1),
                                 ("points:0@pc1", 2), ("level:0@pc1", 2)])
        cursor = recording.cursor()
        self.assertIsNone(cursor.previous())
        cursor.seek(T0 + SECOND)
        self.assertEqual(cursor.next()[1].value.n, 1)
        cursor.seek(T0 + 100 * SECOND)
        self.assertIsNone(cursor.next())

    def test_a_live_stream_is_recorded_as_it_is(self):
        with self.session.create("live", POINT, depth=8, cycle=0.1) as writer, self.session.reader("live") as reader:
            with dssm.RecordingWriter(self.file, compression="zstd") as recording:
                output = recording.add_stream(reader.name, reader.type, depth=reader.depth, cycle=reader.cycle)
                for i in range(3):
                    writer.write((0.5, i), T0 + i, clock_error_ns=7)
                    output.write(reader.next())
                output.add_gap(3, 2)
                output.write((0, 9), T0 + 9, tid=5)
        recording = dssm.Recording(self.file)
        self.assertEqual((recording.streams[0].samples, recording.streams[0].lost_samples), (4, 2))
        samples = list(recording.reader("live"))
        self.assertEqual([(s.tid, s.time_ns, int(s.value.n)) for s in samples],
                         [(0, T0, 0), (1, T0 + 1, 1), (2, T0 + 2, 2), (5, T0 + 9, 9)])
        self.assertEqual(samples[0].clock_error_ns, 7)
        self.assertEqual(list(recording.reader("live").history(T0, T0 + 10).payload_bytes), [samples[0].payload_bytes] * 4)

    def test_restarts_are_followed(self):
        with dssm.RecordingWriter(self.file) as recording:
            for incarnation in (1, 2):
                output = recording.add_stream("again@pc1", "i8", depth=8, cycle=1, incarnation=incarnation)
                for i in range(3):
                    output.write(10 * incarnation + i, T0 + (10 * incarnation + i) * SECOND)
        reader = dssm.Recording(self.file).reader("again")
        self.assertEqual([int(sample.value) for sample in reader], [10, 11, 12, 20, 21, 22])
        self.assertEqual(reader.restarts, 1)
        self.assertEqual(reader.at(T0 + 11 * SECOND).value, 11)
        self.assertEqual(list(reader.history(T0 + 12 * SECOND, T0 + 21 * SECOND).value), [12, 20])

    def test_errors(self):
        with self.assertRaises(dssm.NotFound):
            dssm.Recording(self.file)
        self.file.write_bytes(b"this is not a recording")
        with self.assertRaises(dssm.ProtocolError):
            dssm.Recording(self.file)
        with self.assertRaises(dssm.Conflict):
            dssm.RecordingWriter(self.file)
        self.file.unlink()
        recording = self.write()
        with self.assertRaises(dssm.TypeMismatch) as caught:
            recording.reader("points", np.dtype([("x", "f8"), ("n", "u4")], align=True))
        self.assertIn("int32 n at 8", str(caught.exception))
        self.assertIn("uint32 n at 8", str(caught.exception))
        with self.assertRaises(ValueError):
            dssm.RecordingWriter(self.file, compression="gzip")

    def test_a_finished_recording_is_closed(self):
        recording = dssm.RecordingWriter(self.file)
        output = recording.add_stream("x@pc1", "f8")
        recording.finish()
        with self.assertRaises(dssm.Closed):
            output.write(1.0)

    def test_dssmctl_reads_it(self):
        self.write()
        shown = subprocess.run([BUILD / "client/dssmctl/dssmctl", "info", self.file], capture_output=True, text=True,
                               timeout=PATIENT_S)
        self.assertIn("points", shown.stdout, shown.stderr)
