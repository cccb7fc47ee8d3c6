#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
"""Speaks to a running dssmd over TCP with nothing but protobuf's own library.

usage: stock_protobuf.py HOST:PORT FOLDER_WITH_PROTO_FILES

Proof that docs/wire.md and proto/network.proto say all there is to know: no code of DSSM is used,
and what comes back is checked field by field. Ends with status 0 when all is as it should be, with
77 when protobuf's Python library is not there.
"""

import itertools
import os
import socket
import subprocess
import sys
import tempfile

try:
    import google.protobuf  # noqa: F401  (Debian: python3-protobuf)
except ImportError:
    sys.exit(77)

UNKNOWN_CLOCK_ERROR = 2**63 - 1
NOT_YET, TOO_OLD = 1, 2
START = 1_700_000_000_000_000_000  # ns, time of sample 0
CYCLE = 25_000_000  # ns
with open("/proc/sys/kernel/random/boot_id", "rb") as boot_id_file:
    BOOT_ID = boot_id_file.read().strip()


def compile_messages(proto_folder):
    """The Python classes of proto/*.proto, made by protoc."""
    with tempfile.TemporaryDirectory() as folder:
        files = [os.path.join(proto_folder, name) for name in ("common.proto", "catalog.proto", "network.proto")]
        command = ["protoc", "--proto_path=" + proto_folder, "--python_out=" + folder]
        subprocess.run(command + files, check=True)
        sys.path.insert(0, folder)
        import common_pb2
        import network_pb2
    return network_pb2, common_pb2.Hello


def check(what, got, expected):
    if got != expected:
        sys.exit(f"{what}: got {got!r}, expected {expected!r}")


def varint(number):
    encoded = b""
    while number >= 0x80:
        encoded += bytes([number & 0x7F | 0x80])
        number >>= 7
    return encoded + bytes([number])


class Connection:
    """One TCP connection to a dssmd; greets."""

    def __init__(self, address, features=("torn",), version=1):
        host, port = address.rsplit(":", 1)
        self.socket = socket.create_connection((host, int(port)))
        self.file = self.socket.makefile("rb")
        self.serials = itertools.count(1)
        self.hello = Hello(
            protocol_version=version,
            host="pc9",
            host_id=b"0123456789abcdef",
            instance_id=4711,
            program="stock_protobuf.py",
            version="0",
            features=features,
            clock={"boot_id": BOOT_ID},  # this program and dssmd have one clock
        )
        self.send(net.Frame(hello=self.hello))
        self.answer = self.receive()

    def send_bytes(self, message):
        self.socket.sendall(varint(len(message)) + message)

    def send(self, frame):
        self.send_bytes(frame.SerializeToString())

    def receive(self):
        """The next frame; None at the end of the connection."""
        length = shift = 0
        while True:
            byte = self.file.read(1)
            if not byte:
                return None
            length |= (byte[0] & 0x7F) << shift
            shift += 7
            if byte[0] < 0x80:
                break
        return net.Frame.FromString(self.file.read(length))

    def request(self, **body):
        """Sends a request, returns its answer. Only for connections without events."""
        serial = next(self.serials)
        self.send(net.Frame(serial=serial, **body))
        while True:
            answer = self.receive()
            check("the serial of an answer to " + str(body), answer.serial, serial)
            if not answer.torn:  # a void sample is no answer: another one follows
                return answer

    def close(self):
        self.file.close()
        self.socket.close()


class Stream:
    """What this program puts into a stream, so that it knows what has to come out."""

    def __init__(self, name, payload_bytes):
        self.id = dict(name=name, id=1)
        self.payload_bytes = payload_bytes

    def payload(self, tid):
        return (b"%016d" % tid * (self.payload_bytes // 16 + 1))[: self.payload_bytes]

    def frame(self, tid, serial=0):
        stamps = net.Sample(tid=tid, time_ns=START + tid * CYCLE, clock_error_ns=self.error(tid))
        return net.Frame(serial=serial, sample=stamps, payload=self.payload(tid))

    @staticmethod
    def error(tid):
        return UNKNOWN_CLOCK_ERROR if tid % 7 == 3 else 1000 * tid

    def check_sample(self, what, frame, tid, serial=0):
        check(what + ": serial", frame.serial, serial)
        check(what + ": has stamps", frame.HasField("sample"), True)
        check(what + ": tid", frame.sample.tid, tid)
        check(what + ": time", frame.sample.time_ns, START + tid * CYCLE)
        check(what + ": clock error", frame.sample.clock_error_ns, self.error(tid))
        check(what + ": payload", frame.payload, self.payload(tid))
        check(what + ": torn", frame.torn, False)
        check(what + ": other message", frame.WhichOneof("body"), None)


def check_failure(frame, code, words):
    check("a failure", frame.WhichOneof("body"), "failure")
    check("code of a failure", frame.failure.code, code)
    check(f"'{words}' in '{frame.failure.message}'", words in frame.failure.message, True)


def test_greeting(address):
    connection = Connection(address)
    hello = connection.answer.hello
    check("protocol version", hello.protocol_version, 1)
    check("host", hello.host, "pc1")
    check("bytes of the host id", len(hello.host_id), 16)
    check("an instance id is sent", hello.instance_id != 0, True)
    check("program", hello.program, "dssmd")
    check("version is said", hello.version != "", True)
    check("features", "torn" in hello.features, True)
    connection.close()

    refused = Connection(address, version=99)
    check("serial of last words", refused.answer.serial, 0)
    check_failure(refused.answer, "protocol", "version 99")
    check("what follows last words", refused.receive(), None)
    refused.close()


def test_stream(address, stream, features, depth):
    """Creates, publishes, subscribes, reads, and removes one stream."""
    type_ = dict(name="Test", payload_bytes=stream.payload_bytes, alignment_bytes=8)
    writer = Connection(address, features)
    create = dict(id=stream.id, type=type_, depth=depth, cycle_ns=CYCLE)
    opened = writer.request(create=create).opened
    check("created", opened.created, True)
    check("name", opened.stream.id.name, stream.id["name"])
    check("id", opened.stream.id.id, 1)
    check("host", opened.stream.id.host, "pc1")
    check("type's name", opened.stream.type.name, "Test")
    check("payload size", opened.stream.type.payload_bytes, stream.payload_bytes)
    check("alignment", opened.stream.type.alignment_bytes, 8)
    check("depth", opened.stream.depth, depth)
    check("cycle", opened.stream.cycle_ns, CYCLE)
    check("incarnation is said", opened.stream.incarnation != 0, True)
    check("oldest", opened.stream.oldest, -1)
    check("newest", opened.stream.newest, -1)
    incarnation = opened.stream.incarnation

    # A reader that opens the stream, and sees that there is nothing yet.
    reader = Connection(address, features)
    opened = reader.request(open=dict(id=stream.id)).opened
    check("opened: created", opened.created, False)
    check("opened: incarnation", opened.stream.incarnation, incarnation)
    check("read of nothing", reader.request(read=dict(newest=True)).no_sample.status, NOT_YET)
    range_ = reader.request(get_range=dict()).range
    check("range of nothing", (range_.oldest, range_.newest, range_.at_tid), (-1, -1, -1))

    test_publishing(address, stream, writer, incarnation)
    written = 21

    subscriber = Connection(address, features)
    subscriber.request(open=dict(id=stream.id))
    test_subscription(stream, subscriber, writer, incarnation, written)
    written += 1
    test_reads(stream, reader, written)
    test_property(reader, subscriber)
    test_catalog(address, stream, subscriber, incarnation, written, features)
    for connection in (writer, reader, subscriber):
        connection.close()


def test_publishing(address, stream, writer, incarnation):
    """Publishes samples 0 to 20, through a broken connection."""
    publishing = writer.request(start_publishing=dict(publisher=12345)).publishing
    check("publishing: last", publishing.last, -1)
    check("publishing: last tid", publishing.last_tid, -1)
    check("publishing: incarnation", publishing.incarnation, incarnation)
    for tid in range(19):
        writer.send(stream.frame(tid))
    writer.send(stream.frame(19, serial=77))
    published = writer.receive()
    while published.serial == 0:  # acknowledgements on the way
        check("acknowledgement", published.published.last < 20, True)
        published = writer.receive()
    check("published: serial", published.serial, 77)
    check("published: last", published.published.last, 19)
    check("published: last tid", published.published.last_tid, 19)

    # Another connection of the same publisher hears where it stopped; what it repeats is dropped.
    again = Connection(address)
    again.request(open=dict(id=stream.id))
    publishing = again.request(start_publishing=dict(publisher=12345)).publishing
    check("published before: last", publishing.last, 19)
    check("published before: last tid", publishing.last_tid, 19)
    again.send(stream.frame(18))
    # Fields in an order that no protobuf library writes, and one that nobody knows (number 100).
    frame = stream.frame(20, serial=78)
    again.send_bytes(
        net.Frame(payload=frame.payload).SerializeToString()
        + b"\xa0\x06\x01"
        + net.Frame(sample=frame.sample).SerializeToString()
        + net.Frame(serial=frame.serial).SerializeToString()
    )
    published = again.receive()
    while published.serial == 0:
        published = again.receive()
    check("repeated: last", published.published.last, 20)
    check("repeated: last tid", published.published.last_tid, 20)
    again.close()


def test_subscription(stream, subscriber, writer, incarnation, written):
    subscribed = subscriber.request(subscribe=dict(from_oldest=True)).subscribed
    check("subscribed: incarnation", subscribed.incarnation, incarnation)
    check("subscribed: first tid", subscribed.first_tid, 0)
    check("subscribed: newest", subscribed.newest, written - 1)
    for tid in range(written):
        stream.check_sample(f"history {tid}", subscriber.receive(), tid)
    check("caught up", subscriber.receive().WhichOneof("body"), "caught_up")

    # From a tid of this ring, and from a time.
    subscribed = subscriber.request(
        subscribe=dict(from_tid=written - 2, incarnation=incarnation)
    ).subscribed
    check("from tid: first tid", subscribed.first_tid, written - 2)
    for tid in (written - 2, written - 1):
        stream.check_sample("from tid", subscriber.receive(), tid)
    check("from tid: caught up", subscriber.receive().WhichOneof("body"), "caught_up")
    time = START + (written - 1) * CYCLE + 1
    subscriber.request(subscribe=dict(from_time_ns=time))
    stream.check_sample("from time", subscriber.receive(), written - 1)
    check("from time: caught up", subscriber.receive().WhichOneof("body"), "caught_up")

    # What is written from now on.
    subscribed = subscriber.request(subscribe=dict(from_now=True)).subscribed
    check("from now: first tid", subscribed.first_tid, written)
    check("from now: caught up", subscriber.receive().WhichOneof("body"), "caught_up")
    writer.send(stream.frame(written, serial=79))
    stream.check_sample("news", subscriber.receive(), written)


def test_reads(stream, reader, written):
    newest = written - 1
    for tid in (0, 1, 3, newest):
        answer = reader.request(read=dict(tid=tid))
        stream.check_sample(f"read {tid}", answer, tid, answer.serial)
        for delta in (0, 1, CYCLE - 1):
            answer = reader.request(read=dict(time_ns=START + tid * CYCLE + delta))
            stream.check_sample(f"read {tid} by time", answer, tid, answer.serial)
    answer = reader.request(read=dict(newest=True))
    stream.check_sample("read newest", answer, newest, answer.serial)
    answer = reader.request(read=dict(newer_than=newest - 1))
    stream.check_sample("read newer", answer, newest, answer.serial)
    for what, which, status in (
        ("a tid that is not written", dict(tid=written), NOT_YET),
        ("nothing newer", dict(newer_than=newest), NOT_YET),
        ("a time before all", dict(time_ns=START - 1), TOO_OLD),
    ):
        check(what, reader.request(read=which).no_sample.status, status)
    range_ = reader.request(get_range=dict(time_ns=START + CYCLE + 5)).range
    check("range", (range_.oldest, range_.newest, range_.at_tid), (0, newest, 1))
    range_ = reader.request(get_range=dict()).range
    check("range without a time", (range_.oldest, range_.newest, range_.at_tid), (0, newest, -1))
    check_failure(reader.request(), "protocol", "")  # as one looks that is not known yet


def test_property(reader, other):
    check("done", reader.request(set_property=dict(property=b"mounted")).HasField("done"), True)
    answer = other.request(get_property=dict())
    check("property", answer.property.property, b"mounted")


def test_catalog(address, stream, subscriber, incarnation, written, features):
    control = Connection(address, features)
    pong = control.request(ping=dict(clock=dict(bound_ns=UNKNOWN_CLOCK_ERROR)))
    check("pong", pong.WhichOneof("body"), "pong")
    streams = control.request(list=dict()).stream_list.streams
    check("list", [s.id.name for s in streams], [stream.id["name"]])
    streams = control.request(info=dict(id=stream.id)).stream_list.streams
    check("info: name", streams[0].id.name, stream.id["name"])
    check("info: newest", streams[0].newest, written - 1)
    check("info: newest time", streams[0].newest_time_ns, START + (written - 1) * CYCLE)
    check("info: property", streams[0].property_bytes, len(b"mounted"))
    check("info: channels", streams[0].channels, 3)
    property_ = control.request(get_property=dict(id=stream.id)).property
    check("property by name", property_.property, b"mounted")
    answer = control.request(get_property=dict(id=dict(name="nobody")))
    check_failure(answer, "not_found", "nobody")

    control.send(net.Frame(serial=500, watch=dict()))
    event = control.receive()
    check("watch: first what is there", event.stream_event.stream.id.name, stream.id["name"])
    check("watch: added", event.stream_event.removed, False)
    check("watch: serial of an event", event.serial, 0)
    done = control.receive()
    check("watch: done", (done.serial, done.HasField("done")), (500, True))
    control.send(net.Frame(serial=501, remove=dict(id=stream.id)))
    frames = [control.receive(), control.receive()]
    frames.sort(key=lambda frame: frame.serial)
    check("removed", frames[0].stream_event.removed, True)
    check("removed: name", frames[0].stream_event.stream.id.name, stream.id["name"])
    check("removed: incarnation", frames[0].stream_event.stream.incarnation, incarnation)
    check("remove: done", (frames[1].serial, frames[1].HasField("done")), (501, True))
    ended = subscriber.receive()
    check("the subscription ended", ended.WhichOneof("body"), "ended")
    check("it was removed", ended.ended.removed, True)
    control.close()


def main():
    address = sys.argv[1]
    test_greeting(address)
    for features in (("torn",), ("torn", "of the future"), ()):
        test_stream(address, Stream("small", 24), features, depth=100)
        test_stream(address, Stream("large", 100_000), features, depth=100)
    print("all as it should be")


net, Hello = compile_messages(sys.argv[2])
main()
