// Response times of periodic messages, on their own axis and therefore not among the panels.
function shape(parent, kind, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text) element.textContent = text;
  parent.append(element);
  return element;
}

// A logarithmic axis over whole powers of ten; gives the place of a time in per cent.
class TimeScale {
  constructor(times) {
    this.low = Math.floor(Math.log10(Math.min(...times)) + 1e-9);
    this.high = Math.max(this.low + 1, Math.ceil(Math.log10(Math.max(...times)) - 1e-9));
  }
  place(value) { return (Math.log10(value) - this.low) / (this.high - this.low) * 100; }
  get powers() { return Array.from({ length: this.high - this.low + 1 }, (_, n) => this.low + n); }
}

function responses() {
  const told = report.responses;
  if (!told.length) return;
  const holder = make("details", $("list"));
  holder.id = "responses";
  holder.open = told.reduce((sum, bus) => sum + bus.messages.length, 0) <= 60;
  make("h2", make("summary", holder), "Response times of periodic messages");
  linkTo("Response times", holder, holder);
  make("p", holder, "From the due time of a message to the end of its intermission. Bar: recorded, from the shortest frame"
    + " to the largest delay proved by later frames, with a notch at the median; upright line: the bound by theory, with the"
    + " recorded periods and jitter and without errors; diamond: its deadline, which is its period.", "about");
  for (const bus of told) responsesOf(holder, bus);
}

function responsesOf(holder, bus) {
  const top = make("div", holder, "", "bus");
  make("h3", top, bus.bus);
  make("span", top, ` ${bus.about}`, "about");
  if (bus.why) make("div", holder, `${bus.bus}: ${bus.why}`, "missing");
  if (bus.messages.length) {
    const scale = new TimeScale(bus.messages.flatMap((one) => [one.least_s, one.most_s, one.bound_s || one.least_s, one.deadline_s || one.least_s]));
    const body = make("tbody", make("table", make("div", holder, "", "wide"))), head_ = make("tr", body);
    for (const name of ["message", "what", "sender", "bytes", "period"]) make("th", head_, name).scope = "col";
    scaleHead(make("th", head_, "", "chart"), scale);
    for (const name of ["recorded", "by theory", "deadline"]) make("th", head_, name).scope = "col";
    for (const one of bus.messages) responseRow(make("tr", body), one, scale);
  }
  for (const note of bus.notes) make("div", holder, note, "missing");
}

function scaleHead(cell, scale) {
  cell.scope = "col";
  const svg = shape(cell, "svg", { width: "100%", height: 16, role: "img", "aria-label": "recorded, by theory, deadline" });
  for (const power of scale.powers) {
    const place = scale.place(10 ** power);
    const anchor = place < 1 ? "start" : place > 99 ? "end" : "middle";
    shape(svg, "text", { x: `${place}%`, y: 12, "text-anchor": anchor }, withUnit(10 ** power, "s", 1));
  }
}

function responseRow(row, one, scale) {
  const late = one.deadline_s !== null && (one.bound_s === null || one.bound_s > one.deadline_s);
  if (late) row.className = "late";
  for (const text of [one.label, one.name, one.sender, one.bytes, withUnit(one.period_s, "s", 4)]) make("td", row, text);
  chart(make("td", row, "", "chart"), one, scale);
  make("td", row, withUnit(one.most_s, "s", 4));
  make("td", row, (late ? "▲ " : "") + (one.bound_s === null ? "no bound" : withUnit(one.bound_s, "s", 4)));
  make("td", row, one.deadline_s === null ? "none" : withUnit(one.deadline_s, "s", 4));
}

function chart(cell, one, scale) {
  const svg = shape(cell, "svg", { width: "100%", height: 16, "aria-hidden": "true" });
  for (const power of scale.powers) line(svg, "grid", scale.place(10 ** power), 0, 16);
  const from = scale.place(one.least_s), to = scale.place(one.most_s);
  const end = one.bound_s === null ? 100 : scale.place(one.bound_s);
  shape(svg, "line", { class: "reach", x1: `${from}%`, x2: `${end}%`, y1: 8, y2: 8 });
  shape(svg, "rect", { class: "seen", x: `${from}%`, width: `${Math.max(0.4, to - from)}%`, y: 4, height: 8 });
  line(svg, "usual", scale.place(one.usual_s), 4, 12);
  if (one.bound_s !== null) line(svg, "bound", end, 2, 14);
  if (one.deadline_s === null) return;
  const mark = shape(svg, "svg", { class: "mark", x: `${scale.place(one.deadline_s)}%`, y: 8 });
  shape(mark, "path", { class: "deadline", d: "M0-5L5 0L0 5L-5 0Z" });
}

function line(svg, kind, place, y1, y2) {
  shape(svg, "line", { class: kind, x1: `${place}%`, x2: `${place}%`, y1, y2 });
}
