// SPDX-License-Identifier: Apache-2.0
//
// The instant that the page shows: one for all plots and views. Times are BigInt, ns since 1970.
// Only times of samples are used: those of a recording that is played back are not the present.
//
//   live   the newest samples; not of a recording
//   hold   the samples at `t`
//   play   the same, and `t` goes on, `rate` times as fast as time does, up to the newest sample
//
// While the pointer is over a plot, the instant below it is shown instead (`hover`).
import { setText, timeOfDay, day, duration } from "./format.js";

const kShownPlaces = 3;
const kPlayMs = 40;
const kRates = [0.1, 0.5, 1, 2, 5, 10, 50];

// Dispatches "change" when the instant to show has changed, and "mode" when the mode has.
export class Time extends EventTarget {
  // beginning: returns the instant from which on there are samples, if there is a range
  constructor(beginning) {
    super();
    this.beginning = beginning;
    this.mode = "live";
    this.t = null; // null while live
    this.hover = null;
    this.shown = null; // of the newest answer
    this.range = null; // {oldest, newest}
    this.recorded = false; // a recording is shown
    this.rate = 1;
    this.timer = null; // while playing
  }

  // The instant to ask for; null: the newest.
  instant() {
    return this.hover ?? this.t;
  }

  // What the rings or the recording hold.
  setRange(range, recorded) {
    this.range = range;
    this.recorded = recorded;
    if (recorded && range && this.mode === "live") this.hold(range.oldest);
    this.dispatchEvent(new Event("range"));
  }

  // Of a recording: its end.
  live() {
    if (this.recorded) this.hold(this.range?.newest ?? null);
    else this.set("live", null);
  }

  // Holds `t`, or what is shown now.
  hold(t = this.hover ?? this.shown ?? this.range?.newest ?? null) {
    if (t !== null) this.set("hold", t);
  }

  // Goes on from the shown instant; from the oldest when that is the newest.
  play() {
    if (!this.range) return;
    const { oldest, newest } = this.range;
    const from = this.t ?? this.shown ?? oldest;
    this.hover = null;
    this.set("play", from >= newest || from < oldest ? this.beginning() : from);
    let last = performance.now();
    clearInterval(this.timer);
    this.timer = setInterval(() => {
      const now = performance.now();
      const t = this.t + BigInt(Math.round((now - last) * 1e6 * this.rate));
      last = now;
      if (t >= this.range.newest) this.hold(this.range.newest);
      else this.set("play", t);
    }, kPlayMs);
  }

  toggle() {
    if (this.mode !== "hold") this.hold();
    else if (this.recorded) this.play();
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
    if (mode !== "play") clearInterval(this.timer);
    this.mode = mode;
    this.t = t;
    if (changed) this.dispatchEvent(new Event("mode"));
    this.dispatchEvent(new Event("change"));
  }
}

// The bar at the bottom of the page.
export class TimeBar {
  // step: called with -1 or 1 by the buttons; save: by its button
  constructor(root, time, { step, save }) {
    this.root = root;
    this.time = time;
    const find = (id) => root.querySelector(`#${id}`);
    this.slider = find("slider");
    this.live = find("live");
    this.hold = find("hold");
    this.play = find("play");
    this.rate = find("rate");
    this.oldest = find("oldest");
    this.shown = find("shown-t");
    this.live.addEventListener("click", () => time.live());
    this.hold.addEventListener("click", () => time.hold());
    this.play.addEventListener("click", () => time.play());
    for (const rate of kRates) this.rate.add(new Option(`${rate}\u00d7`, rate));
    this.rate.value = "1";
    this.rate.addEventListener("change", () => (time.rate = Number(this.rate.value)));
    find("step-back").addEventListener("click", () => step(-1));
    find("step-forward").addEventListener("click", () => step(1));
    this.save = find("save");
    this.save.addEventListener("click", save);
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
    this.live.setAttribute("aria-pressed", String(time.mode === "live"));
    this.live.hidden = this.save.hidden = time.recorded;
    this.hold.setAttribute("aria-pressed", String(time.mode === "hold"));
    this.play.setAttribute("aria-pressed", String(time.mode === "play"));
    this.play.disabled = !time.range;
    this.slider.disabled = !time.range;
    if (time.range) this.updateSlider();
    const shown = time.shown;
    if (shown === null) return;
    this.shown.dataset.tNs = String(shown);
    const distance = time.range ? shown - time.range.newest : 0n;
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
    setText(this.oldest, `\u2212${length}`);
    const holder = this.time.recorded ? "The recording holds" : "The rings hold";
    this.oldest.title = `${holder} samples from ${timeOfDay(oldest)} to ${timeOfDay(newest)}`;
  }
}
