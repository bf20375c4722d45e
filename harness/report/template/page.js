// The page: its sections, the range of time, the cursor, keys and pointer.
const $ = (id) => document.getElementById(id);
const charts = $("charts");
let traffics = [], cursor = null, mark = null, asked = false;

function section(id, title, about, open = true) {
  const element = make("section", charts);
  element.id = id;
  const holder = make("details", element);
  holder.open = open;
  const summary = make("summary", holder);
  make("h2", summary, title);
  if (about) make("span", summary, " " + about, "about");
  holder.addEventListener("toggle", () => redraw());
  const link = make("a", $("places"), title);
  link.href = "#" + id;
  link.addEventListener("click", (event) => {
    event.preventDefault();
    holder.open = true;
    element.scrollIntoView();
    redraw();
  });
  return holder;
}

function head() {
  document.querySelector("h1").textContent = report.title;
  const facts = [...report.facts];
  const length = time.kind === "order" ? spanText(SPAN) : `${short(SPAN, 6)} s`;
  facts.unshift(["length", length]);
  if (time.kind === "wall") facts.unshift(["begins", wall(0).toISOString().replace("T", " ").replace("Z", " UTC")]);
  facts.push(["motors", String(report.motors.length)]);
  for (const [name, value] of facts) {
    const pair = make("div", $("facts"));
    make("dt", pair, name);
    make("dd", pair, value);
  }
  for (const note of report.notes) make("li", $("notes"), note);
}

function build() {
  const [states, locks, nmt, modes] = report.timelines;
  traffics = report.traffic.map((told) => new Traffic(told));
  if (report.incidents.list.length) {
    const holder = section("incidents", "Faults and events", "▲ error ◆ warning ● information");
    new IncidentPanel(holder, report.incidents);
  }
  addTimeline("states", states, true);
  if (traffics.length) {
    const holder = section("load", "Bus load", "each frame counts while its bits are on the bus");
    for (const traffic of traffics) {
      new LoadPanel(holder, traffic);
      if (traffic.why) make("div", holder, `${traffic.name}: load in bit/s, for ${traffic.why}`, "missing");
      if (traffic.cell_s) make("div", holder, `${traffic.name}: ${traffic.frames.toLocaleString("en")} frames, summed up over ${spanText(traffic.cell_s)}`, "missing");
    }
  }
  if (report.groups.length) {
    const holder = section("groups", "Group skew", "● start measured, ■ end measured, ◇ end predicted; at the time at which the group was told");
    for (const group of report.groups) new GroupPanel(holder, group);
  }
  addTimeline("locks", locks, true);
  if (report.motors.length) motorSections();
  if (traffics.length) {
    const holder = section("identifiers", "Bus load by identifier", "darker is more; in the order of priority");
    for (const traffic of traffics) {
      make("h3", holder, traffic.name);
      make("span", holder, ` ${traffic.kind}, ${traffic.frames.toLocaleString("en")} frames`, "about");
      new IdentifierPanel(holder, traffic);
    }
  }
  addTimeline("nmt", nmt, nmt.rows.length <= 20);
  addTimeline("modes", modes, false);
}

function addTimeline(id, told, open) {
  if (!told.rows.length) return;
  const holder = section(id, told.title, told.about, open);
  legend(holder, told);
  new TimelinePanel(holder, told);
  for (const row of told.rows) {
    if (row.left_out) make("div", holder, `${row.name}: ${row.left_out} bars more are not shown`, "missing");
  }
}

const HEIGHTS = { position: 66, velocity: 54, "following error": 54, torque: 54 };
const hiddenQuantities = new Set(["torque"]);

function motorSections() {
  const holder = section("motors", "Motors", "");
  for (const motor of report.motors) {
    const element = make("section", holder, "", "motor");
    element.dataset.motor = motor.name;
    const top = make("header", element);
    make("h3", top, motor.name);
    make("span", top, [motor.about, ...summaryOf(motor)].filter(Boolean).join(" · "), "about").title = motor.scale;
    for (const plot of motor.plots) {
      const box = make("div", element);
      box.dataset.quantity = plot.quantity;
      if (plot.lines.length) new QuantityPanel(box, motor.name, plot, HEIGHTS[plot.quantity]);
      else make("div", box, plot.missing, "missing");
    }
  }
  for (const quantity of Object.keys(HEIGHTS)) {
    const button = make("button", $("quantities"), quantity);
    button.type = "button";
    const show = () => {
      button.setAttribute("aria-pressed", String(!hiddenQuantities.has(quantity)));
      for (const box of holder.querySelectorAll(`[data-quantity="${quantity}"]`)) box.hidden = hiddenQuantities.has(quantity);
    };
    button.addEventListener("click", () => {
      if (!hiddenQuantities.delete(quantity)) hiddenQuantities.add(quantity);
      show();
      redraw();
    });
    show();
  }
  $("filter").addEventListener("input", () => {
    const words = $("filter").value.toLowerCase();
    for (const element of holder.querySelectorAll(".motor")) element.hidden = !element.dataset.motor.toLowerCase().includes(words);
    redraw();
  });
}

function summaryOf(motor) {
  const told = motor.summary, out = [];
  if (told.position) out.push(`travel ${withUnit(told.position.value, told.position.unit, 4)}`);
  if (told.velocity) out.push(`top speed ${withUnit(told.velocity.value, told.velocity.unit, 3)}`);
  const error = told["following error"];
  if (error) out.push(`largest following error ${withUnit(error.value, error.unit, 3)} at ${timeText(error.at * time.tick_s, 1e-3)}`);
  return out;
}

// ------------------------------------------------------------------------------- drawing

function layout() {
  gutter = innerWidth < 800 ? 92 : 150;
  const canvas = panels.find((panel) => panel.row.offsetParent);
  const room = canvas ? canvas.row.clientWidth - (innerWidth > 800 ? 250 : 0) : charts.clientWidth - 32;
  plotWidth = Math.max(120, Math.floor(room - gutter));
}

// All that can be seen, or everything: at first, and before it is printed.
function redraw(everything = false) {
  for (const panel of panels) panel.stale = true;
  if (everything) paint(true);
  else ask();
}

function ask() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; paint(false); });
}

function paint(everything) {
  const begun = performance.now();
  drawAxis();
  drawOverview();
  for (const panel of panels) if (panel.stale && (everything || panel.visible())) panel.paint();
  placeCursor();
  document.documentElement.dataset.drawMs = (performance.now() - begun).toFixed(1);
}

function rangeChanged() {
  const by = Math.min(1e-3, step(view.to - view.from, 1000));
  const shift = time.begin_s, places = digits(by);
  if (document.activeElement !== $("from")) $("from").value = (view.from + shift).toFixed(places);
  if (document.activeElement !== $("to")) $("to").value = (view.to + shift).toFixed(places);
  redraw();
  clearTimeout(rangeChanged.timer);
  rangeChanged.timer = setTimeout(() => {
    const hash = `#t=${(view.from + shift).toFixed(9)},${(view.to + shift).toFixed(9)}`;
    history.replaceState(null, "", hash);
  }, 300);
}

function sized(canvas, width, height) {
  const ratio = devicePixelRatio || 1;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  canvas.style.width = width + "px";
  canvas.style.height = height + "px";
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.font = FONT;
  return ctx;
}

function drawAxis() {
  const ctx = sized($("axis"), gutter + plotWidth, 20), marks = timeTicks();
  const places = digits(marks.length > 1 ? Math.abs(marks[1] - marks[0]) : 1);
  ctx.fillStyle = theme.ink;
  ctx.textBaseline = "middle";
  ctx.textAlign = "left";
  const name = { rig: "time [s]", wall: "time from begin [s]", order: "message number" }[time.kind];
  ctx.fillText(fitted(ctx, name, gutter - 6), 0, 11);
  ctx.textAlign = "center";
  ctx.strokeStyle = theme.soft;
  for (const at of marks) {
    const x = Math.round(toX(at)) + 0.5;
    ctx.beginPath();
    ctx.moveTo(x, 17);
    ctx.lineTo(x, 20);
    ctx.stroke();
    ctx.fillText((at + time.begin_s).toFixed(time.kind === "order" ? 0 : places), x, 10);
  }
}

// The whole recording in a strip: how busy the busiest bus is, what went wrong, and the range.
function drawOverview() {
  const height = 26, ctx = sized($("overview"), gutter + plotWidth, height);
  const whole_ = (at) => gutter + at / SPAN * plotWidth;
  ctx.fillStyle = theme.off;
  ctx.fillRect(gutter, 2, plotWidth, height - 4);
  if (!drawOverview.curve || drawOverview.curve.length !== plotWidth) drawOverview.curve = busy(plotWidth);
  ctx.fillStyle = theme.idle;
  drawOverview.curve.forEach((part, x) => ctx.fillRect(gutter + x, 2 + (1 - part) * (height - 4), 1, part * (height - 4)));
  for (const [at, severity] of report.incidents.list) {
    if (severity < 1) continue;
    ctx.fillStyle = severity === 2 ? theme.fault : theme.stop;
    ctx.fillRect(whole_(at * time.tick_s) - 0.5, severity === 2 ? 2 : height / 2, 1.5, severity === 2 ? height - 4 : height / 2 - 2);
  }
  const from = whole_(Math.max(0, view.from)), to = whole_(Math.min(SPAN, view.to));
  ctx.fillStyle = theme.accent;
  ctx.globalAlpha = 0.2;
  ctx.fillRect(from, 1, to - from, height - 2);
  ctx.globalAlpha = 1;
  ctx.strokeStyle = theme.accent;
  ctx.lineWidth = 2;
  ctx.strokeRect(from, 2, Math.max(2, to - from), height - 4);
  ctx.fillStyle = theme.soft;
  ctx.textBaseline = "middle";
  ctx.textAlign = "left";
  ctx.fillText(fitted(ctx, "whole recording", gutter - 6), 0, height / 2);
}

function busy(width) {
  const out = new Float64Array(width);
  for (const traffic of traffics) {
    let top = 0;
    const own = out.map((_, x) => {
      const load = traffic.load(x / width * SPAN, (x + 1) / width * SPAN);
      top = Math.max(top, load);
      return load;
    });
    if (top > 0) own.forEach((load, x) => { out[x] = Math.max(out[x], load / top); });
  }
  return out;
}

// -------------------------------------------------------------------------------- cursor

function offsetLeft() {
  const panel = panels.find((one) => one.row.offsetParent);
  if (!panel) return 0;
  return panel.canvas.getBoundingClientRect().left - charts.getBoundingClientRect().left;
}

function put(element, at) {
  element.hidden = at === null || at < view.from || at > view.to;
  if (!element.hidden) element.style.left = offsetLeft() + toX(at) + "px";
}

function placeCursor() {
  put($("cursor"), cursor);
  put($("mark"), mark);
  const by = Math.max(1e-9, step(view.to - view.from, 4000));
  let text = cursor === null ? "" : `cursor ${timeText(cursor, by)}`;
  if (cursor !== null && time.kind === "wall") text += ` ${wall(cursor).toISOString().slice(11, 23)} UTC`;
  if (mark !== null && cursor !== null) text += `, ${cursor < mark ? "−" : "+"}${spanText(Math.abs(cursor - mark))} of the mark`;
  $("cursor-time").textContent = text;
  for (const panel of panels) if (panel.visible(0)) panel.read(cursor, 0, null);
}

// A log time of the calendar; one beyond it stands for its end.
function wall(at) {
  const ns = BigInt(time.begin_ns) + BigInt(Math.round(at * 1e9));
  return new Date(Math.min(Number(ns / 1000000n), 8.64e15));
}

function setCursor(at) {
  cursor = at;
  if (!setCursor.asked) {
    setCursor.asked = true;
    requestAnimationFrame(() => { setCursor.asked = false; placeCursor(); });
  }
}

function timeOf(event) {
  const x = event.clientX - charts.getBoundingClientRect().left - offsetLeft();
  return x < gutter || x > gutter + plotWidth ? null : toTime(x);
}

// --------------------------------------------------------------------- pointer and keys

function zoom(factor, around) {
  const middle = around === null || around < view.from || around > view.to ? (view.from + view.to) / 2 : around;
  setRange(middle - (middle - view.from) * factor, middle + (view.to - middle) * factor);
}
function pan(part) {
  const by = (view.to - view.from) * part;
  setRange(view.from + by, view.to + by, false);
}
function whole_range() { setRange(-SPAN * 0.01, SPAN * 1.01); }
function back() {
  const before = past.pop();
  if (before) setRange(before[0], before[1], false);
}

function jump(direction) {
  const bad = report.incidents.list.filter((one) => one[1] > 0).map((one) => one[0] * time.tick_s);
  const now = cursor === null ? (view.from + view.to) / 2 : cursor, nudge = SPAN * 1e-9;
  const next = direction > 0 ? bad.find((at) => at > now + nudge) : bad.filter((at) => at < now - nudge).pop();
  if (next !== undefined) show(next);
}

// The cursor is there and it is in view.
function show(at) {
  cursor = at;
  const span = view.to - view.from;
  if (at < view.from || at > view.to || span > SPAN / 4) {
    const wide = Math.min(span, SPAN / 10);
    setRange(at - wide / 2, at + wide / 2);
  }
  placeCursor();
}

const DO = {
  in: () => zoom(0.5, cursor), out: () => zoom(2, cursor), left: () => pan(-0.2), right: () => pan(0.2),
  all: whole_range, back, help: () => $("help").showModal(),
};
const KEYS = {
  "+": DO.in, "=": DO.in, w: DO.in, "-": DO.out, s: DO.out, ArrowLeft: DO.left, a: DO.left, ArrowRight: DO.right,
  d: DO.right, 0: DO.all, Home: DO.all, Backspace: DO.back, n: () => jump(1), p: () => jump(-1), "?": DO.help,
  m: () => { mark = cursor; placeCursor(); }, Escape: () => { mark = null; placeCursor(); },
};

function listen() {
  for (const button of document.querySelectorAll("[data-do]")) button.addEventListener("click", DO[button.dataset.do]);
  for (const id of ["from", "to"]) {
    $(id).addEventListener("change", () => {
      const from = Number($("from").value) - time.begin_s, to = Number($("to").value) - time.begin_s;
      if (Number.isFinite(from) && Number.isFinite(to) && to > from) { $(id).blur(); setRange(from, to); }
    });
  }
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("input, dialog, button, summary, a") && !event.altKey) {
      if (event.target.closest("input, dialog") || event.key === "Enter" || event.key === " ") return;
    }
    if (event.ctrlKey || event.metaKey) return;
    if (event.altKey && event.key.startsWith("Arrow")) {
      const pixel = (view.to - view.from) / plotWidth * (event.shiftKey ? 10 : 1);
      const now = cursor === null ? (view.from + view.to) / 2 : cursor;
      setCursor(now + (event.key === "ArrowLeft" ? -pixel : pixel));
      event.preventDefault();
      return;
    }
    const act = KEYS[event.key] || KEYS[event.key.toLowerCase()];
    if (!act || event.altKey) return;
    act();
    event.preventDefault();
  });
  listenPointer();
  addEventListener("resize", () => { layout(); redraw(); });
  addEventListener("scroll", () => { if (panels.some((panel) => panel.stale && panel.visible())) ask(); }, { passive: true });
  addEventListener("beforeprint", () => paint(true));
  addEventListener("hashchange", () => { if (fromHash()) redraw(); });
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => { readTheme(); redrawn.forEach((draw) => draw()); redraw(); });
}

function listenPointer() {
  const pointers = new Map();
  let drag = null, pinch = 0;
  charts.addEventListener("wheel", (event) => {
    const at = timeOf(event);
    if (at === null) return;
    if (event.ctrlKey || event.metaKey) zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY * 0.005))), at);
    else if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) pan((event.deltaX || event.deltaY) / 1000);
    else return;
    event.preventDefault();
  }, { passive: false });
  charts.addEventListener("pointerdown", (event) => {
    if (event.target.tagName !== "CANVAS" || event.button > 1) return;
    const at = timeOf(event);
    if (at === null) return;
    pointers.set(event.pointerId, event.clientX);
    drag = { at, x: event.clientX, pan: event.shiftKey || event.button === 1 || event.pointerType === "touch", range: [view.from, view.to] };
    try { event.target.setPointerCapture(event.pointerId); } catch { /* it has gone already */ }
  });
  charts.addEventListener("pointermove", (event) => {
    const at = timeOf(event);
    if (pointers.has(event.pointerId)) pointers.set(event.pointerId, event.clientX);
    if (pointers.size === 2) {
      const [one, other] = [...pointers.values()], wide = Math.abs(one - other);
      if (pinch > 0 && wide > 0) zoom(pinch / wide, at);
      pinch = wide;
      drag = null;
      return;
    }
    setCursor(at);
    if (!drag) return;
    if (drag.pan) {
      const by = (drag.x - event.clientX) / plotWidth * (drag.range[1] - drag.range[0]);
      setRange(drag.range[0] + by, drag.range[1] + by, false);
      return;
    }
    const box = $("select"), to = at === null ? drag.at : at;
    box.hidden = Math.abs(event.clientX - drag.x) < 4;
    box.style.left = offsetLeft() + toX(Math.min(drag.at, to)) + "px";
    box.style.width = Math.abs(toX(to) - toX(drag.at)) + "px";
  });
  const over = (event) => {
    pointers.delete(event.pointerId);
    if (pointers.size < 2) pinch = 0;
    $("select").hidden = true;
    if (!drag) return;
    const moved = Math.abs(event.clientX - drag.x), at = timeOf(event), was = drag;
    drag = null;
    if (event.type === "pointercancel" || was.pan) return;
    if (moved < 4) { mark = was.at; placeCursor(); return; }
    if (at !== null) setRange(Math.min(was.at, at), Math.max(was.at, at));
  };
  charts.addEventListener("pointerup", over);
  charts.addEventListener("pointercancel", over);
  charts.addEventListener("pointerleave", () => setCursor(null));
  charts.addEventListener("dblclick", (event) => { if (event.target.tagName === "CANVAS") { mark = null; whole_range(); } });
  const strip = $("overview");
  const centre = (event) => {
    const at = (event.clientX - strip.getBoundingClientRect().left - gutter) / plotWidth * SPAN, half = (view.to - view.from) / 2;
    setRange(at - half, at + half, event.type === "pointerdown");
  };
  strip.addEventListener("pointerdown", (event) => { strip.setPointerCapture(event.pointerId); centre(event); });
  strip.addEventListener("pointermove", (event) => { if (event.buttons) centre(event); });
}

// -------------------------------------------------------------------------- list, start

function list() {
  const told = report.incidents;
  if (!told.list.length) return;
  const holder = make("details", $("list"));
  holder.open = told.list.length <= 60;
  make("h2", make("summary", holder), `Faults and events, as a list (${told.list.length})`);
  const body = make("tbody", make("table", holder));
  const head_ = make("tr", body);
  for (const name of ["time", "how bad", "kind", "where", "what"]) make("th", head_, name).scope = "col";
  for (const [ticks_, severity, kind, place, text] of told.list.slice(0, 1000)) {
    const row = make("tr", body), at = ticks_ * time.tick_s;
    const button = make("button", make("td", row), timeText(at));
    button.type = "button";
    button.addEventListener("click", () => { show(at); scrollTo({ top: 0 }); });
    for (const part of [told.severities[severity], told.kinds[kind], place, text]) make("td", row, part);
  }
  if (told.list.length > 1000) make("p", holder, `and ${told.list.length - 1000} more, on the time axis above`);
}

function fromHash() {
  const found = /^#t=(-?[\d.]+),(-?[\d.]+)$/.exec(location.hash);
  if (!found) return false;
  const from = Number(found[1]) - time.begin_s, to = Number(found[2]) - time.begin_s;
  if (!(to > from)) return false;
  setRange(from, to);
  return true;
}

async function start() {
  const begun = performance.now();
  readTheme();
  await unpack();
  head();
  build();
  list();
  layout();
  redrawn.forEach((draw) => draw());
  listen();
  view.from = view.to = NaN;
  whole_range();
  fromHash();
  past.length = 0;
  layout(); // a scroll bar may have come
  paint(true);
  const root = document.documentElement;
  root.dataset.panels = panels.length;
  root.dataset.loadMs = (performance.now() - begun).toFixed(1);
  root.dataset.state = "ready";
}

start().catch((error) => {
  fail(String(error));
  make("p", $("notes"), `The page cannot be drawn: ${error.message}`);
});
