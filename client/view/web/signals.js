// SPDX-License-Identifier: Apache-2.0
//
// Signals: numeric fields of any streams in panels with one time axis, drawn by uPlot (a global,
// from its script). The curves of each stream come with one `signals` request; the values at the cursor
// come with the page's one `at` request, so that they are those of the exact samples.
import { Pump, RequestError } from "./connection.js";
import { findField, guessKind, isFloat, signalsOf, valueOf } from "./fields.js";
import {
  axisLabels,
  cssColor,
  day,
  download,
  duration,
  element,
  kClockErrorHint,
  number,
  setText,
  timeOfDay,
  wholeDuration,
} from "./format.js";

const kPeriodMs = 100;
const kOpeningMs = 100;
const kArrivingMs = 500;
const kPoints = 800;
const kExportPoints = 20000; // the most that is answered
const kSpans = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600]; // seconds
const kDefaultSpan = 10;
const kFewPanels = 2;
const kFewFields = 3; // shown before a person has chosen
const kColors = 8;
const kPlotHeight = 220;
const kNarrowHeight = 170;
const kFont = "11px system-ui, sans-serif";
const kAxisPx = 58; // of the values beside a plot, for usual ones
const kAxisGapPx = 14; // between the labels and the plot
const kLabelPx = 80; // of the clock error beside the cursor
const kDragPx = 4; // a shorter way of the pointer is a click
const kMinZoomNs = 1000n;

export const nameOf = (signal) => `${signal.stream} ${signal.field}`;

// Dispatches "change" when what is chosen has changed.
export class Signals extends EventTarget {
  // types: the known types of streams; streams: returns those of the last overview
  // textOf: of a stream and a status, for people
  constructor(root, { connection, time, types, streams, textOf }) {
    super();
    Object.assign(this, { root, connection, time, types, streams, textOf });
    this.panels = []; // {signals, element, legend, plot}
    this.span = kDefaultSpan;
    this.zoom = null; // {from, to}
    this.window = null; // {from, to}: what is drawn
    this.answers = new Map(); // stream -> what the last `signals` request brought
    this.samples = new Map(); // stream -> its sample at the cursor
    this.axisPx = kAxisPx; // beside all plots
    this.ruler = element("canvas").getContext("2d"); // measures labels
    this.ruler.font = kFont;
    this.epoch = null; // x of plots is seconds since then: small enough for exact doubles
    this.box = root.querySelector("#panels");
    this.makeTools();
    this.picker = new Picker(document.querySelector("#picker"), this);
    this.pump = new Pump(connection, kPeriodMs, () => this.ask());
    time.addEventListener("mode", () => {
      if (time.mode !== "live") return;
      this.resetZoom();
      this.pump.wake(); // while held, it waits
    });
    time.addEventListener("change", () => {
      if (time.hover !== null || time.mode === "live") return this.drawCursor();
      const { window } = this;
      this.keepInWindow();
      if (time.mode === "play" && window === this.window) this.drawCursor();
      else this.pump.wake();
    });
    new ResizeObserver(() => this.resize()).observe(this.box);
  }

  makeTools() {
    const find = (id) => this.root.querySelector(`#${id}`);
    this.spans = find("span");
    for (const span of kSpans) this.spans.add(new Option(wholeDuration(span), span));
    this.spans.value = this.span;
    this.spans.addEventListener("change", () => {
      this.span = Number(this.spans.value);
      this.zoom = this.window = null;
      this.unzoom.hidden = true;
      this.keepInWindow();
      this.changed();
    });
    this.unzoom = find("unzoom");
    this.unzoom.addEventListener("click", () => this.resetZoom());
    find("add-panel").addEventListener("click", () => this.addPanel([], true));
    find("export-csv").addEventListener("click", () => this.exportCsv());
    find("export-png").addEventListener("click", () => this.exportPng());
  }

  // --- what is chosen ----------------------------------------------------------------------------

  get state() {
    return {
      span: this.span,
      panels: this.panels.map((panel) =>
        panel.signals.map((signal) => [signal.stream, signal.field]),
      ),
    };
  }

  // As from `state`; anything that does not fit is left out.
  set state({ span, panels }) {
    if (kSpans.includes(span)) this.span = span;
    this.spans.value = this.span;
    if (!Array.isArray(panels)) return;
    for (const panel of [...this.panels]) this.drop(panel);
    for (const panel of panels.filter(Array.isArray)) {
      const good = (one) =>
        Array.isArray(one) && one.length === 2 && one.every((x) => typeof x === "string");
      this.addPanel(panel.filter(good).map(([stream, field]) => ({ stream, field })));
    }
  }

  // Until a person has chosen: a panel with a few fields of each of the first streams, of live ones
  // before others, and of arrays last.
  async suggest() {
    if (this.panels.length > 0) this.suggested = true;
    if (this.suggested || this.streams().length === 0) return;
    this.suggested = true;
    const known = [];
    let isAnyMissing = false;
    for (const { stream, state } of this.streams()) {
      const type = await this.types.ask(stream);
      isAnyMissing ||= !type;
      const names = type
        ? signalsOf(type)
            .filter((one) => !one.count)
            .slice(0, kFewFields)
        : [];
      const isArray = type && ["scan", "image"].includes(guessKind(type));
      if (names.length > 0) known.push({ stream, names, order: 2 * (state !== "live") + isArray });
    }
    if (known.length === 0 && isAnyMissing) {
      this.suggested = false; // again, with the next overview
      return;
    }
    known.sort((a, b) => a.order - b.order);
    for (const { stream, names } of known.slice(0, kFewPanels)) {
      this.addPanel(names.map(({ name }) => ({ stream, field: name })));
    }
    if (this.panels.length === 0) this.addPanel([]);
    this.wakeAll();
  }

  chosenStreams() {
    return [...new Set(this.panels.flatMap((panel) => panel.signals.map((one) => one.stream)))];
  }

  changed() {
    this.dispatchEvent(new Event("change"));
    this.wakeAll();
  }

  wakeAll() {
    this.pump.wake();
    this.time.dispatchEvent(new Event("change"));
  }

  // --- panels ------------------------------------------------------------------------------------

  addPanel(signals, choose = false) {
    const panel = { signals: [...signals], plot: null, pointerPx: null };
    panel.legend = element("ul", { class: "legend" });
    panel.plotBox = element("div", { class: "plot" });
    panel.note = element("p", { class: "status", role: "status" });
    panel.element = element(
      "section",
      { class: "panel", "aria-label": "Panel" },
      element(
        "header",
        {},
        panel.legend,
        element(
          "div",
          { class: "buttons" },
          element(
            "button",
            { class: "choose", onclick: () => this.picker.open(panel) },
            "Signals\u2026",
          ),
          element(
            "button",
            {
              class: "quiet",
              "aria-label": "Remove this panel",
              title: "Remove this panel",
              onclick: () => {
                this.drop(panel);
                this.changed();
              },
            },
            "\u00d7",
          ),
        ),
      ),
      panel.plotBox,
      panel.note,
    );
    this.panels.push(panel);
    this.box.append(panel.element);
    this.rebuild(panel);
    if (choose) {
      this.changed();
      this.picker.open(panel);
    }
  }

  drop(panel) {
    panel.plot?.destroy();
    panel.element.remove();
    this.panels = this.panels.filter((other) => other !== panel);
    this.align();
  }

  toggle(panel, signal, on) {
    panel.signals = panel.signals.filter((one) => nameOf(one) !== nameOf(signal));
    if (on) panel.signals.push(signal);
    this.rebuild(panel);
    this.changed();
  }

  // Colours have changed.
  restyle() {
    for (const panel of this.panels) this.rebuild(panel);
  }

  rebuild(panel) {
    panel.plot?.destroy();
    panel.plot = null;
    panel.axisPx = kAxisPx;
    this.align();
    panel.legend.replaceChildren(
      ...panel.signals.map((signal, i) => {
        const [stream, host] = splitHost(signal.stream);
        return element(
          "li",
          { "data-signal": nameOf(signal), "data-color": i % kColors },
          element("span", { class: "swatch" }),
          element(
            "span",
            { class: "name" },
            `${stream.replace(/:0$/, "")}.${signal.field}`,
            element("span", { class: "at" }, host),
          ),
          element("span", { class: "value" }),
          element("span", { class: "tid", title: "tid" }),
          element("span", { class: "stale" }),
          element(
            "button",
            {
              class: "quiet",
              "aria-label": `Remove ${nameOf(signal)}`,
              title: "Remove",
              onclick: () => this.toggle(panel, signal, false),
            },
            "\u00d7",
          ),
        );
      }),
    );
    panel.plotBox.hidden = panel.signals.length === 0;
    setText(panel.note, panel.signals.length === 0 ? "Choose signals to plot." : "");
    if (panel.signals.length === 0 || this.root.hidden) return;
    this.makePlot(panel);
    this.draw(panel);
    this.showValues();
  }

  makePlot(panel) {
    const text = cssColor("--text-2");
    const grid = { stroke: cssColor("--grid"), width: 1 };
    const axis = { stroke: text, font: kFont, grid, ticks: { ...grid, size: 4 } };
    const stepped = uPlot.paths.stepped({ align: 1 });
    const series = panel.signals.map((signal, i) => {
      const found =
        this.types.get(signal.stream) && findField(this.types.get(signal.stream), signal.field);
      return {
        stroke: cssColor(`--c${i % kColors}`),
        width: 1.5,
        points: { size: 4 },
        paths: found && !isFloat(found.field) ? stepped : undefined,
      };
    });
    const options = {
      ...this.plotSize(),
      padding: [8, 30, 0, 0],
      legend: { show: false },
      scales: { x: { time: false, range: () => this.windowX() }, y: { range: rangeY } },
      axes: [
        {
          ...axis,
          size: 26,
          space: 76,
          incrs: kIncrements,
          values: (plot, splits, i, space, step) => splits.map((x) => this.tick(x, step)),
        },
        {
          ...axis,
          size: (plot, labels) => this.axisSize(panel, labels ?? []),
          values: (plot, splits) => axisLabels(splits),
        },
      ],
      cursor: {
        x: false,
        y: false,
        points: { show: false },
        drag: { x: true, y: false, setScale: false },
      },
      series: [{}, ...series],
      // The place of the cursor is known when the plot has its new scale.
      hooks: { setSelect: [(plot) => this.onSelect(plot)], draw: [() => this.onDraw(panel)] },
    };
    panel.line = null; // the new plot draws at once
    panel.plot = new uPlot(options, [[], ...panel.signals.map(() => [])], panel.plotBox);
    panel.band = element("div", { class: "cursor-band", hidden: true });
    panel.line = element(
      "div",
      { class: "cursor-line", hidden: true },
      element("span", { title: kClockErrorHint }),
    );
    panel.plot.over.append(panel.band, panel.line);
    this.listen(panel);
  }

  // As wide as the labels of all panels need, so that equal times are below each other. A panel's
  // part only grows until its signals change: plots whose edge moves all the time are hard to read.
  axisSize(panel, labels) {
    const widths = labels.map((label) => this.ruler.measureText(label).width);
    panel.axisPx = Math.max(panel.axisPx, Math.ceil(Math.max(0, ...widths)) + kAxisGapPx);
    this.align();
    return this.axisPx;
  }

  align() {
    const axisPx = Math.max(kAxisPx, ...this.panels.map((panel) => panel.axisPx));
    if (axisPx === this.axisPx) return;
    this.axisPx = axisPx;
    for (const { plot } of this.panels) plot?.redraw(false, true);
  }

  listen(panel) {
    const { over } = panel.plot;
    let pressedAt = 0;
    const moveTo = (event) => {
      panel.pointerPx = event.clientX - over.getBoundingClientRect().left;
      this.time.setHover(this.timeAt(panel));
    };
    over.addEventListener("mousemove", (event) => this.epoch !== null && moveTo(event));
    over.addEventListener("mouseleave", () => {
      panel.pointerPx = null;
      this.time.setHover(null);
    });
    over.addEventListener("mousedown", (event) => (pressedAt = event.clientX));
    over.addEventListener("click", (event) => {
      if (this.epoch === null || Math.abs(event.clientX - pressedAt) >= kDragPx) return;
      moveTo(event);
      this.time.hold();
    });
    over.addEventListener("dblclick", () => this.resetZoom());
  }

  // Below the pointer.
  timeAt(panel) {
    return this.toTime(panel.plot.posToVal(panel.pointerPx, "x"));
  }

  // Where the curves move, so does the time below the pointer.
  onDraw(panel) {
    if (this.time.hover !== null && panel.pointerPx !== null) {
      this.time.setHover(this.timeAt(panel));
    }
    this.drawCursorIn(panel);
  }

  plotSize() {
    const width = Math.max(200, this.box.clientWidth - 2);
    return { width, height: width < 560 ? kNarrowHeight : kPlotHeight };
  }

  resize() {
    if (this.root.hidden) return;
    for (const panel of this.panels) {
      if (panel.plot) panel.plot.setSize(this.plotSize());
      else this.rebuild(panel);
    }
    this.drawCursor();
  }

  // The page of signals is shown again.
  open() {
    this.suggest();
    this.resize();
    this.pump.wake();
  }

  // --- the time axis -----------------------------------------------------------------------------

  setEpoch(ns) {
    if (this.epoch !== null) return;
    const midnight = new Date(Number(ns / 1000000n));
    midnight.setHours(0, 0, 0, 0);
    this.epoch = BigInt(midnight.getTime()) * 1000000n;
  }

  toX(ns) {
    return Number(ns - this.epoch) / 1e9;
  }

  toTime(x) {
    return this.epoch + BigInt(Math.round(x * 1e9));
  }

  windowX() {
    if (!this.window || this.epoch === null) return [0, 1];
    return [this.toX(this.window.from), this.toX(this.window.to)];
  }

  tick(x, step) {
    if (this.epoch === null) return "";
    const places = step >= 1 ? 0 : Math.min(9, Math.ceil(-Math.log10(step) - 1e-9));
    return timeOfDay(this.toTime(x), places);
  }

  spanNs() {
    return BigInt(this.span) * 1000000000n;
  }

  onSelect(plot) {
    const { left, width } = plot.select;
    if (width < kDragPx || this.epoch === null) return;
    const from = this.toTime(plot.posToVal(left, "x"));
    const to = this.toTime(plot.posToVal(left + width, "x"));
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (to - from < kMinZoomNs) return;
    this.zoom = this.window = { from, to };
    this.unzoom.hidden = false;
    const { t } = this.time;
    this.time.hover = null;
    this.time.hold(t !== null && t >= from && t <= to ? t : to);
  }

  resetZoom() {
    if (this.zoom === null) return;
    this.zoom = this.window = null;
    this.unzoom.hidden = true;
    this.keepInWindow();
    this.pump.wake();
  }

  // While held: the window stays where it is as long as the instant is in it.
  keepInWindow() {
    const { t } = this.time;
    if (t === null) return;
    const span = this.zoom ? this.zoom.to - this.zoom.from : this.spanNs();
    const there = this.window && this.window.to - this.window.from === span;
    if (there && t >= this.window.from && t <= this.window.to) return;
    // What was live a moment ago hardly moves; otherwise the instant is near that end.
    const plays = this.time.mode === "play";
    const near = !plays && this.window && t > this.window.to && t - this.window.to < span / 10n;
    const begins = plays || (there && t < this.window.from);
    const before = begins ? span / 10n : near ? span : (span * 9n) / 10n;
    let from = t - before;
    const oldest = this.time.range?.oldest;
    if (!near && oldest !== undefined && from < oldest && oldest <= t) from = oldest;
    this.window = { from, to: from + span };
    if (this.zoom) this.zoom = this.window;
  }

  // --- requests ----------------------------------------------------------------------------------

  async ask() {
    if (this.root.hidden) return null;
    const live = this.time.mode === "live";
    let opening = false;
    let arriving = false; // what is held is still on its way
    let newest = null;
    for (const stream of this.chosenStreams()) {
      const type = await this.types.ask(stream);
      if (!type) continue;
      const answer = await this.askStream(stream, type, live, kPoints);
      opening ||= answer.status === "opening" || answer.status === "restarted";
      arriving ||= !live && answer.status === "arriving";
      if (answer.to && (newest === null || answer.to > newest)) newest = answer.to;
    }
    if (live && this.time.mode === "live" && newest !== null) {
      this.window = { from: newest - this.spanNs(), to: newest };
    }
    for (const panel of this.panels) this.draw(panel);
    this.drawCursor();
    if (opening) return kOpeningMs;
    if (arriving) return kArrivingMs;
    return live && this.panels.length > 0 ? 0 : null;
  }

  async askStream(stream, type, live, points) {
    const all = this.panels.flatMap((panel) => panel.signals);
    const names = [...new Set(all.filter((one) => one.stream === stream).map((one) => one.field))];
    const fields = names.filter((name) => findField(type, name));
    if (!live && !this.window) this.keepInWindow();
    if (!live && !this.window) return { status: "ok", curves: new Map() };
    const span = live
      ? { span_ns: String(this.spanNs()) }
      : { from_ns: String(this.window.from), to_ns: String(this.window.to) };
    const answer = {
      status: "ok",
      error: "",
      from: this.window?.from ?? null,
      to: null,
      curves: new Map(),
    };
    this.answers.set(stream, answer);
    if (fields.length === 0) {
      answer.error = `'${stream}' has no field '${names[0]}'`;
      return answer;
    }
    try {
      const binary = await this.connection.request("signals", {
        stream,
        fields,
        ...span,
        points,
      });
      const { head } = binary;
      Object.assign(answer, {
        status: head.status,
        error: head.error ?? "",
        lost: head.lost ?? 0,
        leftOut: head.left_out ?? 0,
        count: head.samples ?? 0,
        clockErrorS: head.clock_error_s ?? null,
      });
      if (head.from_ns) answer.from = BigInt(head.from_ns);
      if (head.to_ns) answer.to = BigInt(head.to_ns);
      for (const curve of head.curves ?? []) {
        answer.curves.set(curve.field, {
          times: binary.doubles(curve.times_at, curve.points),
          values: binary.doubles(curve.values_at, curve.points),
          tids: binary.doubles(curve.tids_at, curve.points),
        });
      }
    } catch (error) {
      if (!(error instanceof RequestError)) throw error;
      answer.status = "failed";
      answer.error = error.message;
    }
    return answer;
  }

  // --- drawing -----------------------------------------------------------------------------------

  draw(panel) {
    if (!panel.plot || !this.window) return;
    this.setEpoch(this.window.from);
    const tables = panel.signals.map((signal) => {
      const answer = this.answers.get(signal.stream);
      const curve = answer?.curves.get(signal.field);
      if (!curve) return [[], []];
      const start = this.toX(answer.from);
      // uPlot's null is a gap: there samples are missing.
      return [
        Array.from(curve.times, (time) => start + time),
        Array.from(curve.values, (value) => (Number.isNaN(value) ? null : value)),
      ];
    });
    panel.plot.setData(uPlot.join(tables));
    setText(panel.note, this.noteOf(panel));
    panel.element.dataset.points = String(
      tables.reduce((most, table) => Math.max(most, table[0].length), 0),
    );
  }

  noteOf(panel) {
    const notes = [];
    for (const stream of new Set(panel.signals.map((signal) => signal.stream))) {
      const answer = this.answers.get(stream);
      if (!answer) continue;
      // A window may begin before the oldest sample, and end after the newest one.
      const isUsual = ["ok", "too_old", "not_yet"].includes(answer.status);
      const isEmpty = [...answer.curves.values()].every((curve) => !this.isInWindow(answer, curve));
      if (answer.error) notes.push(answer.error);
      else if (!isUsual) notes.push(`${stream}: ${this.textOf(stream, answer.status)}`);
      else if (isEmpty) notes.push(`${stream}: no samples in this window`);
      if (answer.lost > 0) notes.push(`${stream}: ${answer.lost} samples lost in this window`);
      if (answer.leftOut > 0) {
        notes.push(`${stream}: ${answer.leftOut} samples more than are read at once; zoom in`);
      }
    }
    return notes.join("; ");
  }

  isInWindow(answer, curve) {
    const [from, to] = this.windowX();
    const start = this.toX(answer.from);
    return curve.times.some((time) => start + time >= from && start + time <= to);
  }

  // The samples at the shown instant, from the page's `at` request.
  showSamples(t, samples) {
    this.samples = samples;
    this.drawCursor();
    this.showValues();
  }

  showValues() {
    for (const panel of this.panels) {
      for (const [i, signal] of panel.signals.entries()) {
        const item = panel.legend.children[i];
        const sample = this.samples.get(signal.stream);
        const type = this.types.get(signal.stream);
        const found = type && findField(type, signal.field);
        const value =
          sample?.payload && found ? valueOf(sample.payload, found.field, found.index) : undefined;
        const reason = type && !found ? "no such field" : (sample?.text ?? "");
        setText(item.querySelector(".value"), value === undefined ? reason : number(value));
        setText(item.querySelector(".stale"), sample?.staleness ?? "");
        item.dataset.value = value === undefined ? "" : String(value);
        item.dataset.tid = sample?.tid ?? "";
        setText(item.querySelector(".tid"), sample?.payload && found ? `#${sample.tid}` : "");
      }
    }
  }

  // The instant in all panels, with the clock error of the panel's samples around it.
  drawCursor() {
    for (const panel of this.panels) this.drawCursorIn(panel);
  }

  drawCursorIn(panel) {
    const { plot, line, band } = panel;
    const t = this.time.instant();
    if (!line || this.epoch === null) return;
    const error = this.clockErrorOf(panel);
    panel.element.dataset.clockErrorNs = error === null ? "" : String(Math.round(error * 1e9));
    const inside = t !== null && this.window && t >= this.window.from && t <= this.window.to;
    line.hidden = !inside;
    band.hidden = !inside || error === null;
    if (!inside) return;
    const x = this.toX(t);
    line.style.left = `${plot.valToPos(x, "x")}px`;
    setText(line.firstElementChild, error ? `\u00b1${duration(error * 1e9)}` : "");
    line.classList.toggle("left", plot.valToPos(x, "x") > plot.over.clientWidth - kLabelPx);
    if (error === null) return;
    const left = plot.valToPos(x - error, "x");
    const right = plot.valToPos(x + error, "x");
    band.style.left = `${left}px`;
    band.style.width = `${right - left}px`;
  }

  clockErrorOf(panel) {
    const errors = panel.signals
      .map((signal) => this.samples.get(signal.stream)?.clockErrorNs)
      .filter((error) => error !== null && error !== undefined)
      .map(Number);
    return errors.length > 0 ? Math.max(...errors) / 1e9 : null;
  }

  // --- export ------------------------------------------------------------------------------------

  // All samples of the window, each stream's tid and fields in columns of their own.
  async exportCsv() {
    if (!this.window) return;
    const { from, to } = this.window;
    const rows = new Map(); // ns -> cells
    const columns = ["time_ns"];
    const notes = [];
    for (const stream of this.chosenStreams()) {
      const type = await this.types.ask(stream);
      if (!type) continue;
      const answer = await this.exportOf(stream, type);
      if (answer.leftOut > 0) notes.push(`not in the file: ${answer.leftOut} samples of ${stream}`);
      const tidColumn = columns.push(`${stream} tid`) - 1;
      for (const [field, curve] of answer.curves) {
        const column = columns.push(`${stream} ${field}`) - 1;
        for (let i = 0; i < curve.times.length; ++i) {
          const ns = answer.from + BigInt(Math.round(curve.times[i] * 1e9));
          const isThere = !Number.isNaN(curve.values[i]) && ns >= from && ns <= to;
          if (!isThere) continue;
          if (!rows.has(ns)) rows.set(ns, []);
          rows.get(ns)[tidColumn] = curve.tids[i];
          rows.get(ns)[column] = curve.values[i];
        }
      }
    }
    setText(this.root.querySelector("#export-note"), notes.join("; "));
    const quoted = (text) => (/[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
    const lines = [columns.map(quoted).join(",")];
    for (const [ns, cells] of [...rows].sort(([a], [b]) => (a < b ? -1 : 1))) {
      lines.push([ns, ...columns.slice(1).map((_, i) => cells[i + 1] ?? "")].join(","));
    }
    download(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }), this.fileName("csv"));
  }

  async exportOf(stream, type) {
    const shown = this.answers.get(stream);
    const answer = await this.askStream(stream, type, false, kExportPoints);
    if (shown) this.answers.set(stream, shown);
    return answer;
  }

  // The time of the values, and the panels below each other with their legends.
  async exportPng() {
    const panels = this.panels.filter((panel) => panel.plot);
    if (panels.length === 0) return;
    const ratio = devicePixelRatio;
    const legendHeight = 22;
    const titleHeight = 8 + legendHeight;
    const width = Math.max(...panels.map((panel) => panel.plot.width));
    const heights = panels.map((panel) => panel.plot.height + legendHeight + 8);
    const canvas = element("canvas", {
      width: Math.round(width * ratio),
      height: Math.round(heights.reduce((a, b) => a + b, titleHeight) * ratio),
    });
    const draw = canvas.getContext("2d");
    draw.scale(ratio, ratio);
    draw.fillStyle = cssColor("--surface");
    draw.fillRect(0, 0, width, canvas.height);
    draw.font = "12px system-ui, sans-serif";
    draw.textBaseline = "middle";
    draw.fillStyle = cssColor("--text-2");
    draw.fillText(this.shownTime(), 12, titleHeight / 2);
    let top = titleHeight;
    for (const [k, panel] of panels.entries()) {
      let left = 12;
      for (const [i, signal] of panel.signals.entries()) {
        const value = panel.legend.children[i].querySelector(".value").textContent;
        const text = `${nameOf(signal)}  ${value}`;
        draw.fillStyle = cssColor(`--c${i % kColors}`);
        draw.fillRect(left, top + legendHeight / 2 - 2, 12, 4);
        draw.fillStyle = cssColor("--text");
        draw.fillText(text, left + 18, top + legendHeight / 2);
        left += 18 + draw.measureText(text).width + 20;
      }
      draw.drawImage(
        panel.plot.ctx.canvas,
        0,
        top + legendHeight,
        panel.plot.width,
        panel.plot.height,
      );
      top += heights[k];
    }
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
    download(blob, this.fileName("png"));
  }

  // Of the values in the legends.
  shownTime() {
    const { shown } = this.time;
    return shown === null ? "" : `${day(shown)} ${timeOfDay(shown)}`;
  }

  fileName(ending) {
    const from = this.window ? timeOfDay(this.window.from, 0).replaceAll(":", "") : "";
    return `dssm-signals-${from}.${ending}`;
  }
}

// A plot without data has an axis, too: its edge is that of the others.
function rangeY(plot, least, greatest) {
  return least === null ? [0, 1] : uPlot.rangeNum(least, greatest, 0.1, true);
}

// Steps of the time axis in seconds.
const kIncrements = [];
for (let power = -9; power < 0; ++power) {
  for (const digit of [1, 2, 5]) kIncrements.push(digit * 10 ** power);
}
kIncrements.push(1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600);

function splitHost(stream) {
  const at = stream.lastIndexOf("@");
  return at < 0 ? [stream, ""] : [stream.slice(0, at), stream.slice(at)];
}

// The dialog in which a person chooses the signals of a panel.
class Picker {
  constructor(dialog, signals) {
    this.dialog = dialog;
    this.signals = signals;
    this.filter = dialog.querySelector("#picker-filter");
    this.list = dialog.querySelector("#picker-list");
    this.filter.addEventListener("input", () => this.show());
  }

  async open(panel) {
    this.panel = panel;
    this.filter.value = "";
    this.list.replaceChildren();
    if (!this.dialog.open) this.dialog.showModal();
    this.filter.focus();
    const { types } = this.signals;
    const streams = this.signals.streams().map((stream) => stream.stream);
    await Promise.all(streams.map((stream) => types.ask(stream)));
    await types.askAgain(streams);
    this.show();
  }

  show() {
    const words = this.filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const fits = (text) => words.every((word) => text.toLowerCase().includes(word));
    const groups = [];
    for (const stream of this.signals.streams()) {
      const type = this.signals.types.get(stream.stream);
      if (!type) continue;
      const all = signalsOf(type).filter((one) => fits(`${stream.stream} ${one.name}`));
      if (all.length === 0 && (words.length > 0 || type.fields.length > 0)) continue;
      groups.push(
        element(
          "fieldset",
          {},
          element("legend", {}, stream.stream),
          ...(all.length > 0
            ? all.map((one) => this.entry(stream.stream, one))
            : [
                element(
                  "p",
                  { class: "note" },
                  "Its type has no description, so its fields are not known.",
                ),
              ]),
        ),
      );
    }
    if (groups.length === 0) groups.push(element("p", { class: "empty" }, "Nothing fits."));
    this.list.replaceChildren(...groups);
  }

  entry(stream, one) {
    if (one.count) return this.arrayEntry(stream, one);
    return this.checkbox(stream, one.name);
  }

  checkbox(stream, field) {
    const signal = { stream, field };
    const checked = this.panel.signals.some((other) => nameOf(other) === nameOf(signal));
    return element(
      "label",
      {},
      element("input", {
        type: "checkbox",
        checked,
        onchange: (event) => this.signals.toggle(this.panel, signal, event.target.checked),
      }),
      field,
    );
  }

  // A long array: its elements that are in the panel, and a number for another one.
  arrayEntry(stream, one) {
    const chosen = this.panel.signals.filter(
      (signal) => signal.stream === stream && signal.field.startsWith(`${one.name}[`),
    );
    const index = element("input", {
      type: "number",
      min: 0,
      max: one.count - 1,
      value: 0,
      "aria-label": `Element of ${one.name}`,
    });
    const add = () => {
      const i = Math.min(one.count - 1, Math.max(0, Math.trunc(Number(index.value))));
      this.signals.toggle(this.panel, { stream, field: `${one.name}[${i}]` }, true);
      this.show();
    };
    return element(
      "div",
      {},
      ...chosen.map((signal) => this.checkbox(stream, signal.field)),
      element(
        "div",
        { class: "array" },
        `${one.name}[`,
        index,
        "]",
        element("button", { onclick: add }, "Add"),
      ),
    );
  }
}
