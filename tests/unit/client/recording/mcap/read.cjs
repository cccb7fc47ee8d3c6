// SPDX-License-Identifier: Apache-2.0
//
// Reads recordings with the MCAP readers of Foxglove: as a stream with CRC checks, by the index,
// and cut off at many bytes. Prints each message: topic, sequence, log time, and its fields as their
// decoder finds them. The first thing that is wrong ends it with a failure.
//
//   node read.cjs FILE...
const fs = require("fs");
const { McapStreamReader, McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");

function check(condition, what) {
  if (!condition) throw new Error(what);
}

function trigger(record) {
  return `trigger ${JSON.stringify(Object.fromEntries([...record.metadata].sort()))}`;
}

// One line for each message in `bytes`, and for each trigger.
function readStream(bytes, decompressHandlers, wants) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(bytes);
  const schemas = new Map();
  const channels = new Map();
  const lines = [];
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Schema") schemas.set(record.id, record);
    if (record.type === "Channel") channels.set(record.id, record);
    if (record.type === "Metadata" && record.name === "dssm.trigger") lines.push(trigger(record));
    if (record.type !== "Message") continue;
    const channel = channels.get(record.channelId);
    if (!channel.decoder) {
      const schema = schemas.get(channel.schemaId);
      check(schema.encoding === "ros2msg" && channel.messageEncoding === "cdr", channel.topic);
      const text = new TextDecoder().decode(schema.data);
      channel.decoder = new MessageReader(parse(text, { ros2: true }));
    }
    check(record.logTime === record.publishTime, "two times");
    const fields = JSON.stringify(channel.decoder.readMessage(record.data), (key, value) => {
      if (key.startsWith("pad")) return undefined;
      if (typeof value === "bigint") return `${value}n`;
      return ArrayBuffer.isView(value) ? Array.from(value) : value;
    });
    lines.push(`${channel.topic} ${record.sequence} ${record.logTime} ${fields}`);
  }
  check(!wants.whole || reader.done(), "it does not end");
  return lines;
}

async function readIndexed(bytes, decompressHandlers, lines) {
  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) =>
      bytes.subarray(Number(offset), Number(offset) + Number(length)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  let count = 0n;
  let last = 0n;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    check(message.logTime >= last, "indexed messages are not sorted");
    last = message.logTime;
    ++count;
  }
  check(reader.statistics.messageCount === count, "messages of the statistics");
  for await (const attachment of reader.readAttachments()) void attachment;
  for await (const record of reader.readMetadata({ name: "dssm.trigger" })) {
    check(lines.includes(trigger(record)), "another trigger by the index");
    ++count;
  }
  return count;
}

async function main(files) {
  const decompressHandlers = await loadDecompressHandlers();
  for (const file of files) {
    const bytes = new Uint8Array(fs.readFileSync(file));
    const lines = readStream(bytes, decompressHandlers, { whole: true });
    const indexed = await readIndexed(bytes, decompressHandlers, lines);
    check(indexed === BigInt(lines.length), `${file}: ${indexed} of ${lines.length} by the index`);
    let before = 0;
    for (let length = 8; length < bytes.length; length += 97) {
      const cut = readStream(bytes.subarray(0, length), decompressHandlers, { whole: false });
      check(cut.length >= before, "fewer messages in more bytes");
      check(cut.every((line, i) => line === lines[i]), "another message in a cut file");
      before = cut.length;
    }
    console.log(lines.join("\n"));
  }
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
