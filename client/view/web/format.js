// SPDX-License-Identifier: Apache-2.0
//
// Text for people, and elements of the page. Names of streams, programs and hosts come from other
// computers: they become text nodes and attributes, never markup.

export const kClockErrorHint =
  "How far the time of a sample may be from this PC's clock; in a recording, from the recorder's";

// An element with attributes and children (elements, or strings that become text).
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) {
      made.setAttribute(name, value);
    }
  }
  made.append(...children);
  return made;
}

// Changes the DOM only when the text is another, so that a selection survives updates.
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// Makes `parent`'s children those of `items`, in order. An item's element is kept as long as its
// key is there: what a person selected or put in focus in it remains.
export function syncChildren(parent, items, keyOf, make, update) {
  const old = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  const used = new Set();
  let place = parent.firstElementChild;
  for (const item of items) {
    const key = keyOf(item);
    let child = old.get(key);
    if (child) {
      old.delete(key);
    } else {
      child = make(item);
      child.dataset.key = key;
    }
    used.add(child);
    update(child, item);
    if (child === place) place = place.nextElementSibling;
    else parent.insertBefore(child, place);
  }
  for (const child of [...parent.children]) if (!used.has(child)) child.remove();
}

export function duration(ns) {
  const size = Math.abs(Number(ns));
  const sign = Number(ns) < 0 ? "\u2212" : "";
  const text = (value, unit) => `${sign}${digits(value)} ${unit}`;
  if (size < 1e3) return `${sign}${size.toFixed(0)} ns`;
  if (size < 1e6) return text(size / 1e3, "\u00b5s");
  if (size < 1e9) return text(size / 1e6, "ms");
  if (size < 120e9) return text(size / 1e9, "s");
  if (size < 7200e9) return text(size / 60e9, "min");
  if (size < 48 * 3600e9) return text(size / 3600e9, "h");
  return text(size / 86400e9, "d");
}

// Three significant digits, without an exponent for usual values.
function digits(value) {
  if (value >= 100) return value.toFixed(0);
  if (value >= 10) return value.toFixed(1);
  return value.toFixed(2);
}

// For people to choose: 90 is "90 s", 120 is "2 min".
export function wholeDuration(seconds) {
  if (seconds % 3600 === 0) return `${seconds / 3600} h`;
  return seconds % 60 === 0 ? `${seconds / 60} min` : `${seconds} s`;
}

export function bytes(count) {
  if (count < 1024) return `${count} B`;
  if (count < 1024 ** 2) return `${digits(count / 1024)} KiB`;
  return `${digits(count / 1024 ** 2)} MiB`;
}

// "1 sample", "2 samples"
export function counted(count, noun) {
  return `${count} ${noun}${count === 1 ? "" : "s"}`;
}

export function rate(hz) {
  return `${hz >= 100 ? hz.toFixed(0) : hz.toFixed(1)} Hz`;
}

// A measured value: up to seven significant digits, integers in full.
export function number(value) {
  if (typeof value === "bigint") return value.toString();
  if (typeof value === "boolean") return value ? "true" : "false";
  if (!Number.isFinite(value)) return String(value);
  if (Number.isInteger(value) && Math.abs(value) < 1e15) return String(value);
  const size = Math.abs(value);
  if (size >= 1e7 || size < 1e-4) return value.toExponential(4);
  return value.toPrecision(7).replace(/\.?0+$/, "");
}

const kShortLabel = 7; // characters

// Labels of an axis: as few digits as make them different, with exponents where that is shorter.
export function axisLabels(values) {
  const size = Math.max(...values.map(Math.abs)) || 1;
  const step = Math.abs(values[1] - values[0]) || size;
  const digits = Math.floor(Math.log10(size)) - Math.floor(Math.log10(step)) + 2;
  const rounded = values.map((value) => Number(value.toPrecision(Math.min(15, digits))));
  const plain = rounded.map((value) => String(value).replace("e+", "e"));
  const short = rounded.map((value) => value.toExponential().replace("e+", "e").replace("e0", ""));
  const lengthOf = (texts) => Math.max(...texts.map((text) => text.length));
  return lengthOf(plain) <= Math.max(kShortLabel, lengthOf(short)) ? plain : short;
}

const two = (value) => String(value).padStart(2, "0");

// Local time of day of ns since 1970 (BigInt), to `places` decimals of the second.
export function timeOfDay(ns, places = 3) {
  const date = new Date(Number(ns / 1000000n));
  const text = `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`;
  if (places === 0) return text;
  const fraction = String(((ns % 1000000000n) + 1000000000n) % 1000000000n).padStart(9, "0");
  return `${text}.${fraction.slice(0, places)}`;
}

export function day(ns) {
  const date = new Date(Number(ns / 1000000n));
  return `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
}

// Offers `blob` for download.
export function download(blob, name) {
  const url = URL.createObjectURL(blob);
  element("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

// The value of a CSS variable such as "--text", for canvases.
export function cssColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
