// SPDX-License-Identifier: Apache-2.0
//
// Reads streams from dssm-view with Foxglove's own client and decoder.
//
//   node client.cjs URL SUBPROTOCOL TOPIC...   subscribes to the topics, prints the first sample of
//                                              each as "TOPIC TIME FIELDS", and the programs that
//                                              write it; then ends. What is wrong ends it with a
//                                              failure
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { WebSocket } = require("ws");

const [url, subprotocol, ...topics] = process.argv.slice(2);
const missing = new Set([...topics, "time", "graph"]);
const readers = new Map();

function done(what) {
  if (!missing.delete(what)) return false;
  if (missing.size === 0) process.exit(0);
  return true;
}

function text(fields) {
  return JSON.stringify(fields, (_, value) => {
    if (typeof value === "bigint") return Number(value);
    return ArrayBuffer.isView(value) ? [...value] : value;
  });
}

const client = new FoxgloveClient({ ws: new WebSocket(url, [subprotocol]) });
client.on("error", (error) => {
  throw error;
});
client.on("close", () => {
  throw new Error("closed");
});
client.on("serverInfo", (info) => {
  console.log("server", info.name, info.capabilities.join(" "));
  client.subscribeConnectionGraph();
});
client.on("status", (status) => console.log("status", status.level, status.message));
client.on("advertise", (channels) => {
  for (const channel of channels) {
    if (!topics.includes(channel.topic)) continue;
    if (channel.encoding !== "cdr" || channel.schemaEncoding !== "ros2msg") throw new Error("encoding");
    const reader = new MessageReader(parse(channel.schema, { ros2: true }));
    readers.set(client.subscribe(channel.id), { topic: channel.topic, reader });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = readers.get(subscriptionId);
  if (!missing.has(topic)) return;
  console.log(topic, String(timestamp), text(reader.readMessage(data)));
  done(topic);
});
client.on("time", () => done("time"));
client.on("connectionGraphUpdate", (update) => {
  const writers = new Map(update.publishedTopics.map((topic) => [topic.name, topic.publisherIds]));
  // The first graph may come before the programs are known.
  if (!topics.every((topic) => writers.get(topic)?.length > 0) || !missing.has("graph")) return;
  for (const topic of topics) console.log("writers", topic, writers.get(topic).join(" "));
  done("graph");
});
