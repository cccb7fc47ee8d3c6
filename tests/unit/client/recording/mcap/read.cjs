// SPDX-License-Identifier: Apache-2.0
//
// Reads recordings with the MCAP readers of Foxglove. The first thing that is wrong ends it with a
// failure.
//
//   node read.cjs FILE...         as a stream with CRC checks, and by the index. Prints each message:
//                                 topic, sequence, log time, and its fields as their decoder finds
//                                 them
//   node read.cjs --cut FILE...   files that are cut off, as a stream. For each line of stdin, which
//                                 is the number of a file, from 0 on, and how many of its bytes are
//                                 left, prints how many messages that has; they must be the first
//                                 ones of the whole file
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

// Calls `onMessage(message, channel, schema)` for each message in `bytes`, and `onTrigger`.
function readStream(bytes, decompressHandlers, onMessage, onTrigger) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(bytes);
  const schemas = new Map();
  const channels = new Map();
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Schema") schemas.set(record.id, record);
    if (record.type === "Channel") channels.set(record.id, record);
    if (record.type === "Metadata" && record.name === "dssm.trigger") onTrigger(record);
    if (record.type !== "Message") continue;
    const channel = channels.get(record.channelId);
    onMessage(record, channel, schemas.get(channel.schemaId));
  }
  return reader.done();
}

// One line for each message in `bytes`, and for each trigger.
function decodeStream(bytes, decompressHandlers) {
  const lines = [];
  const onMessage = (message, channel, schema) => {
    if (!channel.decoder) {
      check(schema.encoding === "ros2msg" && channel.messageEncoding === "cdr", channel.topic);
      const text = new TextDecoder().decode(schema.data);
      channel.decoder = new MessageReader(parse(text, { ros2: true }));
    }
    check(message.logTime === message.publishTime, "two times");
    const fields = JSON.stringify(channel.decoder.readMessage(message.data), (key, value) => {
      if (key.startsWith("pad")) return undefined;
      if (typeof value === "bigint") return `${value}n`;
      return ArrayBuffer.isView(value) ? Array.from(value) : value;
    });
    lines.push(`${channel.topic} ${message.sequence} ${message.logTime} ${fields}`);
  };
  const ends = readStream(bytes, decompressHandlers, onMessage, (record) => {
    lines.push(trigger(record));
  });
  check(ends, "it does not end");
  return lines;
}

// The bytes of each message in `bytes`, with its topic, sequence and log time.
function messagesOf(bytes, decompressHandlers) {
  const messages = [];
  const onMessage = (message, channel, schema) => {
    const name = `${channel.topic} ${schema.name} ${message.sequence} ${message.logTime}`;
    messages.push({ name, data: message.data });
  };
  readStream(bytes, decompressHandlers, onMessage, () => {});
  return messages;
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

function readWhole(files, decompressHandlers) {
  return Promise.all(
    files.map(async (file) => {
      const bytes = new Uint8Array(fs.readFileSync(file));
      const lines = decodeStream(bytes, decompressHandlers);
      const indexed = await readIndexed(bytes, decompressHandlers, lines);
      check(indexed === BigInt(lines.length), `${file}: ${indexed} of ${lines.length} by the index`);
      return lines.join("\n");
    }),
  );
}

function readCut(files, decompressHandlers) {
  const contents = files.map((file) => new Uint8Array(fs.readFileSync(file)));
  const wholes = contents.map((bytes) => messagesOf(bytes, decompressHandlers));
  const cuts = fs.readFileSync(0, "utf8").trim().split("\n");
  return cuts.map((cut) => {
    const [file, length] = cut.split(" ").map(Number);
    const messages = messagesOf(contents[file].subarray(0, length), decompressHandlers);
    const isTheSame = ({ name, data }, i) =>
      name === wholes[file][i].name && Buffer.compare(data, wholes[file][i].data) === 0;
    check(messages.every(isTheSame), `${files[file]}: another message in its first ${length} bytes`);
    return messages.length;
  });
}

async function main(words) {
  const decompressHandlers = await loadDecompressHandlers();
  const lines =
    words[0] === "--cut"
      ? readCut(words.slice(1), decompressHandlers)
      : await readWhole(words, decompressHandlers);
  console.log(lines.join("\n"));
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
