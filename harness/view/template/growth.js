// Growth of the picture: news appended to lines, traffic, bars, groups and incidents.
const owned = new WeakSet(); // buffers with room for more

// Returns the first `keep` values of an array and then `more`; the work is proportional to `more`.
function joined(old, keep, more, kind = old.constructor) {
  const n = keep + more.length, size = kind.BYTES_PER_ELEMENT;
  let buffer = old.buffer;
  const fits = owned.has(buffer) && old.constructor === kind && buffer.byteLength >= n * size;
  if (!fits) {
    buffer = new ArrayBuffer(Math.max(512, 2 * n) * size);
    owned.add(buffer);
  }
  const out = new kind(buffer, 0, n);
  if (!fits) out.set(old.subarray(0, keep));
  out.set(more, keep);
  return out;
}

Line.prototype.grow = function (told, tick_s) {
  const t = seconds(told.t, tick_s), keep = lower(this.t, t[0] - tick_s - time.tick_s);
  this.t = joined(this.t, keep, t);
  this.v = joined(this.v, keep, numbers(told.v));
  this.points += Math.max(1, told.points - 1);
};

Traffic.prototype.grow = function (told, tick_s) {
  const ends = seconds(told.t, tick_s), amounts = whole(told.weight), n = this.ends.length;
  const counts = this.counts || new Uint32Array(n).fill(1);
  this.ends = joined(this.ends, n, ends);
  this.keys = joined(this.keys, n, whole(told.key), Uint32Array);
  this.amounts = joined(this.amounts, n, amounts, Uint32Array);
  this.counts = joined(counts, n, whole(told.count), Uint32Array);
  const sums = new Float64Array(amounts.length);
  let sum = this.sums[n];
  for (let i = 0; i < sums.length; i++) { sum += amounts[i]; sums[i] = sum; }
  this.sums = joined(this.sums, n + 1, sums);
  this.frames += told.frames;
};

// The bars that were open at `until` are replaced by those of the news, or last to the present.
TimelinePanel.prototype.grow = function (told, tick_s, until) {
  const early = until - tick_s - time.tick_s;
  for (const row of this.rows) {
    const n = row.to.length;
    for (let i = Math.max(0, n - 8); i < n; i++) if (row.to[i] >= early) row.to[i] = SPAN;
  }
  for (const fresh of told.rows) {
    const row = this.rows.find((one) => one.name === fresh.name);
    if (row) this.replaceOpen(row, barsOf(fresh, tick_s, told.words), early, told);
  }
};

TimelinePanel.prototype.replaceOpen = function (row, fresh, early, told) {
  const bars = [];
  for (let i = 0; i < row.from.length; i++) {
    const bar = { from: row.from[i], to: row.to[i], waits: row.waits[i], word: this.told.words[row.word[i]], text: row.texts[row.text[i]] };
    if (bar.to < early) { bars.push(bar); continue; }
    const next = fresh.find((one) => one.waits === bar.waits);
    if (!next || bar.from >= next.from - 1e-6) continue;
    if (next.word === bar.word) next.from = bar.from; else bars.push({ ...bar, to: next.from });
  }
  bars.push(...fresh);
  bars.sort((a, b) => a.from - b.from || a.waits - b.waits);
  row.texts = [...new Set(bars.map((bar) => bar.text))];
  row.from = Float64Array.from(bars, (bar) => bar.from);
  row.to = Float64Array.from(bars, (bar) => bar.to);
  row.waits = Uint8Array.from(bars, (bar) => bar.waits);
  row.text = Uint32Array.from(bars, (bar) => row.texts.indexOf(bar.text));
  row.word = Uint32Array.from(bars, (bar) => this.number(bar.word, told));
};

// Returns the number of a word; a new word gets one, and a place in the legend.
TimelinePanel.prototype.number = function (word, told) {
  let found = this.told.words.indexOf(word);
  if (found < 0) {
    found = this.told.words.push(word) - 1;
    this.told.tones.push(told.tones[told.words.indexOf(word)]);
  }
  if (!this.known.has(found)) {
    this.known.add(found);
    const list = this.row.parentElement.querySelector(".swatches");
    if (list && list.children.length < 24) {
      swatch(list, this.told, found);
      redrawn[redrawn.length - 1]();
    }
  }
  return found;
};

function barsOf(row, tick_s, words) {
  const from = seconds(row.from, tick_s), to = seconds(row.to, tick_s);
  const word = whole(row.word), waits = whole(row.waits), text = whole(row.text);
  return [...from].map((begin, i) => ({ from: begin, to: to[i], waits: waits[i], word: words[word[i]], text: row.texts[text[i]] }));
}

// The lines by motor, plot and place; each panel sorts its own.
let lines = new Map();
function indexLines() {
  lines = new Map();
  const quantities = panels.filter((panel) => panel instanceof QuantityPanel);
  report.motors.forEach((motor, m) => motor.plots.forEach((plot, p) => plot.lines.forEach((told, n) => {
    const panel = quantities.find((one) => one.plot === plot);
    lines.set([m, p, n].join(), panel.lines.find((line) => line.name === told.name && line.role === told.role));
  })));
  for (const panel of panels) {
    if (panel instanceof TimelinePanel) panel.known = new Set(panel.rows.flatMap((row) => [...row.word]));
  }
}

// Appends the news of one event; returns its incidents with times in seconds.
function grow(news) {
  const tick_s = news.time.tick_s, until = SPAN;
  SPAN = news.time.span * tick_s;
  for (const told of news.lines) lines.get(told.at.join()).grow(told, tick_s);
  for (const told of news.traffic) traffics[told.at].grow(told, tick_s);
  const shown = panels.filter((panel) => panel instanceof TimelinePanel);
  for (const told of news.timelines) {
    const panel = shown.find((one) => one.told.title === told.title);
    if (panel) panel.grow(told, tick_s, until);
  }
  for (const told of news.groups) {
    const panel = panels.find((one) => one instanceof GroupPanel && one.group.name === told.name);
    for (const one of told.moments) panel.group.moments.push({ ...one, at: one.at * tick_s / time.tick_s });
    panel.scale();
  }
  return news.incidents ? growIncidents(news.incidents, tick_s) : [];
}

function growIncidents(told, tick_s) {
  report.incidents.counts.splice(0, told.counts.length, ...told.counts);
  const fresh = told.list.map(([ticks_, ...rest]) => [ticks_ * tick_s / time.tick_s, ...rest]);
  report.incidents.list.push(...fresh);
  return fresh.map(([at, severity, kind, place, text]) => ({ at: at * time.tick_s, severity, kind: told.kinds[kind], place, text }));
}
