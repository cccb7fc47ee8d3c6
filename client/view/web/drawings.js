// SPDX-License-Identifier: Apache-2.0
//
// What a view draws of one sample: the plane with scans and poses, images, all fields, bytes.
import { imageSize, isFloat, isNumeric, numberOf, textOf, unitOf, valueOf } from "./fields.js";
import { cssColor, element, number, setText } from "./format.js";

// --- the plane -----------------------------------------------------------------------------------

const kMinScale = 0.5; // CSS pixels per metre
const kMaxScale = 2000;
const kWheelStep = 1.0015;
const kFill = 0.9; // of the canvas, after a fit
const kBeamsPart = 0.97; // of the ranges are in the picture after a fit: the rest are outliers
const kMargin = 1; // m around a pose without a trail

// Scans and poses from above: x to the right, y up; a scan without a pose has its own x upwards.
export class PlaneView {
  constructor(box) {
    this.canvas = element("canvas", { role: "img", "aria-label": "Plan view" });
    box.append(this.canvas);
    this.center = [0, 0]; // m
    this.scale = null; // CSS pixels per m; null: it fits at the next drawing
    this.fitted = true; // until a person zooms or moves
    this.pointers = new Map(); // that are down: id -> [x, y] in CSS pixels
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.canvas);
    this.listen();
  }

  close() {
    this.observer.disconnect();
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        if (this.scale === null) return;
        this.zoom(kWheelStep ** -event.deltaY, event.offsetX, event.offsetY);
      },
      { passive: false },
    );
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const { center, scale, fitted } = this;
      if (this.pointers.size === 0) this.before = { center: [...center], scale, fitted };
      this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    });
    canvas.addEventListener("pointercancel", () => {
      Object.assign(this, this.before); // the finger scrolls the page instead
      this.redraw();
    });
    canvas.addEventListener("lostpointercapture", (event) =>
      this.pointers.delete(event.pointerId),
    );
    canvas.addEventListener("pointermove", (event) => this.movePointer(event));
    canvas.addEventListener("dblclick", () => {
      this.fitted = true;
      this.scale = null;
      this.redraw();
    });
  }

  // One pointer moves the plane, two zoom it.
  movePointer({ pointerId, offsetX, offsetY }) {
    if (!this.pointers.has(pointerId) || this.scale === null) return;
    const before = this.pinch();
    this.pointers.set(pointerId, [offsetX, offsetY]);
    const after = this.pinch();
    this.center[0] -= (after.x - before.x) / this.scale;
    this.center[1] += (after.y - before.y) / this.scale;
    const isPinch = before.size > 0 && after.size > 0;
    this.zoom(isPinch ? after.size / before.size : 1, after.x, after.y);
  }

  // The middle of the first two pointers, and how far they are from each other.
  pinch() {
    const [[x0, y0], [x1, y1] = [x0, y0]] = this.pointers.values();
    return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, size: Math.hypot(x1 - x0, y1 - y0) };
  }

  // What is at (x, y) of the canvas remains there.
  zoom(factor, x, y) {
    const { canvas } = this;
    const scale = Math.min(kMaxScale, Math.max(kMinScale, this.scale * factor));
    const [u, v] = [x - canvas.clientWidth / 2, canvas.clientHeight / 2 - y];
    this.center[0] += u / this.scale - u / scale;
    this.center[1] += v / this.scale - v / scale;
    this.scale = scale;
    this.fitted = false;
    this.redraw();
  }

  readPose(payload, fields) {
    const pose = {
      x: numberOf(payload, fields.x) * unitOf(fields.x),
      y: numberOf(payload, fields.y) * unitOf(fields.y),
      theta: fields.theta ? numberOf(payload, fields.theta) * unitOf(fields.theta) : null,
    };
    return Number.isFinite(pose.x) && Number.isFinite(pose.y) ? pose : null;
  }

  // {angles, ranges, note}: the valid beams; angles counter-clockwise from straight ahead.
  readScan(payload, fields) {
    const { ranges: field } = fields;
    const stated = fields.beams ? numberOf(payload, fields.beams) : field.count;
    const count = Math.min(field.count, Math.max(0, Number.isFinite(stated) ? stated : 0));
    let first = fields.first ? numberOf(payload, fields.first) * unitOf(fields.first) : null;
    let step = fields.step ? numberOf(payload, fields.step) * unitOf(fields.step) : null;
    const last = fields.last ? numberOf(payload, fields.last) * unitOf(fields.last) : null;
    const known = first !== null && (step !== null || last !== null);
    if (first !== null && step === null && last !== null)
      step = (last - first) / Math.max(1, count - 1);
    if (!known) {
      first = -Math.PI;
      step = (2 * Math.PI) / Math.max(1, count);
    }
    const unit = unitOf(field);
    const angles = [];
    const ranges = [];
    for (let i = 0; i < count; ++i) {
      const range = numberOf(payload, field, i) * unit;
      if (!Number.isFinite(range) || range <= 0) continue;
      angles.push(first + i * step);
      ranges.push(range);
    }
    const note =
      count === 0
        ? "A scan without beams"
        : known
          ? ""
          : "The type has no angles: a full turn is assumed";
    return { angles, ranges, note };
  }

  show(content) {
    this.content = content;
    this.redraw();
  }

  resize() {
    const { canvas } = this;
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = Math.round(canvas.clientHeight * devicePixelRatio);
    if (width === 0 || (canvas.width === width && canvas.height === height)) return;
    canvas.width = width;
    canvas.height = height;
    if (this.fitted) this.scale = null;
    this.redraw();
  }

  // The scan's points in metres of the plane.
  pointsOf(scan, pose) {
    const x0 = pose?.x ?? 0;
    const y0 = pose?.y ?? 0;
    const turn = pose ? (pose.theta ?? 0) : Math.PI / 2;
    return scan.ranges.map((range, i) => {
      const angle = turn + scan.angles[i];
      return [x0 + range * Math.cos(angle), y0 + range * Math.sin(angle)];
    });
  }

  // The part of the plane to show: all of the trail, and the scan without its longest beams.
  fit({ scan, pose, trail }, points) {
    const xs = [];
    const ys = [];
    if (scan && points.length > 0) {
      const sorted = [...scan.ranges].sort((a, b) => a - b);
      const limit = sorted[Math.floor((sorted.length - 1) * kBeamsPart)];
      points.forEach(([x, y], i) => {
        if (scan.ranges[i] <= limit) {
          xs.push(x);
          ys.push(y);
        }
      });
    }
    if (trail) {
      for (let i = 0; i < trail.x.length; ++i) {
        if (Number.isNaN(trail.x[i]) || Number.isNaN(trail.y[i])) continue;
        xs.push(trail.x[i]);
        ys.push(trail.y[i]);
      }
    }
    const here = pose ?? { x: 0, y: 0 };
    const around = xs.length === 0 || !scan ? kMargin : 0;
    xs.push(here.x - around, here.x + around);
    ys.push(here.y - around, here.y + around);
    const bound = (list) => [
      list.reduce((a, b) => Math.min(a, b)),
      list.reduce((a, b) => Math.max(a, b)),
    ];
    return { x: bound(xs), y: bound(ys) };
  }

  redraw() {
    const { canvas, content } = this;
    if (!content || canvas.width === 0 || canvas.clientWidth === 0) return;
    const points = content.scan ? this.pointsOf(content.scan, content.pose) : [];
    if (this.fitted) this.applyFit(this.fit(content, points));
    const draw = canvas.getContext("2d");
    draw.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    draw.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    const toX = (x) => canvas.clientWidth / 2 + (x - this.center[0]) * this.scale;
    const toY = (y) => canvas.clientHeight / 2 - (y - this.center[1]) * this.scale;
    this.drawGrid(draw, toX, toY);
    if (content.trail) this.drawTrail(draw, content, toX, toY);
    if (points.length > 0) this.drawPoints(draw, content, points, toX, toY);
    if (content.pose || content.scan) this.drawRobot(draw, content.pose, toX, toY);
  }

  // Moves and zooms only when the content leaves the picture, or has become small in it, so that
  // the picture does not jitter.
  applyFit({ x, y }) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const spanX = Math.max(x[1] - x[0], 0.1);
    const spanY = Math.max(y[1] - y[0], 0.1);
    const scale = Math.min(kMaxScale, (kFill * width) / spanX, (kFill * height) / spanY);
    const kSmall = 1.6;
    if (this.scale !== null && scale < this.scale * kSmall) {
      const inside = (range, center, size) =>
        range[0] >= center - size / 2 / this.scale && range[1] <= center + size / 2 / this.scale;
      if (inside(x, this.center[0], width) && inside(y, this.center[1], height)) return;
    }
    this.scale = scale / 1.1;
    this.center = [(x[0] + x[1]) / 2, (y[0] + y[1]) / 2];
  }

  drawGrid(draw, toX, toY) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const kLinePx = 48;
    const raw = kLinePx / this.scale;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((digit) => digit * power).find((size) => size >= raw);
    draw.strokeStyle = cssColor("--grid");
    draw.lineWidth = 1;
    draw.beginPath();
    const [left, right] = [
      this.center[0] - width / 2 / this.scale,
      this.center[0] + width / 2 / this.scale,
    ];
    const [low, high] = [
      this.center[1] - height / 2 / this.scale,
      this.center[1] + height / 2 / this.scale,
    ];
    for (let i = Math.ceil(left / step); i * step <= right; ++i) {
      const u = Math.round(toX(i * step)) + 0.5;
      draw.moveTo(u, 0);
      draw.lineTo(u, height);
    }
    for (let i = Math.ceil(low / step); i * step <= high; ++i) {
      const v = Math.round(toY(i * step)) + 0.5;
      draw.moveTo(0, v);
      draw.lineTo(width, v);
    }
    draw.stroke();
    // A bar as long as one square.
    draw.strokeStyle = draw.fillStyle = cssColor("--text-2");
    draw.beginPath();
    draw.moveTo(10.5, height - 14);
    draw.lineTo(10.5, height - 10.5);
    draw.lineTo(10.5 + step * this.scale, height - 10.5);
    draw.lineTo(10.5 + step * this.scale, height - 14);
    draw.stroke();
    draw.font = "11px system-ui, sans-serif";
    draw.fillText(`${number(step)} m`, 14, height - 16);
  }

  drawTrail(draw, { trail, pose }, toX, toY) {
    draw.strokeStyle = cssColor("--c0");
    draw.lineWidth = 1.5;
    draw.lineJoin = "round";
    draw.beginPath();
    let gap = true;
    for (let i = 0; i < trail.x.length; ++i) {
      if (Number.isNaN(trail.x[i]) || Number.isNaN(trail.y[i])) {
        gap = true;
        continue;
      }
      if (gap) draw.moveTo(toX(trail.x[i]), toY(trail.y[i]));
      else draw.lineTo(toX(trail.x[i]), toY(trail.y[i]));
      gap = false;
    }
    if (pose && !gap) draw.lineTo(toX(pose.x), toY(pose.y));
    draw.stroke();
  }

  drawPoints(draw, { pose }, points, toX, toY) {
    const x0 = toX(pose?.x ?? 0);
    const y0 = toY(pose?.y ?? 0);
    draw.fillStyle = cssColor("--beam");
    draw.beginPath();
    draw.moveTo(x0, y0);
    for (const [x, y] of points) draw.lineTo(toX(x), toY(y));
    draw.closePath();
    draw.fill();
    draw.fillStyle = cssColor("--c1");
    const kDot = 2.5;
    for (const [x, y] of points) draw.fillRect(toX(x) - kDot / 2, toY(y) - kDot / 2, kDot, kDot);
  }

  // An arrow where the robot or the scanner is.
  drawRobot(draw, pose, toX, toY) {
    const kSize = 9;
    const turn = pose ? pose.theta : Math.PI / 2;
    draw.save();
    draw.translate(toX(pose?.x ?? 0), toY(pose?.y ?? 0));
    draw.fillStyle = cssColor("--text");
    draw.beginPath();
    if (turn === null) {
      draw.arc(0, 0, kSize / 2, 0, 2 * Math.PI);
    } else {
      draw.rotate(-turn);
      draw.moveTo(kSize, 0);
      draw.lineTo(-kSize * 0.7, kSize * 0.65);
      draw.lineTo(-kSize * 0.35, 0);
      draw.lineTo(-kSize * 0.7, -kSize * 0.65);
      draw.closePath();
    }
    draw.fill();
    draw.restore();
  }
}

// --- images --------------------------------------------------------------------------------------

const kMaxPixels = 64 * 1024 * 1024;

export class ImageView {
  // layout: of imageOf(); null for bytes that may be a JPEG
  constructor(box, type, layout) {
    this.type = type;
    this.layout = layout;
    this.canvas = element("canvas", { class: "image", role: "img", "aria-label": "Image" });
    box.append(this.canvas);
    this.newest = 0;
  }

  show({ payload }, note) {
    const offset = this.layout?.offset ?? 0;
    const bytes = new Uint8Array(
      payload.buffer,
      payload.byteOffset + offset,
      payload.byteLength - offset,
    );
    if (bytes[0] === 0xff && bytes[1] === 0xd8 && bytes[2] === 0xff)
      return this.showJpeg(bytes, note);
    const size = this.sizeOf(payload, bytes);
    if (!size) {
      this.empty();
      return note("The size of the image is not known");
    }
    const { columns, rows, channels } = size;
    const pixels = new ImageData(columns, rows);
    const out = pixels.data;
    for (let i = 0, from = 0, to = 0; i < columns * rows; ++i, from += channels, to += 4) {
      out[to] = bytes[from];
      out[to + 1] = channels === 1 ? bytes[from] : bytes[from + 1];
      out[to + 2] = channels === 1 ? bytes[from] : bytes[from + 2];
      out[to + 3] = 255;
    }
    this.setSize(columns, rows);
    this.canvas.getContext("2d").putImageData(pixels, 0, 0);
    ++this.newest; // a JPEG that is still being decoded is older
    note(`${columns} \u00d7 ${rows}, ${channels === 1 ? "grey" : "RGB"}`);
  }

  // Also of a JPEG that is still being decoded.
  empty() {
    ++this.newest;
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  // From the sample's fields, else from the number of bytes.
  sizeOf(payload, bytes) {
    const { layout } = this;
    if (!layout?.width) return layout?.columns ? layout : imageSize(bytes.length);
    const columns = numberOf(payload, layout.width);
    const rows = numberOf(payload, layout.height);
    if (!(columns > 0 && rows > 0 && columns * rows <= kMaxPixels)) return null;
    const capacity = Math.min(layout.data.count, bytes.length);
    const stated = layout.channels ? numberOf(payload, layout.channels) : null;
    const channels = stated === 1 || stated === 3 ? stated : capacity >= columns * rows * 3 ? 3 : 1;
    return columns * rows * channels <= capacity ? { columns, rows, channels } : null;
  }

  showJpeg(bytes, note) {
    const number = ++this.newest;
    createImageBitmap(new Blob([bytes], { type: "image/jpeg" })).then(
      (bitmap) => {
        if (number !== this.newest) return;
        this.setSize(bitmap.width, bitmap.height);
        this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
        note(`${bitmap.width} \u00d7 ${bitmap.height}, JPEG`);
        bitmap.close();
      },
      () => {
        if (number !== this.newest) return;
        this.empty();
        note("The JPEG image cannot be decoded");
      },
    );
  }

  setSize(columns, rows) {
    if (this.canvas.width !== columns) this.canvas.width = columns;
    if (this.canvas.height !== rows) this.canvas.height = rows;
  }
}

// --- fields and bytes ----------------------------------------------------------------------------

const kShownElements = 12;

export class TableView {
  constructor(box, type) {
    this.rows = type.fields.map((field) => {
      const value = element("td", { class: field.count === 1 ? "number" : "list" });
      const kind = field.count === 1 ? field.kind : `${field.kind}[${field.count}]`;
      const row = element(
        "tr",
        { "data-field": field.name },
        element("th", { scope: "row" }, field.name),
        value,
        element("td", { class: "kind" }, kind),
      );
      return { field, value, row };
    });
    box.append(
      element(
        "div",
        { class: "scroll" },
        element(
          "table",
          { class: "fields" },
          element("tbody", {}, ...this.rows.map((one) => one.row)),
        ),
      ),
    );
  }

  show({ payload }) {
    for (const { field, value } of this.rows) setText(value, this.textOf(payload, field));
  }

  textOf(payload, field) {
    if (field.kind === "char" && field.count > 1) return JSON.stringify(textOf(payload, field));
    if (field.count === 1) return this.elementText(payload, field, 0);
    const shown = Math.min(field.count, kShownElements);
    const parts = [];
    for (let i = 0; i < shown; ++i) parts.push(this.elementText(payload, field, i));
    return parts.join("  ") + (shown < field.count ? `  \u2026 ${field.count - shown} more` : "");
  }

  elementText(payload, field, index) {
    const value = valueOf(payload, field, index);
    if (value === undefined) return "\u2013";
    if (field.kind === "float32" && isNumeric(field) && isFloat(field))
      return number(Number(value.toPrecision(7)));
    return number(value);
  }
}

const kMaxDump = 4096;
const kBytesInLine = 16;
const kMaxTextBytes = 65536;

export class HexView {
  constructor(box) {
    this.text = element("pre", { class: "hex", tabindex: "0", "aria-label": "Bytes" });
    box.append(this.text);
  }

  clear() {
    setText(this.text, "");
  }

  show({ payload }) {
    const lines = [];
    const end = Math.min(payload.byteLength, kMaxDump);
    for (let at = 0; at < end; at += kBytesInLine) {
      let hex = "";
      let text = "";
      for (let i = at; i < Math.min(end, at + kBytesInLine); ++i) {
        const byte = payload.getUint8(i);
        hex += `${byte.toString(16).padStart(2, "0")} ${i % 8 === 7 ? " " : ""}`;
        text += byte >= 0x20 && byte < 0x7f ? String.fromCharCode(byte) : ".";
      }
      lines.push(`${at.toString(16).padStart(6, "0")}  ${hex.padEnd(3 * kBytesInLine + 3)}${text}`);
    }
    if (end < payload.byteLength) lines.push(`\u2026 ${payload.byteLength - end} more bytes`);
    setText(this.text, lines.join("\n"));
  }
}

// A property has no type: a text is shown as one.
export class PropertyView extends HexView {
  show({ payload }) {
    const text = plainText(payload);
    if (text === null) super.show({ payload });
    else setText(this.text, text);
  }
}

// Null if it is not a text.
function plainText(payload) {
  if (payload.byteLength === 0 || payload.byteLength > kMaxTextBytes) return null;
  try {
    const text = new TextDecoder("utf-8", { fatal: true }).decode(payload);
    return /[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]/.test(text) ? null : text;
  } catch {
    return null;
  }
}
