// SPDX-License-Identifier: Apache-2.0
//
// Types of streams: their fields, values in payloads, and which view fits a type.

const kSizes = {
  bool: 1,
  char: 1,
  int8: 1,
  uint8: 1,
  int16: 2,
  uint16: 2,
  int32: 4,
  uint32: 4,
  int64: 8,
  uint64: 8,
  float32: 4,
  float64: 8,
};

export function isNumeric(field) {
  return field.kind in kSizes && field.kind !== "char";
}

export function isFloat(field) {
  return field.kind === "float32" || field.kind === "float64";
}

// "odometry.pose.x" -> "x", in lower case and without a unit: names are compared so.
function plainName(field) {
  const last = field.name.split(".").pop().toLowerCase();
  return last.replace(/_(m|mm|rad|deg|px)$/, "");
}

// Element `index` of `field` in `payload` (a DataView): a number, bool, or BigInt for 64 bits;
// undefined when the payload is shorter.
export function valueOf(payload, field, index = 0) {
  const at = field.offset_bytes + index * field.stride_bytes;
  if (at + kSizes[field.kind] > payload.byteLength) return undefined;
  const value = rawValue(payload, field.kind, at);
  if (!field.bits) return value;
  const bits = BigInt.asUintN(field.bits, BigInt(value) >> BigInt(field.first_bit ?? 0));
  if (field.kind === "bool") return bits !== 0n;
  const signed = field.kind.startsWith("int");
  const whole = signed ? BigInt.asIntN(field.bits, bits) : bits;
  return field.kind.endsWith("64") ? whole : Number(whole);
}

function rawValue(payload, kind, at) {
  switch (kind) {
    case "bool":
      return payload.getUint8(at) !== 0;
    case "char":
    case "uint8":
      return payload.getUint8(at);
    case "int8":
      return payload.getInt8(at);
    case "uint16":
      return payload.getUint16(at, true);
    case "int16":
      return payload.getInt16(at, true);
    case "uint32":
      return payload.getUint32(at, true);
    case "int32":
      return payload.getInt32(at, true);
    case "uint64":
      return payload.getBigUint64(at, true);
    case "int64":
      return payload.getBigInt64(at, true);
    case "float32":
      return payload.getFloat32(at, true);
    case "float64":
      return payload.getFloat64(at, true);
    default:
      return undefined;
  }
}

// As a number, for drawing; NaN when there is none.
export function numberOf(payload, field, index = 0) {
  const value = valueOf(payload, field, index);
  return value === undefined ? NaN : Number(value);
}

// A char array, up to its first zero.
export function textOf(payload, field) {
  const end = Math.min(field.offset_bytes + field.count, payload.byteLength);
  const bytes = [];
  for (let at = field.offset_bytes; at < end && payload.getUint8(at) !== 0; ++at) {
    bytes.push(payload.getUint8(at));
  }
  return new TextDecoder().decode(new Uint8Array(bytes));
}

// The field, and the element of an array, that a name like "range_m[3]" means; null for none.
export function findField(type, name) {
  const parts = /^(.*)\[(\d+)\]$/.exec(name);
  const exact = type.fields.find((field) => field.name === name);
  if (exact) return { field: exact, index: 0 };
  const field = parts && type.fields.find((one) => one.name === parts[1]);
  return field && Number(parts[2]) < field.count ? { field, index: Number(parts[2]) } : null;
}

// --- which view fits -----------------------------------------------------------------------------

const kMinBeams = 32;
const kImageSizes = [
  [160, 120],
  [320, 240],
  [640, 480],
  [800, 600],
  [1024, 768],
  [1280, 720],
  [1280, 960],
  [1280, 1024],
  [1600, 1200],
  [1920, 1080],
  [1920, 1200],
  [2048, 1536],
  [2592, 1944],
  [3840, 2160],
];
const scalar = (field) => field.count === 1 && isNumeric(field);

// The fields of a scan: {ranges, beams?, first?, step?, last?}; null when the type is not one.
export function scanOf(type) {
  const ranges = type.fields.find(
    (field) =>
      field.count >= kMinBeams &&
      isNumeric(field) &&
      /^(ranges?|r|distances?)$/.test(plainName(field)),
  );
  if (!ranges) return null;
  const find = (pattern) =>
    type.fields.find((field) => scalar(field) && pattern.test(plainName(field)));
  return {
    ranges,
    beams: find(/^(beams|num_?beams|n|count|size|num|num_?points|beam_?count)$/),
    first: find(/^(first|start|first_?angle|start_?angle|angle_?(min|start|first)|min_?angle)$/),
    step: find(
      /^(step|increment|angle_?(step|increment|resolution)|resolution|angular_?resolution)$/,
    ),
    last: find(/^(last|end|last_?angle|end_?angle|angle_?(max|end|last)|max_?angle)$/),
  };
}

// Metres or radians for a value of `field`, by the unit at the end of its name.
export function unitOf(field) {
  if (/_mm$/.test(field.name)) return 1e-3;
  if (/_deg$/.test(field.name)) return Math.PI / 180;
  return 1;
}

// The fields of a pose: {x, y, theta?}; null when the type is not one.
export function poseOf(type) {
  const find = (pattern) =>
    type.fields.find((field) => scalar(field) && pattern.test(plainName(field)));
  const x = find(/^(x|px|pos_?x)$/);
  const y = find(/^(y|py|pos_?y)$/);
  const theta = find(/^(theta|yaw|heading|th|phi|a|angle)$/);
  return x && y ? { x, y, theta } : null;
}

// Of an image: the fields {data, width, height, channels?} of a described type; or {columns, rows,
// channels} when a number of bytes is that of a common picture; both with {offset} of the first
// byte. Null when the type is not an image.
export function imageOf(type) {
  const data = type.fields.find((field) => field.kind === "uint8" && field.count >= 256);
  const find = (pattern) =>
    type.fields.find((field) => scalar(field) && pattern.test(plainName(field)));
  const width = find(/^(width|w|cols|columns)$/);
  const height = find(/^(height|h|rows)$/);
  if (data && width && height) {
    return {
      data,
      width,
      height,
      channels: find(/^(channels|depth|components)$/),
      offset: data.offset_bytes,
    };
  }
  if (type.fields.length > 0 && !data) return null;
  const size = data ? data.count : type.payload_bytes;
  const known = imageSize(size);
  return known ? { offset: data ? data.offset_bytes : 0, size, ...known } : null;
}

// {columns, rows, channels} of `size` bytes, if a common picture has that size.
export function imageSize(size) {
  for (const channels of [1, 3]) {
    const found = kImageSizes.find(([columns, rows]) => columns * rows * channels === size);
    if (found) return { columns: found[0], rows: found[1], channels };
  }
  return null;
}

// "scan", "image", "pose", "table" or "hex"
export function guessKind(type) {
  if (scanOf(type)) return "scan";
  if (imageOf(type)) return "image";
  const pose = poseOf(type);
  if (pose && pose.theta) return "pose";
  return type.fields.length > 0 ? "table" : "hex";
}

// The names that a person can plot, and of long arrays the array itself.
export function signalsOf(type) {
  const kFew = 16;
  const names = [];
  for (const field of type.fields.filter(isNumeric)) {
    if (field.count === 1) names.push({ name: field.name });
    else if (field.count > kFew) names.push({ name: field.name, count: field.count });
    else for (let i = 0; i < field.count; ++i) names.push({ name: `${field.name}[${i}]` });
  }
  return names;
}
