// SPDX-License-Identifier: Apache-2.0
//
// The overview: hosts, streams, the graph of programs and streams, doctor's findings, events.
import { element, setText, syncChildren, duration, bytes, rate, timeOfDay, day } from "./format.js";
import { drawGraph } from "./graph.js";

const kUnknown = "\u2013";
const kMaxEvents = 200;
const kNoEvents = "Nothing has happened since dssm-view was started.";

export class Overview {
  // open: called with the name of a stream that was clicked
  constructor(root, open) {
    this.root = root;
    this.open = open;
    this.answer = null;
    this.graphText = "";
    new ResizeObserver(() => this.drawGraph()).observe(root.querySelector("#graph"));
  }

  show(answer) {
    this.answer = answer;
    const limitNs = answer.clock_limit_ns ?? null;
    const recorded = Boolean(answer.recording);
    this.find("hosts-group").hidden = recorded;
    this.find("findings-group").hidden = recorded && answer.findings.length === 0;
    setText(this.find("findings-title").firstChild, recorded ? "Warnings " : "Doctor ");
    setText(this.find("no-events"), recorded ? "The recorder waited for no event." : kNoEvents);
    this.showHosts(answer.hosts, limitNs);
    this.showStreams(answer.streams, answer.nodes);
    this.showUnlisted(answer);
    this.showFindings(answer.findings);
    this.showEvents(answer.events);
    this.drawGraph();
  }

  find(id) {
    return this.root.querySelector(`#${id}`);
  }

  // --- hosts -------------------------------------------------------------------------------------

  showHosts(hosts, limitNs) {
    setText(this.find("hosts-count"), String(hosts.length));
    const limit = limitNs === null ? "" : `(limit ${duration(limitNs)})`;
    setText(this.find("clock-limit"), limit);
    const key = (host) => host.host ?? host.id ?? host.addresses.join(" ");
    syncChildren(this.find("hosts").tBodies[0], hosts, key, makeHost, (row, host) => {
      const [name, state, trip, streams, bound, address, note] = row.cells;
      row.dataset.host = host.host ?? "";
      row.dataset.state = host.state;
      setText(name, host.host ?? kUnknown);
      setState(state, host.state, hostLevel(host.state));
      state.title = `for ${duration(host.state_for_ns)}`;
      setText(trip, host.round_trip_ns ? duration(host.round_trip_ns) : kUnknown);
      setText(streams, host.streams === null ? kUnknown : String(host.streams));
      showBound(bound, host.clock_distance_ns, limitNs);
      setText(address, host.addresses.join(", "));
      const notes = [host.insecure ? "not encrypted" : "", host.error ?? host.reason ?? ""];
      setText(note, notes.filter((text) => text).join("; "));
    });
  }

  // --- streams -----------------------------------------------------------------------------------

  showStreams(streams, nodes) {
    setText(this.find("streams-count"), String(streams.length));
    this.find("streams").hidden = streams.length === 0;
    const users = usersOf(nodes);
    const key = (stream) => stream.stream;
    const make = (stream) => this.makeStream(stream);
    syncChildren(this.find("streams").tBodies[0], streams, key, make, (row, stream) => {
      const [name, state, hz, age, tid, held, lost, size, writers, readers] = row.cells;
      row.dataset.stream = stream.stream;
      row.dataset.state = stream.state ?? "unknown";
      name.title = stream.type ?? "no type";
      setState(state, stream.state ?? kUnknown, streamLevel(stream.state));
      setText(hz, stream.rate_hz === null ? kUnknown : rate(stream.rate_hz));
      setText(age, stream.age_ns === null ? kUnknown : duration(stream.age_ns));
      setText(tid, stream.newest_tid === null ? kUnknown : String(stream.newest_tid));
      setText(held, heldText(stream));
      const losses = lossesOf(stream);
      setText(lost, losses.text);
      lost.title = losses.title;
      lost.classList.toggle("bad", losses.bad);
      setText(size, bytes(stream.payload_bytes));
      const used = users.get(stream.stream) ?? { writers: [], readers: [] };
      showUsers(writers, used.writers, sum(stream.writers, stream.remote_writers));
      showUsers(readers, used.readers, sum(stream.readers, stream.remote_readers));
    });
  }

  // Why there may be more streams than those that are listed.
  showUnlisted({ streams, hosts }) {
    const texts = hosts
      .filter((host) => host.host && !isUp(host))
      .map(({ host, state }) => `Host ${host} is ${state}: its streams are not listed.`);
    if (streams.length === 0) texts.unshift("No stream is known.");
    const note = this.find("no-streams");
    note.hidden = texts.length === 0;
    setText(note, texts.join(" "));
  }

  makeStream(stream) {
    const row = element("tr", { tabindex: "-1" });
    const label = stream.id === 0 ? stream.name : `${stream.name}:${stream.id}`;
    const open = () => this.open(stream.stream);
    const link = element(
      "button",
      { class: "link", title: "Show it in a view", onclick: open },
      label,
    );
    row.append(
      element(
        "th",
        { scope: "row" },
        link,
        // A recording may not know it.
        element("span", { class: "at" }, stream.host ? `@${stream.host}` : ""),
      ),
    );
    const labels = [
      "State",
      "Rate",
      "Age",
      "Newest tid",
      "Held",
      "Lost",
      "Sample",
      "Writers",
      "Readers",
    ];
    for (const [i, text] of labels.entries()) {
      const numeric = i > 0 && i < 7;
      const hint = "What the rings hold: from the oldest to the newest sample";
      row.append(
        element("td", {
          class: numeric ? "number" : i > 6 ? "users" : null,
          "data-label": text,
          title: text === "Held" ? hint : null,
        }),
      );
    }
    return row;
  }

  // --- findings, events --------------------------------------------------------------------------

  showFindings(findings) {
    const bad = findings.filter((finding) => finding.status !== "ok");
    const good = findings.filter((finding) => finding.status === "ok");
    bad.sort((a, b) => (a.status === "fail" ? 0 : 1) - (b.status === "fail" ? 0 : 1));
    setText(this.find("findings-count"), bad.length > 0 ? String(bad.length) : "");
    const key = (finding) => finding.name;
    syncChildren(this.find("findings"), bad, key, makeFinding, updateFinding);
    const details = this.find("findings-ok");
    details.hidden = good.length === 0;
    setText(details.querySelector("summary"), `${good.length} checks are ok`);
    syncChildren(details.querySelector("ul"), good, key, makeFinding, updateFinding);
  }

  showEvents(events) {
    const newest = events.slice(-kMaxEvents).reverse();
    this.find("no-events").hidden = newest.length > 0;
    const make = (event) => {
      const ns = BigInt(event.time_ns);
      return element(
        "li",
        { class: event.severity, "data-severity": event.severity },
        element(
          "time",
          { datetime: new Date(Number(ns / 1000000n)).toISOString(), title: day(ns) },
          timeOfDay(ns),
        ),
        element("span", {}, event.text),
      );
    };
    syncChildren(
      this.find("events"),
      newest,
      (event) => String(event.number),
      make,
      () => {},
    );
  }

  // --- graph -------------------------------------------------------------------------------------

  drawGraph() {
    if (!this.answer || this.root.hidden) return;
    const box = this.find("graph");
    const { streams, nodes, hosts } = this.answer;
    const inGraph = {
      width: box.clientWidth,
      streams: streams.map((stream) => [
        stream.stream,
        stream.name,
        stream.id,
        stream.host,
        stream.state,
      ]),
      nodes: nodes.filter((node) => node.program !== null || node.pid !== null),
      outages: hosts.filter((host) => !isUp(host)).map(({ host, state }) => [host, state]),
    };
    const text = JSON.stringify(inGraph);
    if (text === this.graphText) return;
    this.graphText = text;
    const isEmpty = streams.length + inGraph.nodes.length === 0 || this.answer.recording;
    this.root.querySelector("#graph-group").hidden = Boolean(isEmpty);
    const outages = new Map(inGraph.outages);
    box.replaceChildren(drawGraph(streams, inGraph.nodes, outages, box.clientWidth));
  }
}

function makeHost() {
  const row = element("tr");
  row.append(element("th", { scope: "row" }));
  const labels = ["State", "Round trip", "Streams", "Clock, from here", "Address", "Note"];
  for (const text of labels) {
    const numeric = text === "Round trip" || text === "Streams";
    row.append(element("td", { class: numeric ? "number" : null, "data-label": text }));
  }
  return row;
}

const isUp = ({ state }) => state === "self" || state === "up";

function hostLevel(state) {
  if (isUp({ state })) return "ok";
  return state === "down" || state === "refused" ? "fail" : "warn";
}

function streamLevel(state) {
  if (state === "live") return "ok";
  return state === "stalled" || state === "no writer" ? "warn" : "none";
}

function setState(cell, text, level) {
  if (!cell.firstElementChild) cell.append(element("span", { class: "state" }));
  const state = cell.firstElementChild;
  setText(state, text);
  state.dataset.level = level;
}

// The bound as a bar: full at the limit.
function showBound(cell, boundNs, limitNs) {
  if (!cell.firstElementChild) {
    cell.append(
      element("span", { class: "bar" }, element("span")),
      element("span", { class: "value" }),
    );
  }
  const [bar, value] = cell.children;
  const known = boundNs !== null && boundNs !== undefined;
  const share = known && limitNs !== null ? Math.min(1, boundNs / limitNs) : 0;
  bar.firstElementChild.style.width = `${share * 100}%`;
  bar.hidden = limitNs === null;
  bar.dataset.level = !known ? "none" : boundNs > limitNs ? "fail" : share > 0.66 ? "warn" : "ok";
  setText(value, known ? duration(boundNs) : "unknown");
}

// stream -> {writers: ["program@host"], readers}
function usersOf(nodes) {
  const users = new Map();
  const add = (uses, node, role) => {
    for (const use of uses) {
      if (!users.has(use.stream)) users.set(use.stream, { writers: [], readers: [] });
      users.get(use.stream)[role].push(node);
    }
  };
  for (const node of nodes) {
    add(node.writes ?? [], node, "writers");
    add(node.reads ?? [], node, "readers");
  }
  return users;
}

const sum = (a, b) => (a === null || a === undefined ? null : a + (b ?? 0));

function showUsers(cell, nodes, count) {
  const names = nodes.map((node) => [node.program ?? `pid ${node.pid}`, node.host]);
  const key = JSON.stringify([names, count]);
  if (cell.dataset.names === key) return;
  cell.dataset.names = key;
  const parts = names.map(([program, host], i) =>
    element(
      "span",
      { class: "user" },
      program,
      element("span", { class: "at" }, `@${host}${i + 1 < names.length ? "," : ""}`),
    ),
  );
  if (parts.length === 0)
    parts.push(count === null ? kUnknown : count === 0 ? "none" : String(count));
  cell.replaceChildren(...parts);
  cell.classList.toggle("none", names.length === 0);
}

function heldText(stream) {
  if (stream.oldest_ns === null || stream.oldest_ns === undefined) return kUnknown;
  const ns = BigInt(stream.newest_ns) - BigInt(stream.oldest_ns);
  return ns > 0n ? duration(ns) : "1 sample";
}

// Only a mirror on this host can lose samples; without one there is nothing to count.
function lossesOf(stream) {
  if (stream.lost_samples !== undefined) {
    const title = `${stream.samples} samples were recorded`;
    return { text: String(stream.lost_samples), title, bad: stream.lost_samples > 0 };
  }
  const mirror = stream.mirror;
  if (!mirror) return { text: kUnknown, title: "This host has no mirror of it", bad: false };
  const title =
    `${mirror.gap_samples} of ${mirror.gap_samples + mirror.received_samples} samples did ` +
    `not reach this host's mirror; lately ${mirror.recent_lost_samples}`;
  return { text: String(mirror.gap_samples), title, bad: mirror.recent_lost_samples > 0 };
}

function makeFinding() {
  return element(
    "li",
    {},
    element("span", { class: "state" }),
    element(
      "div",
      {},
      element("p", {}, element("strong"), " ", element("span")),
      element("p", { class: "note" }),
      element("code"),
    ),
  );
}

function updateFinding(item, finding) {
  item.dataset.status = finding.status;
  const state = item.querySelector(".state");
  setText(state, finding.status);
  state.dataset.level = finding.status;
  setText(item.querySelector("strong"), finding.name);
  setText(item.querySelector("p > span"), finding.text);
  const cause = item.querySelector(".note");
  setText(cause, finding.cause ?? "");
  cause.hidden = !finding.cause;
  const command = item.querySelector("code");
  setText(command, finding.command ?? "");
  command.hidden = !finding.command;
}
