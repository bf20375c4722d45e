// The document and its packed arrays. Times are in seconds from the recording's beginning.
let report = null, bytes = null, SPAN = 1;
let time = { kind: "rig", span: 1, tick_s: 1, begin_s: 0, begin_ns: "0" };

function adopt(told) {
  report = told;
  time = report.time;
  SPAN = time.span * time.tick_s;
}

function fail(what) {
  const root = document.documentElement;
  root.dataset.error = (root.dataset.error ? root.dataset.error + " | " : "") + what;
}
window.addEventListener("error", (event) => fail(String(event.message)));
window.addEventListener("unhandledrejection", (event) => fail(String(event.reason)));

async function inflated(packed_text) {
  const text = atob(packed_text.trim());
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser cannot decompress the data: use one of 2023 or later");
  }
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const SIZES = { u8: 1, u16: 2, u32: 4, f32: 4 };

// Bytes of equal significance are adjacent: first all lowest ones, then the next.
function whole(told) {
  const size = SIZES[told.type], count = told.count, at = told.offset;
  if (size === 1) return bytes.subarray(at, at + count);
  const out = size === 2 ? new Uint16Array(count) : new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    let value = 0;
    for (let b = size - 1; b >= 0; b--) value = value * 256 + bytes[at + b * count + i];
    out[i] = value;
  }
  return out;
}

function seconds(told, tick_s = time.tick_s) {
  const ticks = whole(told), out = new Float64Array(ticks.length);
  let sum = 0;
  for (let i = 0; i < ticks.length; i++) {
    sum = told.delta ? sum + ticks[i] : ticks[i];
    out[i] = sum * tick_s;
  }
  return out;
}

function numbers(told) {
  const raw = whole(told), floats = new Float32Array(raw.buffer), out = new Float64Array(raw.length);
  for (let i = 0; i < out.length; i++) out[i] = told.base + floats[i];
  return out;
}

// Returns the first index whose value is not below / is above.
function lower(sorted, value) {
  let from = 0, to = sorted.length;
  while (from < to) {
    const middle = (from + to) >> 1;
    if (sorted[middle] < value) from = middle + 1; else to = middle;
  }
  return from;
}
function upper(sorted, value) {
  let from = 0, to = sorted.length;
  while (from < to) {
    const middle = (from + to) >> 1;
    if (sorted[middle] <= value) from = middle + 1; else to = middle;
  }
  return from;
}
