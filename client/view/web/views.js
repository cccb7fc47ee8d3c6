// SPDX-License-Identifier: Apache-2.0
//
// Views: one card for each stream shown. A card draws the stream's sample at the shown instant, as
// the kind of view that a person chose or that fits the type.
import { Pump, RequestError } from "./connection.js";
import { guessKind, imageOf, poseOf, scanOf } from "./fields.js";
import { duration, element, kClockErrorHint, setText, timeOfDay, wholeDuration } from "./format.js";
import { HexView, ImageView, PlaneView, PropertyView, TableView } from "./drawings.js";

const kSuggested = 6; // cards that are shown before a person has chosen
const kKinds = { scan: "Scan", pose: "Pose", image: "Image", table: "Table", hex: "Hex", property: "Property" };
const kAuto = "auto"; // a choice; streams have a host in their names
const kTrailPeriodMs = 500;
const kPropertyPeriodMs = 2000;
const kOpeningMs = 100;
const kTrailPoints = 2000;
const kTrailSpans = [0, 10, 30, 60, 300, 3600]; // seconds
const kDefaultTrail = 60;
// A sample with these states may be here in a moment: then the drawing stays so long, and does not
// flicker.
const kPassing = new Set(["opening", "arriving", "restarted", "lapped"]);
const kPassingMs = 300;

// Dispatches "change" when what is chosen has changed.
export class Views extends EventTarget {
  // types: the known types of streams; streams: returns those of the last overview
  constructor(root, { connection, time, types, streams }) {
    super();
    Object.assign(this, { root, connection, time, types, streams });
    this.cards = [];
    this.box = root.querySelector("#cards");
    this.adder = root.querySelector("#add-view");
    this.adder.addEventListener("change", () => {
      if (this.adder.value) this.add({ stream: this.adder.value });
      this.adder.value = "";
      this.changed();
    });
    this.pump = new Pump(connection, kTrailPeriodMs, () => this.askMore());
    time.addEventListener("change", () => time.mode !== "live" && this.pump.wake());
    time.addEventListener("mode", () => this.pump.wake());
  }

  get state() {
    return this.cards.map((card) => card.state);
  }

  // As from `state`; anything that does not fit is left out.
  set state(cards) {
    if (!Array.isArray(cards)) return;
    for (const card of [...this.cards]) this.remove(card);
    for (const one of cards) if (typeof one?.stream === "string") this.add(one);
  }

  chosenStreams() {
    return [...new Set(this.cards.flatMap((card) => card.chosenStreams()))];
  }

  // The stream by whose samples the arrow keys step: of the card in focus, or of the first one.
  stepStream() {
    const focused = this.cards.find((card) => card.element.contains(document.activeElement));
    return (focused ?? this.cards[0])?.stream ?? null;
  }

  async suggest() {
    if (this.cards.length > 0 || this.suggested) return;
    const streams = this.streams();
    if (streams.length === 0) return;
    this.suggested = true;
    const order = ["scan", "pose", "image", "table", "hex"];
    const kinds = new Map();
    for (const stream of streams) {
      const type = await this.types.ask(stream.stream);
      kinds.set(stream.stream, type ? guessKind(type) : "hex");
    }
    const sorted = [...kinds].sort(([, a], [, b]) => order.indexOf(a) - order.indexOf(b));
    for (const [stream] of sorted.slice(0, kSuggested)) this.add({ stream });
    this.time.dispatchEvent(new Event("change"));
  }

  add(state) {
    const card = new Card(this, state);
    this.cards.push(card);
    this.box.append(card.element);
    card.prepare();
    return card;
  }

  remove(card) {
    card.element.remove();
    card.drawing?.close?.();
    this.cards = this.cards.filter((other) => other !== card);
  }

  changed() {
    this.dispatchEvent(new Event("change"));
    this.wake();
  }

  // Other streams are shown.
  wake() {
    this.time.dispatchEvent(new Event("change"));
    this.pump.wake();
  }

  open() {
    this.suggest();
    for (const card of this.cards) card.drawing?.resize?.();
    this.pump.wake();
  }

  showStreams() {
    const names = this.streams().map((stream) => stream.stream);
    // A stream was recreated, or its type could not be had.
    for (const card of this.cards) {
      if (!card.type || this.types.get(card.stream) !== card.type) card.prepare();
    }
    const key = JSON.stringify(names);
    if (key === this.names) return;
    this.names = key;
    this.adder.replaceChildren(
      new Option("\u2026", ""),
      ...names.map((name) => new Option(name, name)),
    );
    if (!this.root.hidden) this.suggest();
    for (const card of this.cards) card.prepare();
  }

  showSamples(t, samples) {
    for (const card of this.cards) card.show(t, samples);
  }

  restyle() {
    for (const card of this.cards) card.drawing?.redraw?.();
  }

  // What cards show besides the samples of the shown instant.
  async askMore() {
    if (this.root.hidden) return null;
    let opening = false;
    for (const card of this.cards) {
      await card.askProperty();
      opening = (await card.askTrail()) || opening;
    }
    if (opening) return kOpeningMs;
    return this.time.mode === "hold" ? null : kTrailPeriodMs;
  }
}

class Card {
  constructor(views, { stream, kind, place, trail }) {
    this.views = views;
    this.stream = stream;
    this.kind = kind in kKinds ? kind : null; // null: what fits
    // The stream of poses for a scan; "" for none, null for the one that fits.
    this.chosenPlace = typeof place === "string" ? place : null;
    this.fittingPlace = "";
    this.trailS = kTrailSpans.includes(trail) ? trail : kDefaultTrail;
    this.trail = null;
    this.propertyAt = -Infinity; // when it was asked for
    this.drawing = null;
    this.drawnAt = -Infinity; // ms, of performance.now(), when it showed its last sample
    this.make();
  }

  get state() {
    const state = { stream: this.stream };
    if (this.kind) state.kind = this.kind;
    if (this.chosenPlace !== null) state.place = this.chosenPlace;
    if (this.trailS !== kDefaultTrail) state.trail = this.trailS;
    return state;
  }

  make() {
    const at = this.stream.lastIndexOf("@");
    const name = at < 0 ? this.stream : this.stream.slice(0, at);
    const changed = () => {
      this.rebuild();
      this.views.changed();
    };
    this.kindBox = element("select", {
      "aria-label": `Kind of view of ${this.stream}`,
      onchange: () => {
        this.kind = this.kindBox.value || null;
        changed();
      },
    });
    this.placeBox = element("select", {
      "aria-label": `Pose that places ${this.stream}`,
      onchange: () => {
        const { value } = this.placeBox;
        this.chosenPlace = value === kAuto ? null : value;
        changed();
      },
    });
    this.placeLabel = element("label", { hidden: true }, "placed by ", this.placeBox);
    this.trailBox = element("select", {
      onchange: () => {
        this.trailS = Number(this.trailBox.value);
        this.trail = null;
        changed();
      },
    });
    for (const span of kTrailSpans) {
      const text = span === 0 ? "none" : wholeDuration(span);
      this.trailBox.add(new Option(text, span, span === this.trailS, span === this.trailS));
    }
    this.trailLabel = element("label", { hidden: true }, "trail ", this.trailBox);
    this.body = element("div", { class: "drawing" });
    this.absence = element("p", { class: "absence", role: "status" });
    this.note = element("p", { class: "status", role: "status" });
    this.foot = {};
    for (const key of ["tid", "time", "age", "error", "stale"])
      this.foot[key] = element("span", { class: key });
    this.foot.error.title = kClockErrorHint;
    this.element = element(
      "article",
      { class: "card", tabindex: "0", "data-stream": this.stream, "aria-label": this.stream },
      element(
        "header",
        {},
        element(
          "h3",
          {},
          name.replace(/:0$/, ""),
          element("span", { class: "at" }, at < 0 ? "" : this.stream.slice(at)),
        ),
        element("div", { class: "options" }, this.placeLabel, this.trailLabel, this.kindBox),
        element(
          "button",
          {
            class: "quiet",
            title: "Remove this view",
            "aria-label": `Remove ${this.stream}`,
            onclick: () => {
              this.views.remove(this);
              this.views.changed();
            },
          },
          "\u00d7",
        ),
      ),
      element("div", { class: "stage" }, this.body, this.absence),
      this.note,
      element("footer", {}, ...Object.values(this.foot)),
    );
  }

  get place() {
    return this.chosenPlace ?? this.fittingPlace;
  }

  // Asks for the types that it needs, then builds the drawing.
  async prepare() {
    const type = await this.views.types.ask(this.stream);
    if (this.place) await this.views.types.ask(this.place);
    if (type !== this.type) {
      this.type = type;
      this.rebuild();
    }
    if (type && scanOf(type)) {
      for (const stream of this.views.streams()) await this.views.types.ask(stream.stream);
      const before = this.place;
      this.showPlaces();
      if (this.place !== before) this.views.wake();
    }
  }

  // What was chosen may not fit the type, which may have changed since.
  shownKind() {
    if (!this.type) return "hex";
    return this.possibleKinds().includes(this.kind) ? this.kind : guessKind(this.type);
  }

  rebuild() {
    this.drawing?.close?.();
    this.drawing = null;
    this.propertyAt = -Infinity;
    if (!this.type) return;
    const guessed = guessKind(this.type);
    this.kindBox.replaceChildren(
      new Option(`Auto: ${kKinds[guessed]}`, ""),
      ...this.possibleKinds()
        .filter((kind) => kind !== guessed)
        .map((kind) => new Option(kKinds[kind], kind)),
    );
    if (this.kind === guessed) this.kind = null;
    const kind = this.shownKind();
    this.kindBox.value = kind === guessed ? "" : kind;
    this.element.dataset.kind = kind;
    this.showPlaces();
    const makers = {
      scan: () => new PlaneView(this.body),
      pose: () => new PlaneView(this.body),
      image: () => new ImageView(this.body, this.type, imageOf(this.type)),
      table: () => new TableView(this.body, this.type),
      hex: () => new HexView(this.body),
      property: () => new PropertyView(this.body),
    };
    this.body.replaceChildren();
    this.drawing = makers[kind]();
    if (kind === "property") this.views.pump.wake();
    if (this.samples) this.show(this.t, this.samples);
  }

  possibleKinds() {
    const kinds = [];
    if (scanOf(this.type)) kinds.push("scan");
    if (poseOf(this.type)) kinds.push("pose");
    if (imageOf(this.type) || this.isJpeg) kinds.push("image");
    if (this.type.fields.length > 0) kinds.push("table");
    kinds.push("hex", "property");
    return kinds;
  }

  showPlaces() {
    const poses = this.views
      .streams()
      .map((stream) => stream.stream)
      .filter((stream) => {
        const type = this.views.types.get(stream);
        return type && poseOf(type)?.theta;
      });
    this.fittingPlace = this.fittingOf(poses);
    if (this.place && !poses.includes(this.place)) poses.push(this.place);
    this.placeBox.replaceChildren(
      new Option(`Auto: ${this.fittingPlace || "nothing"}`, kAuto),
      new Option("nothing", ""),
      ...poses.map((name) => new Option(name, name)),
    );
    this.placeBox.value = this.chosenPlace ?? kAuto;
    this.placeLabel.hidden = this.shownKind() !== "scan" || poses.length === 0;
    this.trailLabel.hidden = !this.poseStream();
  }

  // The only stream of poses of the scan's host, else the only one of all.
  fittingOf(poses) {
    const hostOf = (stream) => stream.slice(stream.lastIndexOf("@"));
    const near = poses.filter((stream) => hostOf(stream) === hostOf(this.stream));
    const candidates = near.length > 0 ? near : poses;
    return candidates.length === 1 ? candidates[0] : "";
  }

  // The stream of poses that this card draws; null for none.
  poseStream() {
    const kind = this.shownKind();
    return kind === "pose" ? this.stream : kind === "scan" ? this.place || null : null;
  }

  chosenStreams() {
    return this.place && this.shownKind() === "scan" ? [this.stream, this.place] : [this.stream];
  }

  // --- the sample at the shown instant -----------------------------------------------------------

  show(t, samples) {
    this.t = t;
    this.samples = samples;
    const sample = samples.get(this.stream);
    if (!sample) return;
    this.element.dataset.status = sample.status;
    this.element.dataset.stale = sample.staleness;
    this.showFoot(t, sample);
    if (!sample.payload) {
      this.showAbsence(sample);
      return;
    }
    this.drawnAt = performance.now();
    this.setAbsence("");
    // What a JPEG is, its type need not say.
    const isJpeg =
      !this.isJpeg &&
      this.type?.fields.length === 0 &&
      sample.payload.byteLength > 3 &&
      sample.payload.getUint16(0) === 0xffd8 &&
      sample.payload.getUint8(2) === 0xff;
    if (isJpeg) {
      this.isJpeg = true;
      this.kind ??= "image";
      this.rebuild();
      return;
    }
    if (!this.drawing) return;
    try {
      this.draw(sample, samples);
    } catch (error) {
      this.setAbsence(`This view does not fit the sample: ${error.message}`);
      setText(this.note, "");
    }
  }

  // Instead of the sample of another instant.
  showAbsence(sample) {
    const isPassing = kPassing.has(sample.status) && performance.now() - this.drawnAt < kPassingMs;
    if (isPassing) return;
    const text = sample.error || sample.text;
    // A stream without samples may have a property.
    const isProperty = this.shownKind() === "property";
    this.setAbsence(isProperty ? "" : text);
    setText(this.note, isProperty ? text : "");
  }

  setAbsence(text) {
    setText(this.absence, text);
    if (text !== "" && !this.body.inert) this.drawing?.empty?.();
    this.body.inert = text !== "";
  }

  draw(sample, samples) {
    const kind = this.shownKind();
    if (kind === "property") return;
    const note = (text) => setText(this.note, text);
    if (kind === "scan" || kind === "pose") {
      const poseSample = samples.get(this.poseStream());
      const poseType = this.views.types.get(this.poseStream());
      const fields = poseType && poseOf(poseType);
      const pose =
        poseSample?.payload && fields ? this.drawing.readPose(poseSample.payload, fields) : null;
      const scan =
        kind === "scan" ? this.drawing.readScan(sample.payload, scanOf(this.type)) : null;
      const missing = kind === "scan" && this.place && !pose;
      const reason =
        poseType && !fields ? "its type has no fields of a pose" : (poseSample?.text ?? "no pose");
      note(missing ? `${this.place}: ${reason}; the scan is not placed` : (scan?.note ?? ""));
      const trail = pose ? this.trailUntil(poseSample) : null;
      const isHeld = this.views.time.t !== null;
      if (pose && isHeld && this.trail?.toNs !== poseSample.timeNs) this.views.pump.wake();
      this.element.dataset.trailPoints = String(trail?.x.length ?? 0);
      this.drawing.show({ scan, pose, trail });
    } else {
      note("");
      this.drawing.show(sample, (text) => note(text));
    }
  }

  showFoot(t, sample) {
    const { foot } = this;
    this.element.dataset.tid = sample.tid ?? "";
    this.element.dataset.timeNs = sample.timeNs === null ? "" : String(sample.timeNs);
    setText(foot.stale, sample.staleness);
    setText(foot.tid, sample.tid === null ? "" : `tid ${sample.tid}`);
    setText(foot.time, sample.timeNs === null ? "" : timeOfDay(sample.timeNs));
    const age = sample.timeNs === null ? 0n : t - sample.timeNs;
    const distance = duration(age < 0n ? -age : age);
    setText(foot.age, age === 0n ? "" : `${distance} ${age < 0n ? "after" : "before"}`);
    foot.age.title = "Of the shown instant";
    setText(
      foot.error,
      sample.clockErrorNs === null ? "" : `\u00b1${duration(sample.clockErrorNs)}`,
    );
  }

  // --- the property ------------------------------------------------------------------------------

  async askProperty() {
    const { time, connection } = this.views;
    const isOld = performance.now() - this.propertyAt > kPropertyPeriodMs;
    const isDue = time.t !== this.propertyT || isOld;
    if (this.shownKind() !== "property" || !this.drawing || !isDue) return;
    this.propertyAt = performance.now();
    this.propertyT = time.t;
    const { drawing } = this;
    try {
      const answer = await connection.request("property", {
        stream: this.stream,
        t_ns: time.t === null ? null : String(time.t),
      });
      if (drawing !== this.drawing) return;
      const { property_at: at, property_bytes: size } = answer.head;
      drawing.show({ payload: answer.bytes(at, size) });
      setText(this.note, "");
    } catch (error) {
      if (!(error instanceof RequestError)) throw error;
      if (drawing === this.drawing) drawing.clear();
      setText(this.note, error.message);
    }
  }

  // --- the trail ---------------------------------------------------------------------------------

  // The trail up to the shown pose.
  trailUntil(sample) {
    if (!this.trail || this.trailS === 0) return null;
    const { from, times, x, y } = this.trail;
    const end = Number(sample.timeNs - from) / 1e9;
    let count = times.length;
    while (count > 0 && times[count - 1] > end) --count;
    let first = 0; // an answer has a sample before its range, too
    while (first < count && times[first] < end - this.trailS) ++first;
    return { x: x.subarray(first, count), y: y.subarray(first, count) };
  }

  // Returns whether the stream is being opened.
  async askTrail() {
    const stream = this.poseStream();
    const type = stream && this.views.types.get(stream);
    const pose = type && poseOf(type);
    if (!pose || this.trailS === 0) return false;
    const { time } = this.views;
    const spanNs = BigInt(this.trailS) * 1000000000n;
    // The poses may have ended long before the held instant.
    const toNs = time.t === null ? null : (this.samples?.get(stream)?.timeNs ?? time.t);
    const span =
      toNs === null
        ? { span_ns: String(spanNs) }
        : { from_ns: String(toNs - spanNs), to_ns: String(toNs + 1n) };
    try {
      const answer = await this.views.connection.request("signals", {
        stream,
        fields: [pose.x.name, pose.y.name],
        ...span,
        points: kTrailPoints,
      });
      if (answer.head.status === "opening") return true;
      const [x, y] = answer.head.curves ?? [];
      if (!x || !y) return false;
      const from = BigInt(answer.head.from_ns ?? span.from_ns);
      const joined = joinTrail(
        from,
        answer.doubles(x.times_at, x.points),
        answer.doubles(x.values_at, x.points),
        answer.doubles(y.times_at, y.points),
        answer.doubles(y.values_at, y.points),
      );
      this.trail = { ...joined, toNs };
      if (this.samples) this.show(this.t, this.samples);
    } catch (error) {
      if (!(error instanceof RequestError)) throw error;
      setText(this.note, error.message);
    }
    return false;
  }
}

// x and y at the times of x. With more samples than points, the server chooses other samples for
// each field; y is then interpolated.
function joinTrail(from, xTimes, x, yTimes, y) {
  const joined = new Float64Array(xTimes.length);
  let k = 0;
  for (let i = 0; i < xTimes.length; ++i) {
    while (k + 1 < yTimes.length && yTimes[k + 1] <= xTimes[i]) ++k;
    const next = Math.min(k + 1, yTimes.length - 1);
    const span = yTimes[next] - yTimes[k];
    const share = span > 0 ? Math.min(1, Math.max(0, (xTimes[i] - yTimes[k]) / span)) : 0;
    joined[i] = share === 0 ? y[k] : y[k] + share * (y[next] - y[k]);
  }
  return { from, times: xTimes, x, y: joined };
}
