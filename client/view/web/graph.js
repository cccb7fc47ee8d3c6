// SPDX-License-Identifier: Apache-2.0
//
// The graph of programs and streams as SVG, in layers: an arrow goes from a writer to its stream
// and from there to each reader, dashed where the two are on different hosts. In a narrow window
// the layers are below each other.

const kSvg = "http://www.w3.org/2000/svg";
const kBoxWidth = 148;
const kBoxHeight = 40;
const kLayerGap = 64; // between layers, where the arrows are
const kGap = 14; // within a layer
const kMargin = 6;
const kSweeps = 8;
const kNarrow = 560;
const kMaxText = 18;
const kNarrowBoxWidth = 104;
const kNarrowMaxText = 12;
const kBackBend = 22; // of an arrow to an earlier layer, which passes beside the boxes
const kWay = 12; // what a long arrow takes up in the layers that it passes

// nodes: of `overview`; outages: host -> state of those that are not up; width: the place for the
// drawing, in CSS pixels.
export function drawGraph(streams, nodes, outages, width) {
  const boxes = boxesOf(streams, nodes, outages);
  const down = width < kNarrow;
  const shape = {
    down,
    width: down ? kNarrowBoxWidth : kBoxWidth,
    text: down ? kNarrowMaxText : kMaxText,
  };
  const layers = layersOf(boxes);
  const arrows = arrowsOf(layers, boxes);
  const size = place(order(layers, boxes), shape);
  if (arrows.some(isBack)) size[down ? "width" : "height"] += kBackBend;
  const svg = make("svg", {
    viewBox: `0 0 ${size.width} ${size.height}`,
    width: size.width,
    height: size.height,
    role: "img",
    "aria-label": describe(arrows),
  });
  const defs = make("defs", {});
  const head = make("marker", {
    id: "arrow",
    viewBox: "0 0 8 8",
    refX: 7,
    refY: 4,
    markerWidth: 7,
    markerHeight: 7,
    orient: "auto-start-reverse",
  });
  head.append(make("path", { d: "M0 0.5 L7.5 4 L0 7.5 z", class: "arrow-head" }));
  defs.append(head);
  svg.append(defs);
  for (const arrow of arrows) svg.append(drawArrow(arrow, shape));
  for (const box of boxes.values()) if (box.kind !== "way") svg.append(drawBox(box, shape));
  return svg;
}

// key -> {kind, title, host, level, to: keys, from: keys}
function boxesOf(streams, nodes, outages) {
  const boxes = new Map();
  const add = (key, kind, title, host, state) => {
    const level = outages.has(host) ? `host ${outages.get(host)}` : state;
    if (!boxes.has(key))
      boxes.set(key, { key, kind, title, host, level, to: new Set(), from: new Set() });
    return boxes.get(key);
  };
  for (const stream of streams) {
    const title = stream.id === 0 ? stream.name : `${stream.name}:${stream.id}`;
    add(`stream ${stream.stream}`, "stream", title, stream.host, stream.state ?? "unknown");
  }
  const link = (from, to) => {
    from.to.add(to.key);
    to.from.add(from.key);
  };
  for (const node of nodes) {
    const key = `program ${node.host} ${node.pid} ${node.program}`;
    const program = add(key, "program", node.program ?? `pid ${node.pid}`, node.host, "");
    const streamOf = (use) => {
      const [, name, host] = /^(.*?)(?:@(.*))?$/.exec(use.stream);
      return add(
        `stream ${use.stream}`,
        "stream",
        name.replace(/:0$/, ""),
        host ?? node.host,
        "unknown",
      );
    };
    for (const use of node.writes ?? []) link(program, streamOf(use));
    for (const use of node.reads ?? []) link(streamOf(use), program);
  }
  return boxes;
}

// The longest way from a box without arrows to it; arrows that close a circle do not count.
function layersOf(boxes) {
  const layerOf = new Map();
  const open = new Set();
  const visit = (key) => {
    if (layerOf.has(key)) return layerOf.get(key);
    open.add(key);
    let layer = boxes.get(key).kind === "stream" && boxes.get(key).from.size === 0 ? 1 : 0;
    for (const from of boxes.get(key).from) {
      if (!open.has(from)) layer = Math.max(layer, visit(from) + 1);
    }
    open.delete(key);
    layerOf.set(key, layer);
    return layer;
  };
  const layers = [];
  for (const key of boxes.keys()) (layers[visit(key)] ??= []).push(key);
  return layers.filter((layer) => layer);
}

// The arrows, each a list of boxes from its writer to its reader. Between layers that are not
// neighbours it passes a place of its own in each layer between, so that it crosses no box.
function arrowsOf(layers, boxes) {
  const layerOf = new Map(layers.flatMap((layer, i) => layer.map((key) => [key, i])));
  const arrows = [];
  for (const box of [...boxes.values()]) {
    for (const key of [...box.to]) {
      const to = boxes.get(key);
      const ways = [box];
      box.layer = layerOf.get(box.key);
      to.layer = layerOf.get(key);
      for (let i = layerOf.get(box.key) + 1; i < layerOf.get(key); ++i) {
        const way = {
          key: `way ${box.key} ${key} ${i}`,
          kind: "way",
          to: new Set(),
          from: new Set(),
        };
        boxes.set(way.key, way);
        layers[i].push(way.key);
        ways.push(way);
      }
      ways.push(to);
      if (ways.length > 2) {
        box.to.delete(key);
        to.from.delete(box.key);
        for (let i = 0; i + 1 < ways.length; ++i) {
          ways[i].to.add(ways[i + 1].key);
          ways[i + 1].from.add(ways[i].key);
        }
      }
      arrows.push(ways);
    }
  }
  return arrows;
}

// Fewer crossings: each box goes to the mean place of its neighbours, again and again.
function order(layers, boxes) {
  const at = new Map();
  const note = (layer) => layer.forEach((key, i) => at.set(key, (i + 0.5) / layer.length));
  layers.forEach(note);
  for (let sweep = 0; sweep < kSweeps; ++sweep) {
    const direction = sweep % 2 === 0 ? "from" : "to";
    for (const layer of sweep % 2 === 0 ? layers : [...layers].reverse()) {
      const mean = (key) => {
        const next = [...boxes.get(key)[direction]];
        if (next.length === 0) return at.get(key);
        return next.reduce((total, other) => total + at.get(other), 0) / next.length;
      };
      const means = new Map(layer.map((key) => [key, mean(key)]));
      layer.sort((a, b) => means.get(a) - means.get(b) || (a < b ? -1 : 1));
      note(layer);
    }
  }
  return layers.map((layer) => layer.map((key) => boxes.get(key)));
}

// Sets x and y of each box, centred in its layer; returns the size of the whole.
function place(layers, { down, width }) {
  const along = down ? kBoxHeight : width;
  const gap = down ? kLayerGap / 2 : kLayerGap;
  const across = (box) => (box.kind === "way" ? kWay : down ? width : kBoxHeight);
  const breadth = (layer) => layer.reduce((total, box) => total + across(box) + kGap, -kGap);
  const most = Math.max(0, ...layers.map(breadth));
  layers.forEach((layer, i) => {
    const u = kMargin + i * (along + gap);
    let v = kMargin + (most - breadth(layer)) / 2;
    for (const box of layer) {
      [box.x, box.y] = down ? [v, u] : [u, v];
      v += across(box) + kGap;
    }
  });
  const length = Math.max(0, layers.length * (along + gap) - gap) + 2 * kMargin;
  return down
    ? { width: most + 2 * kMargin, height: length }
    : { width: length, height: most + 2 * kMargin };
}

// A program that reads what it has caused: the arrow closes a circle.
function isBack(ways) {
  return ways.at(-1).layer <= ways[0].layer;
}

function backPath(from, to, { down, width }) {
  const side = (box) =>
    down ? [box.x + width, box.y + kBoxHeight / 2] : [box.x + width / 2, box.y + kBoxHeight];
  const bent = ([x, y]) => (down ? [x + kBackBend * 1.2, y] : [x, y + kBackBend * 1.2]);
  return `M${side(from)} C${bent(side(from))} ${bent(side(to))} ${side(to)}`;
}

function drawArrow(ways, { down, width }) {
  const bend = (down ? kLayerGap / 2 : kLayerGap) * 0.6;
  const middle = (box) => (box.kind === "way" ? kWay : down ? width : kBoxHeight) / 2;
  const out = (box) =>
    down ? [box.x + middle(box), box.y + kBoxHeight] : [box.x + width, box.y + middle(box)];
  const into = (box) => (down ? [box.x + middle(box), box.y] : [box.x, box.y + middle(box)]);
  let path = `M${out(ways[0])}`;
  for (let i = 0; i + 1 < ways.length; ++i) {
    const start = out(ways[i]);
    const end = into(ways[i + 1]);
    const c1 = down ? [start[0], start[1] + bend] : [start[0] + bend, start[1]];
    const c2 = down ? [end[0], end[1] - bend] : [end[0] - bend, end[1]];
    path += ` C${c1} ${c2} ${end}`;
    if (i + 2 < ways.length) path += ` L${out(ways[i + 1])}`;
  }
  const from = ways[0];
  const to = ways.at(-1);
  if (isBack(ways)) path = backPath(from, to, { down, width });
  return make("path", {
    d: path,
    class: from.host !== to.host ? "edge remote" : "edge",
    "marker-end": "url(#arrow)",
    "data-from": from.key,
    "data-to": to.key,
  });
}

function drawBox(box, { width, text }) {
  const group = make("g", {
    class: `box ${box.kind}`,
    "data-level": box.level,
    "data-key": box.key,
  });
  const full = make("title", {});
  full.textContent = `${box.kind} ${box.title} on ${box.host}${box.level ? `, ${box.level}` : ""}`;
  const middle = box.x + width / 2;
  const title = make("text", { x: middle, y: box.y + 17, class: "title" });
  title.textContent = shortened(box.title, text);
  const host = make("text", { x: middle, y: box.y + 31, class: "at" });
  const state =
    box.level && box.level !== "live" && box.level !== "unknown" ? `, ${box.level}` : "";
  host.textContent = shortened(`@${box.host}${state}`, text);
  group.append(
    full,
    make("rect", {
      x: box.x,
      y: box.y,
      width,
      height: kBoxHeight,
      rx: box.kind === "stream" ? kBoxHeight / 2 : 3,
    }),
    title,
    host,
  );
  return group;
}

function shortened(text, most) {
  return text.length > most ? `${text.slice(0, most - 1)}\u2026` : text;
}

function describe(arrows) {
  const lines = arrows.map((ways) => `${ways[0].title} to ${ways.at(-1).title}`);
  return `Arrows: ${lines.join(", ") || "none"}`;
}

function make(tag, attributes) {
  const made = document.createElementNS(kSvg, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}
