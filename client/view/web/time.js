// SPDX-License-Identifier: Apache-2.0
//
// The instant that the page shows: one for all plots and views. Times are BigInt, ns since 1970.
// Only times of samples are used: those of a recording that is played back are not the present.
//
//   live   the newest samples
//   hold   the samples at `t`
//   play   as hold, and `t` moves on (recordings only)
//
// While the pointer is over a plot, the instant below it is shown instead (`hover`).
import { setText, timeOfDay, day, duration } from "./format.js";

const kSpeeds = [0.1, 0.25, 0.5, 1, 2, 5, 10, 20];
const kShownPlaces = 3;

// Dispatches "change" when the instant to show has changed, and "mode" when the mode has.
export class Time extends EventTarget {
  constructor() {
    super();
    this.mode = "live";
    this.t = null; // null while live
    this.hover = null;
    this.shown = null; // of the newest answer
    this.range = null; // {oldest, newest}
    this.recording = false;
    this.speed = 1;
  }

  // The instant to ask for; null: the newest.
  instant() {
    return this.hover ?? this.t;
  }

  // What the rings hold, or the recording.
  setRange(range, recording) {
    this.range = range;
    if (recording && !this.recording) {
      this.recording = true;
      if (this.t === null && range) this.hold(range.oldest);
      else this.dispatchEvent(new Event("mode"));
    }
    this.dispatchEvent(new Event("range"));
  }

  live() {
    if (this.recording) return this.hold(this.range?.newest ?? this.t);
    this.set("live", null);
  }

  // Holds `t`, or what is shown now.
  hold(t = this.hover ?? this.shown ?? this.range?.newest ?? null) {
    if (t !== null) this.set("hold", t);
  }

  play() {
    if (!this.recording || !this.range) return;
    if (this.t === null || this.t >= this.range.newest) this.t = this.range.oldest;
    this.set("play", this.t);
    let before = performance.now();
    const step = (at) => {
      if (this.mode !== "play") return;
      const passed = Math.max(0, at - before);
      before = at;
      const t = this.t + BigInt(Math.round(passed * 1e6 * this.speed));
      if (t >= this.range.newest) return this.hold(this.range.newest);
      this.t = t;
      this.dispatchEvent(new Event("change"));
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  toggle() {
    if (this.mode === "play") this.hold(this.t);
    else if (this.recording) this.play();
    else if (this.mode === "live") this.hold();
    else this.live();
  }

  setHover(t) {
    if (this.hover === t) return;
    this.hover = t;
    this.dispatchEvent(new Event("change"));
  }

  setShown(t) {
    this.shown = t;
    this.dispatchEvent(new Event("shown"));
  }

  set(mode, t) {
    const changed = mode !== this.mode;
    this.mode = mode;
    this.t = t;
    if (changed) this.dispatchEvent(new Event("mode"));
    this.dispatchEvent(new Event("change"));
  }
}

// The bar at the bottom of the page.
export class TimeBar {
  // step: called with -1 or 1 by the buttons
  constructor(root, time, step) {
    this.root = root;
    this.time = time;
    const find = (id) => root.querySelector(`#${id}`);
    this.slider = find("slider");
    this.live = find("live");
    this.hold = find("hold");
    this.play = find("play");
    this.speed = find("speed");
    this.speedLabel = find("speed-label");
    this.oldest = find("oldest");
    this.shown = find("shown-t");
    for (const speed of kSpeeds) {
      this.speed.add(new Option(`\u00d7${speed}`, speed, speed === 1, speed === 1));
    }
    this.live.addEventListener("click", () => time.live());
    this.hold.addEventListener("click", () => time.hold());
    this.play.addEventListener("click", () => time.toggle());
    this.speed.addEventListener("change", () => (time.speed = Number(this.speed.value)));
    find("step-back").addEventListener("click", () => step(-1));
    find("step-forward").addEventListener("click", () => step(1));
    this.slider.addEventListener("input", () => {
      if (!time.range) return;
      time.hover = null;
      time.hold(time.range.oldest + BigInt(Math.round(Number(this.slider.value))));
    });
    for (const event of ["mode", "range", "shown", "change"]) {
      time.addEventListener(event, () => this.update());
    }
    this.update();
  }

  update() {
    const { time } = this;
    this.root.dataset.mode = time.mode;
    this.root.dataset.tNs = time.t ?? "";
    this.live.hidden = this.hold.hidden = time.recording;
    this.play.hidden = this.speedLabel.hidden = !time.recording;
    this.live.setAttribute("aria-pressed", String(time.mode === "live"));
    this.hold.setAttribute("aria-pressed", String(time.mode === "hold"));
    this.play.setAttribute("aria-pressed", String(time.mode === "play"));
    setText(this.play, time.mode === "play" ? "Pause" : "Play");
    this.slider.disabled = !time.range;
    if (time.range) this.updateSlider();
    const shown = time.shown;
    if (shown === null) return;
    this.shown.dataset.tNs = String(shown);
    const reference = time.recording ? time.range?.oldest : time.range?.newest;
    const distance = reference === undefined ? 0n : shown - reference;
    const sign = distance < 0n ? "\u2212" : "+";
    const seconds = `${sign}${(Math.abs(Number(distance)) / 1e9).toFixed(3)} s`;
    const text = timeOfDay(shown, kShownPlaces);
    setText(this.shown, time.mode === "live" && time.hover === null ? text : `${text}  ${seconds}`);
    this.shown.title = `${day(shown)} ${timeOfDay(shown, 9)} (${shown} ns)`;
  }

  updateSlider() {
    const { oldest, newest } = this.time.range;
    const end = newest > oldest ? newest : oldest + 1n;
    this.root.dataset.oldestNs = String(oldest);
    this.slider.max = String(end - oldest);
    const t = this.time.t ?? end;
    this.slider.value = String(t - oldest);
    this.slider.setAttribute("aria-valuetext", timeOfDay(t));
    const length = duration(end - oldest);
    setText(this.oldest, this.time.recording ? length : `\u2212${length}`);
    this.oldest.title = this.time.recording
      ? "The length of the recording"
      : `The rings hold samples from ${timeOfDay(oldest)} to ${timeOfDay(newest)}`;
  }
}
