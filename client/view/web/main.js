// SPDX-License-Identifier: Apache-2.0
//
// The page of dssm-view. This file connects its parts: the connection, the shown instant, the three
// pages, the keys, and the state in the URL's fragment.
import { Connection, LostError, Pump, RequestError } from "./connection.js";
import { duration, setText, timeOfDay } from "./format.js";
import { Overview } from "./overview.js";
import { SaveDialog } from "./save.js";
import { Signals } from "./signals.js";
import { Time, TimeBar } from "./time.js";
import { Views } from "./views.js";

const kOverviewMs = 200; // the answer comes when there is a new state, about each second
const kFailedMs = 1000;
const kAtMs = 50;
const kOpeningMs = 100;
const kArrivingMs = 200; // the sample of a held instant could not be read yet
const kUrlMs = 300;
const kTypeRetryMs = 2000;
const kStepMs = 100; // where no stream is shown
const kMaxMarginNs = 1000000000n; // from the oldest sample of a ring that is being written
const kMaxSteps = 12; // requests for one step
// Statuses of a stream that has a sample at an instant, or may have one.
const kMayHaveOne = ["ok", "opening", "arriving", "lapped", "restarted"];

const find = (id) => document.getElementById(id);
const scheme = location.protocol === "https:" ? "wss" : "ws";
const connection = new Connection(`${scheme}://${location.host}/`);
const time = new Time(beginning);
const kFirstView = "first view"; // a mark for measurements: hosts are shown
let overview = null; // the last answer
let overviewAt = 0; // ms, of performance.now(), when it came

// --- types of streams ----------------------------------------------------------------------------

// The types that were asked for. A recreated stream may have another one.
class Types {
  constructor() {
    this.known = new Map(); // stream -> {type, incarnation, askedAt, failedAt, promise}
  }

  get(stream) {
    return this.known.get(stream)?.type ?? null;
  }

  // Null when it cannot be had.
  ask(stream) {
    const entry = this.known.get(stream);
    if (entry && (entry.type || performance.now() - entry.failedAt < kTypeRetryMs))
      return entry.promise;
    const made = {
      type: null,
      askedAt: performance.now(),
      failedAt: Infinity,
      incarnation: incarnationOf(stream),
    };
    this.known.set(stream, made);
    made.promise = this.request(stream).then(
      (answer) => {
        // Not the overview's, which may be older or newer.
        made.incarnation = answer.incarnation ?? made.incarnation;
        made.type = typeOf(answer);
        return made.type;
      },
      (error) => {
        if (!(error instanceof RequestError || error instanceof LostError)) throw error;
        made.failedAt = error instanceof LostError ? -Infinity : performance.now();
        return null;
      },
    );
    return made.promise;
  }

  async request(stream) {
    for (;;) {
      const answer = await connection.request("type", { stream });
      if (answer.status !== "opening") return answer;
      await new Promise((resolve) => setTimeout(resolve, kOpeningMs));
    }
  }

  // Asks again for the fields of those of these streams that have none: `dssmctl describe` may give
  // them some, or a program that opens the stream.
  async askAgain(streams) {
    const now = performance.now();
    const isDue = ({ type, askedAt }) =>
      !time.recorded && type?.fields.length === 0 && now - askedAt > kTypeRetryMs;
    const entries = streams.map((stream) => [stream, this.known.get(stream)]);
    const asked = entries.map(async ([stream, entry]) => {
      if (!entry || !isDue(entry)) return;
      entry.askedAt = now;
      const type = typeOf(await this.request(stream));
      if (type.fields.length === 0) return;
      entry.type = type;
      entry.promise = Promise.resolve(type);
    });
    try {
      await Promise.all(asked);
    } catch (error) {
      if (!(error instanceof RequestError || error instanceof LostError)) throw error;
    }
  }

  forgetRecreated() {
    for (const [stream, { incarnation }] of this.known) {
      const now = incarnationOf(stream);
      if (now !== null && now !== incarnation) this.known.delete(stream);
    }
  }
}

function typeOf({ fields, payload_bytes, name }) {
  return { fields: fields ?? [], payload_bytes, name };
}

function incarnationOf(stream) {
  return streams().find((one) => one.stream === stream)?.incarnation ?? null;
}

function streams() {
  return overview?.streams ?? [];
}

// When the oldest sample of a stream is from that is still there in a moment: a full ring loses its
// oldest samples while it is written. Null for none.
function oldestOf(stream) {
  if (!stream?.oldest_ns) return null;
  const oldest = BigInt(stream.oldest_ns);
  if (stream.state !== "live" || stream.oldest_tid === 0) return oldest;
  const sinceNs = BigInt(Math.round((performance.now() - overviewAt) * 1e6));
  return oldest + sinceNs + marginOf(BigInt(stream.newest_ns) - oldest);
}

function marginOf(lengthNs) {
  const part = lengthNs / 10n;
  return part < kMaxMarginNs ? part : kMaxMarginNs;
}

// The oldest instant at which a stream that is shown has a sample. A recording is shown from its
// beginning on.
function beginning() {
  const { range } = time;
  let first = null;
  for (const stream of time.recorded ? [] : streams()) {
    if (!page()?.chosenStreams().includes(stream.stream)) continue;
    const oldest = oldestOf(stream);
    const isInRange = oldest !== null && oldest >= range.oldest && oldest <= range.newest;
    if (isInRange && (first === null || oldest < first)) first = oldest;
  }
  return first ?? range.oldest;
}

// Nothing that is shown has a sample at the instant that is played: the rings begin later, or lose
// their samples as fast as they are played here, or faster. Goes on where they have some.
function playOn() {
  if (time.recorded || !time.range) return;
  const first = beginning();
  time.set("play", first > time.t ? first : time.t + marginOf(time.range.newest - time.t));
}

// "host pc2 is down"; empty for a host that answers.
function outageOf(stream) {
  const name = stream.slice(stream.lastIndexOf("@") + 1);
  const state = overview?.hosts.find((host) => host.host === name)?.state ?? "up";
  return state === "up" || state === "self" ? "" : `host ${name} is ${state}`;
}

// Why the newest sample of a stream is old; empty if it need not be.
function stalenessOf(stream) {
  const state = streams().find((one) => one.stream === stream)?.state;
  return outageOf(stream) || (state === "stalled" || state === "no writer" ? state : "");
}

// What people read where there is no sample with that status.
function textOf(stream, status) {
  const t = time.instant();
  const oldest = streams().find((one) => one.stream === stream)?.oldest_ns;
  const outage = outageOf(stream);
  if (outage && (status === "arriving" || status === "not_yet")) return outage;
  if (status === "too_old" && t !== null && oldest && BigInt(oldest) > t) {
    return `${time.recorded ? "begins" : "the ring begins"} ${duration(BigInt(oldest) - t)} later`;
  }
  return status.replaceAll("_", " ");
}

// --- the pages -----------------------------------------------------------------------------------

const types = new Types();
const parts = { connection, time, types, streams, textOf };
const signals = new Signals(find("signals"), parts);
const views = new Views(find("views"), parts);
const overviewPage = new Overview(find("overview"), (stream) => {
  if (!views.chosenStreams().includes(stream)) views.add({ stream });
  views.changed();
  showTab("views");
});
const saveDialog = new SaveDialog(find("save-dialog"), { connection, time, signals, page });
new TimeBar(find("time"), time, { step, save: () => saveDialog.open() });

const kTabs = ["overview", "signals", "views"];
let tab = "overview";

function showTab(name) {
  tab = name;
  for (const one of kTabs) {
    find(one).hidden = one !== name;
    const button = find(`tab-${one}`);
    button.setAttribute("aria-selected", String(one === name));
    button.tabIndex = one === name ? 0 : -1;
  }
  find("time").hidden = name === "overview";
  time.hover = null;
  if (name === "overview") overviewPage.drawGraph();
  else page().open();
  atPump.wake();
  writeUrl();
}

// The page that shows samples; null on the overview.
function page() {
  return { signals, views }[tab] ?? null;
}

const tabs = kTabs.map((name) => find(`tab-${name}`));
for (const [i, button] of tabs.entries()) {
  button.addEventListener("click", () => showTab(kTabs[i]));
  button.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.stopPropagation();
    const next = (i + by + tabs.length) % tabs.length;
    tabs[next].focus();
    showTab(kTabs[next]);
  });
}

// --- requests ------------------------------------------------------------------------------------

const overviewPump = new Pump(connection, kOverviewMs, async () => {
  const first = overview === null;
  overview = complete(await connection.request("overview"));
  overviewAt = performance.now();
  const range = overview.range && {
    oldest: BigInt(overview.range.oldest_ns),
    newest: BigInt(overview.range.newest_ns),
  };
  time.setRange(range, Boolean(overview.recording));
  types.forgetRecreated();
  types.askAgain(page()?.chosenStreams() ?? []);
  setText(find("host"), overview.host);
  find("host").title = `dssm-view ${overview.version}`;
  document.title = `${overview.host} \u2013 DSSM view`;
  overviewPage.show(overview);
  if (overview.hosts.length > 0 && performance.getEntriesByName(kFirstView).length === 0) {
    performance.mark(kFirstView);
  }
  views.showStreams();
  if (page() && (first || !page().suggested)) page().open();
  showBanner();
  return 0;
});

// The first answer may come before all is known.
function complete(answer) {
  for (const list of ["hosts", "streams", "nodes", "findings", "events"]) answer[list] ??= [];
  answer.range ??= null;
  return answer;
}

// The samples of all that is visible, at one instant, with one request.
const atPump = new Pump(connection, kAtMs, async () => {
  const shown = page();
  const wanted = shown?.chosenStreams() ?? [];
  if (wanted.length === 0) return null;
  const t = time.instant();
  const plays = time.mode === "play" && time.hover === null;
  let answer;
  try {
    answer = await connection.request("at", {
      streams: wanted,
      t_ns: t === null ? null : String(t),
      payloads: true,
    });
  } catch (error) {
    if (!(error instanceof RequestError)) throw error;
    shown.showSamples(t ?? 0n, new Map(wanted.map((stream) => [stream, failed(error.message)])));
    return kFailedMs;
  }
  const samples = new Map(answer.head.samples.map((one) => [one.stream, sampleOf(one, answer)]));
  const at = t ?? newestOf(samples); // the newest of each is shown as of the newest of all
  if (shown === page()) {
    shown.showSamples(at, samples);
    if (at !== null) time.setShown(at);
  }
  const has = (status) => answer.head.samples.some((one) => one.status === status);
  const stillPlays = plays && time.mode === "play" && shown === page();
  if (stillPlays && has("too_old") && !kMayHaveOne.some(has)) playOn();
  if (has("opening") || has("restarted")) return kOpeningMs;
  if (time.mode !== "hold" && time.hover === null) return 0;
  return has("arriving") || has("not_yet") || has("lapped") ? kArrivingMs : null;
});
time.addEventListener("change", () => atPump.wake());

function newestOf(samples) {
  let newest = null;
  for (const { timeNs } of samples.values()) {
    if (timeNs !== null && (newest === null || timeNs > newest)) newest = timeNs;
  }
  return newest;
}

function sampleOf(one, answer) {
  const has = one.payload_at !== undefined && one.payload_at !== null;
  return {
    status: one.status.replaceAll("_", " "),
    text: textOf(one.stream, one.status),
    error: one.error ?? "",
    staleness: time.instant() === null ? stalenessOf(one.stream) : "",
    tid: one.tid ?? null,
    timeNs: one.time_ns === undefined || one.time_ns === null ? null : BigInt(one.time_ns),
    clockErrorNs:
      one.clock_error_ns === undefined || one.clock_error_ns === null
        ? null
        : BigInt(one.clock_error_ns),
    payload: has ? answer.bytes(one.payload_at, one.payload_bytes) : null,
  };
}

function failed(error) {
  const none = { tid: null, timeNs: null, clockErrorNs: null, payload: null };
  return { status: "failed", text: "failed", error, staleness: "", ...none };
}

// --- steps by samples ----------------------------------------------------------------------------

// Moves the shown instant by `count` samples of the first stream shown, or of the view in focus.
async function step(count) {
  time.hover = null;
  const stream = views.root.hidden ? signals.chosenStreams()[0] : views.stepStream();
  const start = time.t ?? time.shown;
  if (stepping || start === null) return;
  stepping = true;
  time.hold(start);
  try {
    for (let i = 0; i < Math.abs(count); ++i) {
      const t = stream ? await neighbour(stream, time.t, Math.sign(count)) : null;
      if (t === null) break;
      time.hold(t);
    }
    if (!stream) time.hold(start + BigInt(count * kStepMs) * 1000000n);
  } catch (error) {
    if (!(error instanceof LostError || error instanceof RequestError)) throw error;
  } finally {
    stepping = false;
  }
}
let stepping = false;

// The time of the sample before or after the one at `t`, or nearest to `t` if there is none at `t`;
// null for none.
async function neighbour(stream, t, direction) {
  const at = async (ns) => {
    const answer = await connection.request("at", {
      streams: [stream],
      t_ns: String(ns),
      payloads: false,
    });
    const [sample] = answer.head.samples;
    return sample.status === "ok" ? { tid: sample.tid, ns: BigInt(sample.time_ns) } : null;
  };
  const here = await at(t);
  const known = streams().find((one) => one.stream === stream);
  if (!here) {
    const end = direction < 0 ? known?.newest_ns && BigInt(known.newest_ns) : oldestOf(known);
    const isThere = end && (direction < 0 ? end < t : end > t);
    return isThere ? end : null;
  }
  if (direction < 0) return (await at(here.ns - 1n))?.ns ?? null;
  // Ahead by a cycle, then by more; and back, should that skip samples.
  const cycle = known?.cycle_ns;
  let ahead = cycle > 0 ? BigInt(cycle) : 10000000n;
  let next = null;
  for (let i = 0; i < kMaxSteps && !next; ++i, ahead *= 2n) {
    if (time.range && here.ns > time.range.newest) break;
    const sample = await at(here.ns + ahead);
    if (!sample) return null;
    if (sample.tid !== here.tid) next = sample;
  }
  for (let i = 0; next && next.tid > here.tid + 1 && i < kMaxSteps; ++i) {
    const before = await at(next.ns - 1n);
    if (!before || before.tid <= here.tid) break;
    next = before;
  }
  return next?.ns ?? null;
}

// --- the connection ------------------------------------------------------------------------------

let lostAt = null;
connection.addEventListener("change", () => {
  const { state } = connection;
  if (state === "lost") lostAt ??= new Date();
  else lostAt = null;
  const status = find("connection");
  status.dataset.state = state;
  setText(status, state);
  document.body.dataset.connection = state;
  showBanner();
});

function showBanner() {
  const banner = find("banner");
  let text = "";
  if (lostAt) {
    const since = timeOfDay(BigInt(lostAt.getTime()) * 1000000n, 0);
    text =
      `No connection to dssm-view at ${location.host} since ${since}. ` +
      "The page tries to reconnect each second.";
  } else if (overview?.error) {
    text = `dssmd cannot be asked: ${overview.error}. The lists are the last known ones.`;
  }
  banner.hidden = text === "";
  setText(banner, text);
}

// --- the URL's fragment --------------------------------------------------------------------------

let urlTimer = null;
let chosen = { signals: false, views: false }; // whether a person chose them, or a link

function writeUrl() {
  clearTimeout(urlTimer);
  urlTimer = setTimeout(() => {
    const state = new URLSearchParams({ tab });
    if (chosen.signals) state.set("signals", JSON.stringify(signals.state));
    if (chosen.views) state.set("views", JSON.stringify(views.state));
    if (time.mode === "hold" && time.t !== null) state.set("t", String(time.t));
    history.replaceState(null, "", `#${state}`);
  }, kUrlMs);
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null; // a link that was cut off
  }
}

function readUrl(hash) {
  const state = new URLSearchParams(hash.slice(1));
  const signalsState = parsed(state.get("signals"));
  if (signalsState) {
    chosen.signals = signals.suggested = true;
    signals.state = signalsState;
  }
  const viewsState = parsed(state.get("views"));
  if (viewsState) {
    chosen.views = views.suggested = true;
    views.state = viewsState;
  }
  const t = state.get("t");
  if (t && /^\d{1,19}$/.test(t)) time.hold(BigInt(t));
  showTab(kTabs.includes(state.get("tab")) ? state.get("tab") : "overview");
}

signals.addEventListener("change", () => {
  chosen.signals = true;
  writeUrl();
});
views.addEventListener("change", () => {
  chosen.views = true;
  writeUrl();
});
for (const event of ["mode", "change"]) {
  time.addEventListener(
    event,
    () => (time.mode === "hold" || event === "mode") && time.hover === null && writeUrl(),
  );
}
// The event's URL: writeUrl() may have changed the present one since.
window.addEventListener("hashchange", (event) => readUrl(new URL(event.newURL).hash));

// --- dark and light ------------------------------------------------------------------------------

const kThemeKey = "dssm-view-theme";
const prefersDark = matchMedia("(prefers-color-scheme: dark)");

function storedTheme() {
  try {
    return localStorage.getItem(kThemeKey);
  } catch {
    return null; // storage is off in this browser
  }
}

function showTheme(theme) {
  const dark = theme ? theme === "dark" : prefersDark.matches;
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  setText(find("theme"), dark ? "Light" : "Dark");
  signals.restyle();
  views.restyle();
}

function toggleTheme() {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  try {
    localStorage.setItem(kThemeKey, theme);
  } catch {
    // It lasts until the page is closed.
  }
  showTheme(theme);
}

find("theme").addEventListener("click", toggleTheme);
prefersDark.addEventListener("change", () => showTheme(storedTheme()));

// --- keys and dialogs ----------------------------------------------------------------------------

function toggleKeys() {
  const dialog = find("keys");
  if (dialog.open) dialog.close();
  else dialog.showModal();
}

const kKeys = {
  1: () => showTab("overview"),
  2: () => showTab("signals"),
  3: () => showTab("views"),
  " ": () => time.toggle(),
  ArrowLeft: (event) => step(event.shiftKey ? -10 : -1),
  ArrowRight: (event) => step(event.shiftKey ? 10 : 1),
  Home: () => time.range && time.hold(beginning()),
  End: () => time.live(),
  r: () => time.play(),
  l: () => time.live(),
  p: () => tab === "signals" && signals.addPanel([], true),
  s: () => saveDialog.open(),
  z: () => signals.resetZoom(),
  d: toggleTheme,
  "?": toggleKeys,
};
const kOfTime = new Set([" ", "ArrowLeft", "ArrowRight", "Home", "End", "l", "r"]);

// Space presses a button that was reached by Tab. After a click it remains the page's key, also
// when the browser marks the focus with the first key.
let isReachedByKey = false;
document.addEventListener("focusin", (event) => {
  isReachedByKey = event.target.matches(":focus-visible");
});

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const action = Object.hasOwn(kKeys, key) ? kKeys[key] : null;
  if (!action) return;
  const { target } = event;
  const isSlider = target.id === "slider";
  if (!isSlider && target.matches("input, select, textarea")) return;
  if (key === " " && isReachedByKey && target.matches("button, summary, a")) return;
  if (document.querySelector("dialog[open]") && key !== "?") return;
  if (kOfTime.has(key) && !page()) return;
  event.preventDefault();
  action(event);
});

for (const dialog of document.querySelectorAll("dialog")) {
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
}
find("show-keys").addEventListener("click", toggleKeys);

showTheme(storedTheme());
readUrl(location.hash);
overviewPump.wake();
