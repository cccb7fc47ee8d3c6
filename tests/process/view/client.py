#!/usr/bin/python3
# SPDX-License-Identifier: Apache-2.0
#
# A client of dssm-view, by python3-websockets.
#
#   client.py ask URL    Sends each line of standard input, a JSON object, as a request of the page's
#                        protocol (with an id of its own, if it has none), and prints its answer as a
#                        line. Data are at their keys: "times", "values", "tids" of curves, "payload"
#                        of samples as hex. What is being opened or is on its way is asked for again.
#   client.py send URL   Sends the lines as they are, and prints what comes until the server closes:
#                        then code and reason.
#   client.py hold URL   Subscribes to the first channel of Foxglove's protocol and prints "ready";
#                        then how many samples come before the first status message, and that.
#   client.py follow URL Subscribes to the first channel of Foxglove's protocol. Prints the last byte of
#                        each sample as it comes, and each status message.
#   client.py play URL   Subscribes to all channels of a recording. Sends each line of standard input,
#                        "play|pause SPEED SEEK_NS", as a command of Foxglove's playback control, and
#                        prints its answer: "state STATUS TIME [seek COMMAND]". After "pause" waits
#                        for a sample of each channel, and prints them: "TOPIC TIME". After "play"
#                        waits for the end, and prints how many came of each that were not before
#                        SEEK_NS, and whether in the order of times.
#   client.py loop URL   Subscribes to all channels of a playback and plays it, over and over. Prints
#                        "playing" when the first sample is there.
import asyncio
import json
import struct
import sys

import websockets

PAGE = "dssm.view.v1"
FOXGLOVE = "foxglove.sdk.v1"
MESSAGE_DATA = 1
TIME = 2
PLAYBACK_CONTROL = 3
PLAYBACK_STATE = 5


def decoded(answer):
    """An answer of the page's protocol with its data in place."""
    if isinstance(answer, str):
        return json.loads(answer)
    number, head_bytes = struct.unpack_from("<II", answer)
    head = json.loads(answer[8 : 8 + head_bytes])
    head["id"] = number
    data = answer[8 + head_bytes :]
    assert (8 + head_bytes) % 8 == 0
    for curve in head.get("curves", []):
        for key in ["times", "values", "tids"]:
            at = curve.pop(key + "_at")
            assert at % 8 == 0
            numbers = struct.unpack_from(f"<{curve['points']}d", data, at)
            curve[key] = [None if number != number else number for number in numbers]
    for sample in head.get("samples", []) if isinstance(head.get("samples"), list) else []:
        if "payload_at" in sample:
            at = sample.pop("payload_at")
            sample["payload"] = data[at : at + sample["payload_bytes"]].hex()
    if "property_at" in head:
        at = head.pop("property_at")
        head["property"] = data[at : at + head["property_bytes"]].hex()
    return head


def is_underway(answer):
    statuses = [answer.get("status")]
    if isinstance(answer.get("samples"), list):
        statuses += [sample["status"] for sample in answer["samples"]]
    return any(status in ("opening", "arriving", "restarted") for status in statuses)


async def ask(url):
    async with websockets.connect(url, subprotocols=[PAGE], max_size=None) as server:
        for number, line in enumerate(sys.stdin):
            request = {"id": number, **json.loads(line)}
            while True:
                await server.send(json.dumps(request))
                answer = decoded(await server.recv())
                if not is_underway(answer):
                    break
                await asyncio.sleep(0.02)
            print(json.dumps(answer))


async def send(url):
    async with websockets.connect(url, subprotocols=[PAGE], max_size=None) as server:
        try:
            for line in sys.stdin:
                await server.send(line.rstrip("\n"))
            while True:
                print(json.dumps(decoded(await server.recv())))
        except websockets.ConnectionClosed as closed:
            print(closed.code, closed.reason)


async def subscribe_to_first(server):
    channel = None
    while channel is None:
        message = json.loads(await server.recv())
        if message["op"] == "advertise":
            channel = message["channels"][0]["id"]
    subscription = {"id": 0, "channelId": channel}
    await server.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))


async def follow(url):
    async with websockets.connect(url, subprotocols=[FOXGLOVE]) as server:
        await subscribe_to_first(server)
        while True:
            message = await server.recv()
            if isinstance(message, str):
                message = json.loads(message)
                if message["op"] == "status":
                    print(message["message"], flush=True)
            elif message[0] == MESSAGE_DATA:
                print(message[-1], flush=True)


async def hold(url):
    async with websockets.connect(
        url, subprotocols=[FOXGLOVE], max_size=None, max_queue=1, ping_interval=None
    ) as server:
        await subscribe_to_first(server)
        print("ready", flush=True)
        samples = 0
        while True:
            message = await server.recv()
            if isinstance(message, bytes):
                samples += message[0] == MESSAGE_DATA
                continue
            message = json.loads(message)
            if message["op"] == "status":
                print(samples, message["message"], flush=True)
                return


async def play(url):
    async with websockets.connect(url, subprotocols=[FOXGLOVE], max_size=None) as server:
        topics = {}
        async def receive():
            message = await server.recv()
            return message if isinstance(message, bytes) else json.loads(message)
        info = await receive()
        assert "playbackControl" in info["capabilities"]
        begin, end = ("{sec}.{nsec:09}".format(**info[key]) for key in ["dataStartTime", "dataEndTime"])
        print("from", begin, "to", end)
        begin_ns, end_ns = (int(time.replace(".", "")) for time in (begin, end))
        channels = (await receive())["channels"]
        for channel in channels:
            topics[channel["id"]] = channel["topic"]
        subscriptions = [{"id": number, "channelId": number} for number in topics]
        await server.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        for number, line in enumerate(sys.stdin):
            command, speed, seek_ns = line.split()
            request_id = str(number).encode()
            await server.send(struct.pack("<BBfBQI", PLAYBACK_CONTROL, command == "pause",
                                          float(speed), 1, int(seek_ns), len(request_id)) + request_id)
            answered = False
            samples = {topic: [] for topic in topics.values()}
            while True:
                message = await receive()
                if not isinstance(message, bytes):
                    continue
                if message[0] == PLAYBACK_STATE:
                    status, time, speed, did_seek, id_bytes = struct.unpack_from("<BQfBI", message, 1)
                    answer = message[1 + 18 :].decode()
                    assert len(answer) == id_bytes
                    name = ["playing", "paused", "buffering", "ended"][status]
                    print("state", name, time, *(["seek", answer] if did_seek else []))
                    answered = answered or answer == str(number)
                    if name == "ended":
                        break
                elif message[0] == TIME:
                    assert begin_ns <= struct.unpack_from("<Q", message, 1)[0] <= end_ns
                elif message[0] == MESSAGE_DATA and answered:
                    channel, time = struct.unpack_from("<IQ", message, 1)
                    samples[topics[channel]].append(time)
                if command == "pause" and answered and all(samples.values()):
                    break
            for topic, times in sorted(samples.items()):
                if command == "pause":
                    print(topic, times[0])
                    continue
                # Before that only what the stream had then.
                assert sum(time < int(seek_ns) for time in times) <= 1
                times = [time for time in times if time >= int(seek_ns)]
                print("played", topic, len(set(times)), "in order" if times == sorted(times) else "wild")


async def loop(url):
    async with websockets.connect(url, subprotocols=[FOXGLOVE], max_size=None) as server:
        command = struct.pack("<BBfBQI", PLAYBACK_CONTROL, 0, 10.0, 1, 0, 0)
        is_playing = False
        while True:
            message = await server.recv()
            if isinstance(message, bytes):
                if message[0] == MESSAGE_DATA and not is_playing:
                    is_playing = True
                    print("playing", flush=True)
                if message[0] == PLAYBACK_STATE and message[1] == 3:
                    await server.send(command)
                continue
            message = json.loads(message)
            if message["op"] == "advertise":
                subscriptions = [{"id": one["id"], "channelId": one["id"]} for one in message["channels"]]
                await server.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
                await server.send(command)


if __name__ == "__main__":
    asyncio.run({"ask": ask, "send": send, "hold": hold, "follow": follow, "play": play,
                 "loop": loop}[sys.argv[1]](sys.argv[2]))
