// The page: its sections, and their drawing.
let traffics = [], asked = false;

function section(id, title, about, open = true) {
  const element = make("section", charts);
  element.id = id;
  const holder = make("details", element);
  holder.open = open;
  const summary = make("summary", holder);
  make("h2", summary, title);
  if (about) make("span", summary, " " + about, "about");
  holder.addEventListener("toggle", () => redraw());
  linkTo(title, element, holder);
  return holder;
}

function linkTo(title, element, holder) {
  const link = make("a", $("places"), title);
  link.href = "#" + element.id;
  link.addEventListener("click", (event) => {
    event.preventDefault();
    holder.open = true;
    element.scrollIntoView();
    redraw();
  });
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
  if (traffics.length && time.kind !== "order") {
    const holder = section("load", "Bus load", "each frame counts for the duration of its bits on the bus");
    for (const traffic of traffics) {
      new LoadPanel(holder, traffic);
      if (traffic.cell_s) make("div", holder, `${traffic.name}: ${traffic.frames.toLocaleString("en")} frames, summed over ${spanText(traffic.cell_s)}`, "missing");
    }
    for (const why of new Set(traffics.map((traffic) => traffic.why).filter(Boolean))) {
      const names = traffics.filter((traffic) => traffic.why === why).map((traffic) => traffic.name);
      make("div", holder, `load in bit/s of ${names.join(", ")}: ${why}`, "missing");
    }
  }
  if (report.groups.length) {
    const holder = section("groups", "Group skew", "● start measured, ○ at most; ■ end measured, ◇ predicted; at the time of the report");
    for (const group of report.groups) new GroupPanel(holder, group);
  }
  addTimeline("locks", locks, true);
  if (report.motors.length) motorSections();
  if (traffics.length) {
    const holder = section("identifiers", "Bus load by identifier", "stronger colours are higher loads; in order of priority");
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
    if (row.left_out) make("div", holder, `${row.name}: ${row.left_out} more bars are not shown`, "missing");
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
  $("filter").hidden = false;
  $("filter").oninput = () => {
    const words = $("filter").value.toLowerCase();
    for (const element of holder.querySelectorAll(".motor")) element.hidden = !element.dataset.motor.toLowerCase().includes(words);
    redraw();
  };
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
  // In a narrow window only the axis stays visible.
  const above = $("overview").getBoundingClientRect().top - $("bar").getBoundingClientRect().top;
  $("bar").style.top = innerWidth < 800 ? -above + "px" : "0";
}

// Draws the visible panels, or all panels: at the start and before printing.
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
  document.dispatchEvent(new Event("range"));
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
    const text = (at + time.begin_s).toFixed(time.kind === "order" ? 0 : places);
    ctx.fillText(text, Math.min(x, gutter + plotWidth - ctx.measureText(text).width / 2), 10);
  }
}

// The overview strip: load of the busiest bus, incidents, and the shown range.
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

// -------------------------------------------------------------------------- list, start

function list() {
  const told = report.incidents;
  if (!told.list.length) return;
  const holder = make("details", $("list"));
  holder.open = told.list.length <= 60;
  make("h2", make("summary", holder), `Faults and events, as a list (${told.list.length})`);
  const body = make("tbody", make("table", holder));
  const head_ = make("tr", body);
  for (const name of ["time", "severity", "kind", "place", "description"]) make("th", head_, name).scope = "col";
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

// Makes all sections of the report anew, without their data being drawn.
function compose() {
  readTheme();
  head();
  build();
  responses();
  list();
  layout();
  redrawn.forEach((draw) => draw());
}
