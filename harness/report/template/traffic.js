// Load of buses and lines: in total and by identifier.
const ROWS_MAX = 64;

class Traffic {
  constructor(told) {
    Object.assign(this, told);
    this.ends = seconds(told.t);
    this.keys = whole(told.key);
    this.amounts = whole(told.weight);
    this.counts = told.count && typeof told.count === "object" ? whole(told.count) : null;
    const n = this.ends.length;
    this.sums = new Float64Array(n + 1);
    for (let i = 0; i < n; i++) this.sums[i + 1] = this.sums[i] + this.amounts[i];
    this.isShare = this.capacity_s !== null && time.kind !== "order";
  }
  // Returns the duration of an entry: of its bits on a bus; of a cell, the common cell width.
  lasted(i) {
    if (this.cell_s) return this.cell_s;
    return this.isShare ? this.amounts[i] / this.capacity_s : 0;
  }
  // Returns the amount until a time; an entry in progress counts in part.
  until(at) {
    const place = lower(this.ends, at);
    if (place >= this.ends.length) return this.sums[place];
    const lasted = this.lasted(place), left = this.ends[place] - at;
    const part = lasted > 0 ? Math.max(0, 1 - left / lasted) : 0;
    return this.sums[place] + part * this.amounts[place];
  }
  // Returns the load in a stretch of time: a share, or a rate if the capacity is unknown.
  load(from, to) {
    const rate = (this.until(to) - this.until(from)) / Math.max(1e-12, to - from);
    return this.isShare ? rate / this.capacity_s : rate;
  }
  get shortest() { return Math.max(this.isShare ? 0 : 1e-3, this.cell_s); }
  say(load) { return this.isShare ? `${short(load * 100, 3)} %` : withUnit(load, "bit/s", 3); }
  // Returns [amount, count] by label in the range.
  byLabel(from, to) {
    const amounts = new Float64Array(this.labels.length), counts = new Float64Array(this.labels.length);
    const last = upper(this.ends, to);
    for (let i = upper(this.ends, from); i < last; i++) {
      amounts[this.keys[i]] += this.amounts[i];
      counts[this.keys[i]] += this.counts ? this.counts[i] : 1;
    }
    return [amounts, counts];
  }
}

class LoadPanel extends Panel {
  constructor(parent, traffic) {
    super(parent, `load of ${traffic.name} over time`, 62);
    this.traffic = traffic;
    this.lines = [0, 1, 2].map(() => make("div", this.reading, "", "line"));
    for (const line of this.lines) {
      make("span", line, "", "name");
      make("span", line, "", "value");
    }
  }
  tell(n, name, value) {
    this.lines[n].children[0].textContent = name;
    this.lines[n].children[1].textContent = value;
  }
  draw(ctx, width, height) {
    const traffic = this.traffic, pixel = (view.to - view.from) / width;
    const window_s = Math.max(pixel, traffic.shortest);
    this.window_s = window_s;
    const loads = new Float64Array(width + 1);
    let top = 0;
    for (let x = 0; x <= width; x++) {
      const middle = view.from + x * pixel;
      loads[x] = traffic.load(middle - window_s / 2, middle + window_s / 2);
      if (loads[x] > top) { top = loads[x]; this.topAt = middle; }
    }
    this.top = top;
    const factor = traffic.isShare ? 100 : 1;
    const high = Math.max(top * factor * 1.1, traffic.isShare ? 1 : 1);
    yAxis(ctx, height, 0, high, `${traffic.name} load`, traffic.isShare ? "%" : "bit/s");
    gridLines(ctx, height);
    clipPlot(ctx, height);
    const toY = (load) => height - 3 - load * factor / high * (height - 6);
    ctx.beginPath();
    ctx.moveTo(gutter, toY(0));
    for (let x = 0; x <= width; x++) ctx.lineTo(gutter + x, toY(loads[x]));
    ctx.lineTo(gutter + width, toY(0));
    ctx.globalAlpha = 0.25;
    ctx.fillStyle = theme.actual;
    ctx.fill();
    ctx.globalAlpha = 1;
    ctx.strokeStyle = theme.actual;
    ctx.lineWidth = 1.3;
    ctx.stroke();
    ctx.restore();
    return upper(traffic.ends, view.to) - lower(traffic.ends, view.from);
  }
  ranged() {
    const traffic = this.traffic, from = Math.max(0, view.from), to = Math.min(SPAN, view.to);
    this.tell(0, "shown range, on average", traffic.say(traffic.load(from, to)));
    this.tell(1, `highest in ${spanText(this.window_s)}`, traffic.say(this.top || 0));
    this.read(null);
  }
  read(at) {
    const text = at === null ? "" : this.traffic.say(this.traffic.load(at - this.window_s / 2, at + this.window_s / 2));
    this.tell(2, at === null ? "" : "at the cursor", text);
  }
}

class IdentifierPanel extends Panel {
  constructor(parent, traffic) {
    const shown = rowsOf(traffic);
    super(parent, `load of ${traffic.name} by ${traffic.kind === "CAN" ? "identifier" : "request"}`, shown.rows.length * 13 + 4);
    this.traffic = traffic;
    Object.assign(this, shown);
    this.top = make("div", this.reading);
  }
  draw(ctx, width, height) {
    const traffic = this.traffic, rows = this.rows.length, scale = width / (view.to - view.from);
    const cells = new Float32Array(rows * width), bars = [];
    const first = lower(traffic.ends, view.from);
    let last = traffic.ends.length, drawn = 0;
    for (let i = first; i < last; i++) {
      const row = this.rowOf[traffic.keys[i]], lasted = traffic.lasted(i);
      const begin = (traffic.ends[i] - lasted - view.from) * scale;
      if (begin > width) { if (traffic.ends[i] - lasted > view.to + 1) break; else continue; }
      drawn++;
      const long = lasted * scale;
      if (long >= 2 || (!lasted && i - first < 2 && traffic.ends.length < 3)) { bars.push(row, begin, Math.max(2, long)); continue; }
      const x = Math.floor((traffic.ends[i] - view.from) * scale);
      if (x >= 0 && x < width) cells[row * width + x] += traffic.amounts[i];
    }
    gridLines(ctx, height);
    this.names(ctx, width);
    this.heat(ctx, cells, rows, width);
    clipPlot(ctx, height);
    ctx.fillStyle = theme.actual;
    for (let i = 0; i < bars.length; i += 3) ctx.fillRect(gutter + bars[i + 1], bars[i] * 13 + 3, bars[i + 2] - 0.5, 10);
    ctx.restore();
    return drawn;
  }
  names(ctx, width) {
    ctx.textBaseline = "middle";
    ctx.textAlign = "left";
    this.rows.forEach((row, n) => {
      const y = n * 13 + 8.5;
      ctx.fillStyle = theme.ink;
      ctx.fillText(row.label, 0, y);
      const used = ctx.measureText(row.label).width + 5;
      ctx.fillStyle = theme.soft;
      ctx.fillText(fitted(ctx, row.name, gutter - used - 6), used, y);
      ctx.fillStyle = theme.grid;
      ctx.fillRect(gutter, n * 13 + 14, width, 0.5);
    });
  }
  // Stronger colours are higher loads; the lowest load is still visible.
  heat(ctx, cells, rows, width) {
    let most = 0;
    for (let i = 0; i < cells.length; i++) if (cells[i] > most) most = cells[i];
    if (!most || !rows) return;
    const value = parseInt(theme.actual.slice(1), 16), image = new ImageData(width, rows);
    for (let i = 0; i < cells.length; i++) {
      if (!cells[i]) continue;
      image.data[4 * i] = value >> 16;
      image.data[4 * i + 1] = value >> 8 & 255;
      image.data[4 * i + 2] = value & 255;
      image.data[4 * i + 3] = 70 + 185 * Math.sqrt(cells[i] / most);
    }
    const small = document.createElement("canvas");
    small.width = width;
    small.height = rows;
    small.getContext("2d").putImageData(image, 0, 0);
    ctx.imageSmoothingEnabled = false;
    for (let row = 0; row < rows; row++) ctx.drawImage(small, 0, row, width, 1, gutter, row * 13 + 3, width, 10);
  }
  ranged() {
    const from = Math.max(0, view.from), to = Math.min(SPAN, view.to), span = Math.max(1e-12, to - from);
    const [amounts, counts] = this.traffic.byLabel(from, to);
    const order = [...amounts.keys()].filter((n) => counts[n]).sort((a, b) => amounts[b] - amounts[a]);
    const room = Math.max(1, Math.floor(this.height / 16));
    this.top.replaceChildren();
    for (const n of order.slice(0, room)) {
      const row = make("div", this.top, "", "line");
      const rate = time.kind === "order" ? `${counts[n]}` : `${short(counts[n] / span, 3)}/s`;
      make("span", row, `${this.traffic.labels[n]} ${this.traffic.names[n]}`, "name");
      const load = amounts[n] / span / (this.traffic.isShare ? this.traffic.capacity_s : 1);
      make("span", row, time.kind === "order" ? rate : `${this.traffic.say(load)} · ${rate}`, "value");
    }
  }
}

// Returns the labels with their own row, in order of priority; the rest shares the last row.
function rowsOf(traffic) {
  const count = traffic.labels.length, rowOf = new Uint16Array(Math.max(1, count));
  const rows = [];
  let own = [...Array(count).keys()];
  if (count > ROWS_MAX) {
    const [amounts] = traffic.byLabel(-1, SPAN);
    own = own.sort((a, b) => amounts[b] - amounts[a]).slice(0, ROWS_MAX - 1).sort((a, b) => a - b);
    rowOf.fill(ROWS_MAX - 1);
  }
  own.forEach((label, row) => {
    rowOf[label] = row;
    rows.push({ label: traffic.labels[label], name: traffic.names[label] });
  });
  if (count > ROWS_MAX) rows.push({ label: `${count - own.length} others`, name: "together" });
  return { rows, rowOf };
}
