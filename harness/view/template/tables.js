// Tables: motors and nodes, messages on the buses.
const rowsByKey = { presence: new Map(), identifiers: new Map() };
let words = ""; // of the search, in lower case

function seconds_text(value, past = "") {
  return value === null || value === undefined ? "" : withUnit(value, "s", 3) + past;
}

const COLUMNS = {
  presence: [
    ["name", (row) => row.name],
    ["place", (row) => row.place],
    ["state", (row) => [row.state, row.nmt].filter(Boolean).join(" · ")],
    ["mode", (row) => row.mode],
    ["heartbeat", (row) => seconds_text(row.age_s, row.late ? " ago, late" : " ago")],
    ["last frame", (row) => seconds_text(row.heard_s, " ago")],
    ["owner", (row) => row.owner],
    ["error counters", (row) => row.errors],
    ["latest fault", (row) => row.fault],
  ],
  identifiers: [
    ["bus", (row) => row.bus],
    ["identifier", (row) => row.label],
    ["name", (row) => row.name],
    ["count", (row) => row.count.toLocaleString("en")],
    ["period", (row) => seconds_text(row.period_s)],
    ["jitter", (row) => row.count > 2 ? seconds_text(row.jitter_s) : ""],
    ["latest data", null],
    ["at", (row) => timeText(row.last_s, 1e-3)],
  ],
};

const keyOf = { presence: (row) => row.name, identifiers: (row) => `${row.bus} ${row.label}` };

// Takes rows with news; `every`: there are no others.
function takeRows(kind, told, every) {
  const known = rowsByKey[kind];
  if (every) for (const one of known.values()) one.gone = true;
  for (const row of told) {
    const key = keyOf[kind](row);
    let one = known.get(key);
    if (!one) known.set(key, one = { element: null, cells: [] });
    Object.assign(one, { row, gone: false, stale: true });
  }
  for (const [key, one] of known) {
    if (!one.gone) continue;
    if (one.element) one.element.remove();
    known.delete(key);
  }
}

function drawTables() {
  for (const kind of ["presence", "identifiers"]) {
    const holder = $(kind + "-table");
    if (!holder.closest("details").open) continue;
    const body = holder.tBodies[0], known = [...rowsByKey[kind].values()];
    let place = null;
    if (kind === "identifiers") known.sort((a, b) => a.row.bus.localeCompare(b.row.bus) || a.row.rank - b.row.rank);
    for (const one of known) {
      if (!one.element) addRow(kind, body, one);
      if (place ? place.nextSibling !== one.element : body.firstChild !== one.element) {
        if (place) place.after(one.element); else body.prepend(one.element);
      }
      place = one.element;
      if (one.stale) fillRow(kind, one);
    }
    $(kind + "-count").textContent = `(${known.length})`;
  }
}

function addRow(kind, body, one) {
  one.element = make("tr", body);
  one.cells = COLUMNS[kind].map(([name], n) => {
    const cell = make(n ? "td" : "th", one.element);
    if (!n) cell.scope = "row";
    return cell;
  });
}

function fillRow(kind, one) {
  one.stale = false;
  COLUMNS[kind].forEach(([name, text], n) => {
    if (!text) return drawData(one.cells[n], one.row);
    const value = text(one.row);
    if (one.cells[n].textContent !== value) one.cells[n].textContent = value;
  });
  one.element.classList.toggle("alarm", Boolean(one.row.alarm));
  matchRow(one);
}

// The bytes of the latest message; those that have changed are marked.
function drawData(cell, row) {
  const bytes_ = row.data ? row.data.split(" ") : [];
  cell.replaceChildren();
  bytes_.forEach((text, n) => {
    const changed = Math.floor(row.changed / 2 ** n) % 2 === 1;
    make(changed ? "mark" : "span", cell, text);
    cell.append(" ");
  });
}

function matchRow(one) {
  one.element.hidden = words !== "" && !one.element.textContent.toLowerCase().includes(words);
}

// Shows only what has this text: in its name, identifier, object, state or description.
function find(text) {
  words = text.trim().toLowerCase();
  for (const known of Object.values(rowsByKey)) for (const one of known.values()) if (one.element) matchRow(one);
  for (const row of document.querySelectorAll("#list tbody tr")) {
    row.hidden = words !== "" && !row.querySelector("th") && !row.textContent.toLowerCase().includes(words);
  }
  report.motors.forEach((motor) => {
    const told = [motor.name, motor.about, ...motor.plots.flatMap((plot) => [plot.quantity, ...plot.lines.flatMap((line) => [line.name, line.source])])];
    const element = document.querySelector(`.motor[data-motor="${CSS.escape(motor.name)}"]`);
    if (element) element.hidden = words !== "" && !told.join(" ").toLowerCase().includes(words);
  });
  redraw();
}

function buildTables() {
  for (const kind of ["presence", "identifiers"]) {
    const head_ = make("tr", $(kind + "-table").tHead);
    for (const [name] of COLUMNS[kind]) make("th", head_, name).scope = "col";
    $(kind + "-table").closest("details").addEventListener("toggle", () => drawTables());
  }
}
