// Detail: more points of the range shown, which the server gives once the range stands still.
const detail = { timer: 0, from: 0, to: -1 };
const DETAIL_AFTER_MS = 200;

// Draws from the detail where it covers the range, otherwise from what all events have told.
Line.prototype.choose = function () {
  if (!this.coarse) return;
  const fine = this.fine && view.from >= this.fine.from && view.to <= this.fine.to ? this.fine : this.coarse;
  this.t = fine.t;
  this.v = fine.v;
};

const growCoarse = Line.prototype.grow;
Line.prototype.grow = function (told, tick_s) {
  if (this.coarse) Object.assign(this, { t: this.coarse.t, v: this.coarse.v });
  growCoarse.call(this, told, tick_s);
  if (!this.coarse) return;
  this.coarse = { t: this.t, v: this.v };
  this.choose();
};

function rangeDetail() {
  for (const line of lines.values()) line.choose();
  clearTimeout(detail.timer);
  if (!live.follows || live.link === "complete") detail.timer = setTimeout(askDetail, DETAIL_AFTER_MS);
}

async function askDetail() {
  const { from, to } = view, wide = to - from;
  const isReduced = [...lines.values()].some((line) => (line.coarse || line).t.length < line.points);
  if (!isReduced || wide >= SPAN / 2 || (from >= detail.from && to <= detail.to)) return;
  const asked = { from: Math.max(0, from - wide / 2), to: Math.min(SPAN, to + wide / 2) };
  try {
    const answer = await fetch(`stretch${location.search}&from=${asked.from}&to=${asked.to}`);
    if (!answer.ok) return;
    const text = await answer.text();
    live.queue = live.queue.then(() => takeDetail(text, asked)).catch((error) => { fail(String(error)); });
  } catch { /* the server has left: the page shows what it has */ }
}

async function takeDetail(text, asked) {
  const told = await opened(text);
  Object.assign(detail, asked);
  for (const one of told.lines) {
    const line = lines.get(one.at.join());
    if (!line) continue;
    if (!line.coarse) line.coarse = { t: line.t, v: line.v };
    line.fine = { ...asked, t: seconds(one.t, told.time.tick_s), v: numbers(one.v) };
    line.choose();
  }
  document.documentElement.dataset.detail = `${asked.from},${asked.to}`;
  redraw();
}

function forgetDetail() {
  Object.assign(detail, { from: 0, to: -1 });
}
