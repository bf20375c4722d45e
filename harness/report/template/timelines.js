// Rows of bars (states, locks), skew of groups, and incidents.
const ROW = 15;

function fillOf(ctx, tone, word, waits) {
  const colour = tone ? theme[tone] : theme["n" + word % 8];
  if (waits) return hatch(ctx, theme.paper, colour, "line");
  if (tone === "fault") return hatch(ctx, theme.fault, theme.paper, "cross");
  if (tone === "stop") return hatch(ctx, theme.stop, theme.paper, "line");
  if (!tone && word >= 8) return hatch(ctx, colour, theme.paper, "line");
  return colour;
}

class TimelinePanel extends Panel {
  constructor(parent, told) {
    super(parent, `${told.title}: ${told.about}`, 0);
    this.told = told;
    this.reading.classList.add("rows");
    this.rows = told.rows.map((row) => ({
      name: row.name, from: seconds(row.from), to: seconds(row.to), word: whole(row.word),
      waits: whole(row.waits), text: whole(row.text), texts: row.texts,
    }));
    this.height = 4;
    this.lines = this.rows.map((row) => { // waiting processes are below the owner
      row.y = this.height - 2;
      const long = row.waits.some((waits, i) => waits && row.to[i] - row.from[i] > SPAN / 500);
      row.high = long ? ROW + 7 : ROW;
      this.height += row.high;
      const line = make("div", this.reading, "", "line");
      line.style.height = line.style.lineHeight = row.high + "px";
      return make("span", line, "", "name");
    });
  }
  draw(ctx, width, height) {
    gridLines(ctx, height);
    let drawn = 0;
    this.rows.forEach((row) => {
      const y = row.y;
      ctx.textBaseline = "middle";
      ctx.textAlign = "left";
      ctx.fillStyle = theme.ink;
      ctx.fillText(fitted(ctx, row.name, gutter - 8), 0, y + ROW / 2);
      clipPlot(ctx, height);
      drawn += this.bars(ctx, row, y);
      ctx.restore();
    });
    return drawn;
  }
  bars(ctx, row, y) {
    let drawn = 0, painted = -1;
    const last = upper(row.from, view.to);
    for (let i = 0; i < last; i++) {
      if (row.to[i] < view.from) continue;
      drawn++;
      const from = Math.max(gutter - 3, toX(row.from[i])), to = Math.min(gutter + plotWidth + 3, toX(row.to[i]));
      const waits = row.waits[i] === 1, tone = this.told.tones[row.word[i]];
      if (to - from < 0.5 && Math.floor(from) === painted && tone !== "fault") continue; // hidden by the previous one
      painted = Math.floor(from);
      ctx.fillStyle = fillOf(ctx, tone, row.word[i], waits);
      const high = waits ? 6 : ROW - 3, top = waits ? y + row.high - 9 : y;
      ctx.fillRect(from, top, Math.max(1, to - from), high);
      if (to - from > 4) {
        ctx.fillStyle = theme.paper;
        ctx.fillRect(to - 0.5, top, 0.5, high);
      }
      if (to - from > 26 && !waits) this.label(ctx, this.told.words[row.word[i]], tone, row.word[i], from, to, y);
    }
    return drawn;
  }
  label(ctx, word, tone, number, from, to, y) {
    const text = fitted(ctx, word, to - from - 8);
    if (!text) return;
    if (tone === "fault" || tone === "stop") {
      ctx.fillStyle = theme[tone];
      ctx.fillRect(from + 2, y, ctx.measureText(text).width + 4, ROW - 3);
    }
    ctx.fillStyle = inkOn(tone ? theme[tone] : theme["n" + number % 8]);
    ctx.fillText(text, from + 4, y + ROW / 2 - 1);
  }
  read(at, x, y) {
    this.rows.forEach((row, n) => {
      let text = "", title = "";
      if (at !== null) {
        for (let i = upper(row.from, at) - 1, looked = 0; i >= 0 && looked < 50; i--, looked++) {
          if (row.to[i] <= at && !(row.to[i] >= SPAN && at >= SPAN)) continue;
          const word = this.told.words[row.word[i]], own = row.texts[row.text[i]];
          text = row.waits[i] ? (text ? text + "; " : "") + own : (own && this.told.title === "Locks" ? own : word) + (text ? "; " + text : "");
          title = `${text}: ${timeText(row.from[i])} to ${timeText(row.to[i])} (${spanText(row.to[i] - row.from[i])}) ${own}`;
          if (!row.waits[i]) break;
        }
      }
      this.lines[n].textContent = text;
      this.lines[n].title = title;
    });
  }
}

// The legend of the words; for states, used if a bar is too narrow for its word.
function legend(parent, told) {
  const used = new Set();
  for (const row of told.rows) for (const word of whole(row.word)) used.add(word);
  const list = make("div", parent, "", "swatches");
  for (const word of [...used].sort((a, b) => a - b).slice(0, 24)) swatch(list, told, word);
}

function swatch(list, told, word) {
  const item = make("span", list);
  const canvas = make("canvas", item);
  canvas.width = 16;
  canvas.height = 11;
  redrawn.push(() => {
    const ctx = canvas.getContext("2d");
    ctx.fillStyle = fillOf(ctx, told.tones[word], word, false);
    ctx.fillRect(0, 0, 16, 11);
  });
  make("span", item, told.words[word]);
}
const redrawn = []; // redrawn when the theme changes

class GroupPanel extends Panel {
  constructor(parent, group) {
    super(parent, `group ${group.name}: skew`, 74);
    this.group = group;
    this.lines = [0, 1, 2, 3, 4].map(() => {
      const line = make("div", this.reading, "", "line");
      make("span", line, "", "name");
      make("span", line, "", "value");
      return line;
    });
    this.scale();
  }
  scale() {
    let low = Infinity, high = 0;
    for (const one of this.group.moments) {
      for (const value of [one.skew_s, one.predicted_s]) {
        if (value > 0) { low = Math.min(low, value); high = Math.max(high, value); }
      }
    }
    this.low = Number.isFinite(low) ? Math.max(-9, Math.floor(Math.log10(low) - 0.01)) : -6; // below 1 ns is 0
    this.high = Math.max(this.low + 1, high > 0 ? Math.ceil(Math.log10(high) + 0.01) : -3);
  }
  draw(ctx, width, height) {
    const rows = this.high - this.low + 1; // the lowest is for 0
    const toY = (value) => {
      const level = value >= 10 ** this.low ? Math.log10(value) - this.low + 1 : 0.35;
      return height - 4 - level / rows * (height - 10);
    };
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    const every = Math.ceil(rows / 4);
    for (let power = this.low; power <= this.high; power++) {
      const y = Math.round(toY(10 ** power)) + 0.5;
      ctx.fillStyle = theme.grid;
      ctx.fillRect(gutter, y, width, 1);
      ctx.fillStyle = theme.soft;
      if ((this.high - power) % every === 0 && y < toY(0) - 11) ctx.fillText(withUnit(10 ** power, "s", 1), gutter - 6, y);
    }
    ctx.fillStyle = theme.soft;
    ctx.fillText("0", gutter - 6, toY(0));
    ctx.textAlign = "left";
    ctx.textBaseline = "top";
    ctx.fillStyle = theme.ink;
    ctx.fillText(fitted(ctx, this.group.name, gutter - 60), 0, 2);
    ctx.fillStyle = theme.soft;
    ctx.fillText("skew", 0, 16);
    gridLines(ctx, height);
    clipPlot(ctx, height);
    let drawn = 0;
    for (const one of this.group.moments) {
      const x = toX(one.at * time.tick_s);
      if (x < gutter - 10 || x > gutter + width + 10) continue;
      drawn++;
      if (one.predicted_s !== null) this.shape(ctx, x, toY(one.predicted_s), one.start ? "bound" : "predicted");
      if (one.skew_s !== null) this.shape(ctx, x, toY(one.skew_s), one.start ? "start" : "end");
    }
    ctx.restore();
    return drawn;
  }
  shape(ctx, x, y, what) { groupShape(ctx, x, y, what); }
  read(at) {
    const rows = [];
    if (at !== null) {
      let best = Infinity;
      for (const one of this.group.moments) best = Math.min(best, Math.abs(one.at * time.tick_s - at));
      const near = this.group.moments.filter((one) => Math.abs(one.at * time.tick_s - at) <= best + 1e-9);
      if (near.length) rows.push(["reported at", timeText(near[0].at * time.tick_s, 1e-3)]);
      for (const one of near) {
        const name = one.start ? "start, measured" : "end, measured";
        rows.push([name, one.skew_s === null ? "not known" : withUnit(one.skew_s, "s", 4), one]);
        const bound = one.start ? "start, at most" : "end, predicted";
        if (one.predicted_s !== null) rows.push([bound, withUnit(one.predicted_s, "s", 4), one]);
      }
    }
    this.lines.forEach((line, n) => {
      const [name, value, one] = rows[n] || ["", "", null];
      line.children[0].textContent = name;
      line.children[1].textContent = value;
      line.title = one ? one.motors.map((m, k) => `${m} +${withUnit(one.offsets_s[k] || 0, "s", 4)}`).join(", ") + `; ${one.method}` : "";
    });
  }
}

function groupShape(ctx, x, y, what) {
  ctx.lineWidth = 1.6;
  ctx.beginPath();
  if (what === "start") ctx.arc(x, y, 3.2, 0, 7);
  else if (what === "bound") ctx.arc(x, y, 4.5, 0, 7);
  else if (what === "end") ctx.rect(x - 3, y - 3, 6, 6);
  else { ctx.moveTo(x, y - 4.5); ctx.lineTo(x + 4.5, y); ctx.lineTo(x, y + 4.5); ctx.lineTo(x - 4.5, y); ctx.closePath(); }
  if (what === "predicted" || what === "bound") { ctx.strokeStyle = theme.demand; ctx.stroke(); return; }
  ctx.fillStyle = what === "start" ? theme.actual : theme.truth;
  ctx.fill();
}

class IncidentPanel extends Panel {
  constructor(parent, told) {
    super(parent, "faults and events", told.kinds.length * ROW + 6);
    this.told = told;
    this.reading.classList.add("rows");
    this.lines = told.kinds.map((kind, n) => {
      const line = make("div", this.reading, "", "line");
      line.style.height = line.style.lineHeight = ROW + "px";
      return make("span", line, `${told.counts[n].toLocaleString("en")} in all`, "name");
    });
  }
  draw(ctx, width, height) {
    gridLines(ctx, height);
    ctx.textBaseline = "middle";
    ctx.textAlign = "left";
    this.told.kinds.forEach((kind, n) => {
      ctx.fillStyle = theme.ink;
      ctx.fillText(fitted(ctx, kind, gutter - 8), 0, n * ROW + 3 + ROW / 2);
    });
    clipPlot(ctx, height);
    let drawn = 0;
    for (const worst of [0, 1, 2]) { // the most severe on top
      for (const [ticks_, severity, kind] of this.told.list) {
        if (severity !== worst) continue;
        const x = toX(ticks_ * time.tick_s);
        if (x < gutter - 8 || x > gutter + width + 8) continue;
        drawn++;
        incidentShape(ctx, x, kind * ROW + 3 + ROW / 2, severity);
      }
    }
    ctx.restore();
    return drawn;
  }
  read(at, x, y) {
    const list = this.told.list, near = this.told.kinds.map(() => null);
    const reach = (view.to - view.from) / plotWidth * 6;
    if (at !== null) {
      for (const one of list) {
        const off = Math.abs(one[0] * time.tick_s - at);
        if (off <= reach && (!near[one[2]] || off < Math.abs(near[one[2]][0] * time.tick_s - at))) near[one[2]] = one;
      }
    }
    near.forEach((one, n) => {
      this.lines[n].textContent = one ? one[4] : `${this.told.counts[n].toLocaleString("en")} in all`;
      this.lines[n].title = one ? `${timeText(one[0] * time.tick_s)} ${one[3]}: ${one[4]}` : "";
    });
  }
}

function incidentShape(ctx, x, y, severity) {
  ctx.beginPath();
  if (severity === 0) {
    ctx.fillStyle = theme.soft;
    ctx.arc(x, y, 2.5, 0, 7);
  } else if (severity === 1) {
    ctx.fillStyle = theme.stop;
    ctx.moveTo(x, y - 5); ctx.lineTo(x + 4.5, y); ctx.lineTo(x, y + 5); ctx.lineTo(x - 4.5, y);
  } else {
    ctx.fillStyle = theme.fault;
    ctx.moveTo(x, y - 6); ctx.lineTo(x + 6, y + 5); ctx.lineTo(x - 6, y + 5);
  }
  ctx.fill();
}
