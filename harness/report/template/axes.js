// Ticks, numbers with prefixes, the theme, and the common time range of all panels.
const view = { from: 0, to: 1 };
const shortest = () => time.kind === "order" ? 2 : Math.max(1e-6, SPAN * 1e-9);
const theme = {};
const dash = { demand: [6, 3], actual: [], truth: [2, 2], target: [8, 3, 2, 3] };
const FONT = "11px system-ui, sans-serif";

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["paper", "ink", "soft", "rule", "grid", "accent", "demand", "actual", "truth",
    "target", "off", "idle", "ready", "on", "stop", "fault", "boot",
    "n0", "n1", "n2", "n3", "n4", "n5", "n6", "n7"]) {
    theme[name] = style.getPropertyValue("--" + name).trim();
  }
  hatches.clear();
}

function step(span, count) {
  const raw = span / Math.max(1, count), power = 10 ** Math.floor(Math.log10(raw));
  const part = raw / power;
  return (part <= 1 ? 1 : part <= 2 ? 2 : part <= 5 ? 5 : 10) * power;
}

function ticks(low, high, count) {
  if (!(high > low)) return [];
  const by = step(high - low, count), out = [];
  const first = Math.ceil(low / by - 1e-9);
  for (let n = first; n * by <= high + by * 1e-9 && out.length < 200; n++) out.push(n * by);
  return out;
}

function digits(by) { return Math.max(0, Math.min(12, Math.ceil(-Math.log10(by) - 1e-9))); }

// Returns the scale of an axis of this size: [factor, prefix].
function prefix(size, unit) {
  if (!/^(rad|m|N|s|rad\/s|m\/s|N·m|bit\/s)$/.test(unit) || !(size > 0)) return [1, ""];
  if (size >= 1e6) return [1e-6, "M"];
  if (size >= 1e4) return [1e-3, "k"];
  if (size >= 0.1) return [1, ""];
  if (size >= 1e-4) return [1e3, "m"];
  if (size >= 1e-7 || unit !== "s") return [1e6, "µ"];
  return [1e9, "n"];
}

function short(value, figures = 5) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e7 || size < 1e-6) return value.toExponential(3);
  const text = value.toFixed(Math.max(0, Math.min(9, figures - 1 - Math.floor(Math.log10(size)))));
  return text.replace("-", "−");
}

function withUnit(value, unit, figures = 5) {
  const [factor, sign] = prefix(Math.abs(value), unit);
  return `${short(value * factor, figures)} ${sign}${unit}`;
}

// Formats a time as everywhere on the page: rig time, as printed by `motorhil show`.
function timeText(at, by = 1e-6) {
  if (time.kind === "order") return `message ${Math.round(at)}`;
  return `${(at + time.begin_s).toFixed(digits(by))} s`;
}
function spanText(span) {
  if (time.kind === "order") return `${Math.round(span)} messages`;
  return withUnit(span, "s", 4);
}

function setRange(from, to, remember = true) {
  let span = Math.min(Math.max(to - from, shortest()), SPAN * 1.04 || 1);
  const middle = (from + to) / 2;
  from = middle - span / 2;
  const slack = SPAN * 0.02;
  from = Math.min(Math.max(from, -slack), SPAN + slack - span);
  if (from === view.from && from + span === view.to) return;
  if (remember) past.push([view.from, view.to]);
  if (past.length > 100) past.shift();
  view.from = from;
  view.to = from + span;
  rangeChanged();
}
const past = [];

const hatches = new Map();
function hatch(ctx, colour, ink, kind) {
  const key = `${colour} ${ink} ${kind}`;
  let found = hatches.get(key);
  if (!found) {
    const tile = document.createElement("canvas");
    tile.width = tile.height = 8;
    const c = tile.getContext("2d");
    c.fillStyle = colour;
    c.fillRect(0, 0, 8, 8);
    c.strokeStyle = ink;
    c.lineWidth = 1.4;
    c.beginPath();
    for (const shift of [-8, 0, 8]) {
      c.moveTo(shift - 1, 9); c.lineTo(shift + 9, -1);
      if (kind === "cross") { c.moveTo(shift - 1, -1); c.lineTo(shift + 9, 9); }
    }
    c.stroke();
    found = ctx.createPattern(tile, "repeat");
    hatches.set(key, found);
  }
  return found;
}

function inkOn(colour) {
  const value = parseInt(colour.slice(1), 16);
  const light = 0.3 * (value >> 16) + 0.59 * (value >> 8 & 255) + 0.11 * (value & 255);
  return light > 140 ? "#111111" : "#ffffff";
}

// Shortens text to a width; "" if two letters do not fit.
function fitted(ctx, text, width) {
  if (ctx.measureText(text).width <= width) return text;
  let n = Math.floor(text.length * width / Math.max(1, ctx.measureText(text).width));
  while (n > 1 && ctx.measureText(text.slice(0, n) + "…").width > width) n--;
  return n > 1 ? text.slice(0, n) + "…" : "";
}
