// Panels, and those of quantities over time.
const panels = [];
let gutter = 132, plotWidth = 600;

function make(tag, parent, text, className) {
  const element = document.createElement(tag);
  if (text) element.textContent = text;
  if (className) element.className = className;
  if (parent) parent.append(element);
  return element;
}

// A canvas with its reading beside it. `draw(ctx, width, height, x)` returns how much it drew.
class Panel {
  constructor(parent, name, height) {
    this.row = make("div", parent, "", "panel");
    this.canvas = make("canvas", this.row);
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", name);
    this.canvas.dataset.panel = name;
    this.reading = make("div", this.row, "", "read");
    this.height = height;
    this.stale = true;
    panels.push(this);
  }
  visible(margin = 300) {
    if (!this.row.offsetParent) return false;
    const box = this.row.getBoundingClientRect();
    return box.bottom > -margin && box.top < innerHeight + margin;
  }
  paint() {
    const ratio = devicePixelRatio || 1, width = gutter + plotWidth, canvas = this.canvas;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(this.height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(this.height * ratio);
      canvas.style.width = width + "px";
      canvas.style.height = this.height + "px";
    }
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, this.height);
    ctx.font = FONT;
    this.stale = false;
    const drawn = this.draw(ctx, plotWidth, this.height);
    canvas.dataset.drawn = drawn;
    canvas.dataset.from = view.from;
    canvas.dataset.to = view.to;
    this.ranged();
  }
  draw() { return 0; }
  ranged() {}          // called after a change of the range
  read(at, x, y) {}    // called with the cursor (y: null if on another panel; at: null if hidden)
}

const toX = (at) => gutter + (at - view.from) / (view.to - view.from) * plotWidth;
const toTime = (x) => view.from + (x - gutter) / plotWidth * (view.to - view.from);

function gridLines(ctx, height) {
  ctx.strokeStyle = theme.grid;
  ctx.lineWidth = 1;
  ctx.beginPath();
  for (const at of timeTicks()) {
    const x = Math.round(toX(at)) + 0.5;
    ctx.moveTo(x, 0);
    ctx.lineTo(x, height);
  }
  ctx.stroke();
}

function timeTicks() {
  const shift = time.begin_s;
  return ticks(view.from + shift, view.to + shift, plotWidth / 110).map((at) => at - shift);
}

function clipPlot(ctx, height) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(gutter, 0, plotWidth, height);
  ctx.clip();
}

const NARROW = { position: "pos.", velocity: "vel.", "following error": "f. error", torque: "torque" };

// Draws y ticks with their labels in the gutter, and the name of the axis.
function yAxis(ctx, height, low, high, title, unit) {
  const [factor, sign] = prefix(Math.max(Math.abs(low), Math.abs(high)), unit);
  const marks = ticks(low * factor, high * factor, Math.max(2, height / 22));
  const by = marks.length > 1 ? marks[1] - marks[0] : 1;
  const places = digits(Math.abs(by));
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  ctx.lineWidth = 1;
  for (const mark of marks) {
    const y = Math.round(height - 3 - (mark / factor - low) / (high - low) * (height - 6)) + 0.5;
    ctx.strokeStyle = theme.grid;
    ctx.beginPath();
    ctx.moveTo(gutter, y);
    ctx.lineTo(gutter + plotWidth, y);
    ctx.stroke();
    ctx.fillStyle = theme.soft;
    if (y > 5 && y < height - 4) {
      const text = Math.abs(mark) < by * 1e-6 ? "0" : mark.toFixed(places).replace("-", "−");
      ctx.fillText(text, gutter - 6, y);
    }
  }
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  ctx.fillStyle = theme.ink;
  ctx.fillText(fitted(ctx, gutter < 120 && NARROW[title] || title, gutter - 44), 0, 2);
  ctx.fillStyle = theme.soft;
  ctx.fillText(fitted(ctx, sign + unit, gutter - 52), 0, 16);
  ctx.strokeStyle = theme.rule;
  ctx.beginPath();
  ctx.moveTo(gutter - 0.5, 0);
  ctx.lineTo(gutter - 0.5, height);
  ctx.stroke();
}

class Line {
  constructor(told) {
    Object.assign(this, told);
    this.t = seconds(told.t);
    this.v = numbers(told.v);
  }
  // The indices in the range, and one more on both sides.
  inView() {
    return [Math.max(0, upper(this.t, view.from) - 1), Math.min(this.t.length, lower(this.t, view.to) + 1)];
  }
  bounds() {
    const [from, to] = this.inView(), v = this.v;
    let low = Infinity, high = -Infinity;
    for (let i = from; i < to; i++) {
      if (v[i] < low) low = v[i];
      if (v[i] > high) high = v[i];
    }
    return [low, high];
  }
  // Returns the value at a time: the last one; for a smooth quantity interpolated.
  at(moment) {
    const place = upper(this.t, moment) - 1;
    if (place < 0) return null;
    if (this.held || place + 1 >= this.t.length) return this.v[place];
    const span = this.t[place + 1] - this.t[place];
    const part = span > 0 ? (moment - this.t[place]) / span : 0;
    return this.v[place] + part * (this.v[place + 1] - this.v[place]);
  }
  draw(ctx, toY) {
    const [from, to] = this.inView(), count = to - from;
    if (count <= 0) return 0;
    ctx.strokeStyle = theme[this.role];
    ctx.setLineDash(dash[this.role]);
    ctx.lineWidth = this.role === "actual" ? 1.8 : 1.5;
    ctx.beginPath();
    if (count <= 3 * plotWidth) this.plain(ctx, toY, from, to); else this.columns(ctx, toY, from, to);
    ctx.stroke();
    ctx.setLineDash([]);
    if (count < plotWidth / 14) this.dots(ctx, toY, from, to);
    return count;
  }
  plain(ctx, toY, from, to) {
    let begun = false, y = 0;
    for (let i = from; i < to; i++) {
      if (Number.isNaN(this.v[i])) { begun = false; continue; }
      const x = toX(this.t[i]);
      if (begun && this.held) ctx.lineTo(x, y);
      y = toY(this.v[i]);
      if (begun) ctx.lineTo(x, y); else ctx.moveTo(x, y);
      begun = true;
    }
    if (begun && to === this.t.length) ctx.lineTo(toX(Math.min(view.to, SPAN)), y); // held to the end
  }
  columns(ctx, toY, from, to) {
    const scale = plotWidth / (view.to - view.from);
    let column = NaN, first = 0, low = 0, high = 0, last = 0, begun = false;
    const flush = () => {
      const x = gutter + column + 0.5;
      if (begun) ctx.lineTo(x, toY(first)); else ctx.moveTo(x, toY(first));
      ctx.lineTo(x, toY(low));
      ctx.lineTo(x, toY(high));
      ctx.lineTo(x, toY(last));
      begun = true;
    };
    for (let i = from; i < to; i++) {
      const x = Math.floor((this.t[i] - view.from) * scale), v = this.v[i];
      if (x !== column) {
        if (!Number.isNaN(column)) flush();
        column = x;
        first = low = high = v;
      } else if (v < low) low = v; else if (v > high) high = v;
      last = v;
    }
    if (!Number.isNaN(column)) flush();
  }
  dots(ctx, toY, from, to) {
    ctx.fillStyle = theme[this.role];
    for (let i = from; i < to; i++) {
      const x = toX(this.t[i]), y = toY(this.v[i]);
      ctx.beginPath();
      if (this.role === "demand" || this.role === "target") ctx.rect(x - 2.5, y - 2.5, 5, 5);
      else ctx.arc(x, y, 2.5, 0, 7);
      ctx.fill();
    }
  }
}

const ORDER = { target: 0, truth: 1, actual: 2, demand: 3 };

class QuantityPanel extends Panel {
  constructor(parent, motor, plot, height) {
    super(parent, `${motor}, ${plot.quantity} [${plot.unit}]: ${plot.lines.map((l) => l.name).join(", ")}`, height);
    this.plot = plot;
    this.lines = plot.lines.map((told) => new Line(told)).sort((a, b) => ORDER[a.role] - ORDER[b.role]);
    this.values = [];
    for (const line of [...this.lines].reverse()) {
      const row = make("div", this.reading, "", "line");
      row.append(sample(line.role));
      make("span", row, line.name, "name");
      this.values.push([line, make("span", row, "", "value")]);
      row.title = `${line.name}: ${line.source}, ${line.points.toLocaleString("en")} points`
        + (line.t.length < line.points ? `, ${line.t.length.toLocaleString("en")} drawn` : "");
    }
  }
  draw(ctx, width, height) {
    let low = Infinity, high = -Infinity;
    for (const line of this.lines) {
      const [l, h] = line.bounds();
      if (l < low) low = l;
      if (h > high) high = h;
    }
    if (!(low <= high)) { low = -1; high = 1; }
    const least = this.plot.quantity === "following error" ? 0 : 1e-9;
    const room = Math.max((high - low) * 0.07, Math.abs(high) * 1e-7, least, low === high ? 1e-3 * (Math.abs(low) || 1) : 0);
    low -= room;
    high += room;
    yAxis(ctx, height, low, high, this.plot.quantity, this.plot.unit);
    gridLines(ctx, height);
    clipPlot(ctx, height);
    const toY = (v) => height - 3 - (v - low) / (high - low) * (height - 6);
    let drawn = 0;
    for (const line of this.lines) drawn += line.draw(ctx, toY);
    ctx.restore();
    return drawn;
  }
  read(at) {
    for (const [line, element] of this.values) {
      const value = at === null ? null : line.at(at);
      const unit = this.plot.unit === "drive units" ? "" : this.plot.unit; // shown at the axis
      element.textContent = value === null ? "" : withUnit(value, unit, 6);
    }
  }
}

// Draws a line of the legend: colour, dashes and, if points are visible, their shape.
function sample(role) {
  const space = "http://www.w3.org/2000/svg", svg = document.createElementNS(space, "svg");
  svg.setAttribute("width", "26");
  svg.setAttribute("height", "8");
  svg.setAttribute("aria-hidden", "true");
  svg.style.setProperty("--c", `var(--${role})`);
  const path = document.createElementNS(space, "path");
  path.setAttribute("d", "M0 4H26");
  path.setAttribute("stroke", "currentColor");
  path.setAttribute("stroke-width", "2");
  path.setAttribute("stroke-dasharray", dash[role].join(" "));
  svg.append(path);
  const dot = document.createElementNS(space, role === "demand" || role === "target" ? "rect" : "circle");
  const own = dot.tagName === "rect" ? { x: 10, y: 1.2, width: 5.6, height: 5.6 } : { cx: 13, cy: 4, r: 2.8 };
  for (const [name, value] of Object.entries(own)) dot.setAttribute(name, value);
  dot.setAttribute("fill", "currentColor");
  svg.append(dot);
  return svg;
}
