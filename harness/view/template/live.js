// The live page: events from the server, the range that follows them, pause and trigger.
const live = { link: "connecting", told: "connecting", why: "", follows: true, moving: false, queue: Promise.resolve(), overviewAt: 0, events: 0 };
const WINDOWS = [1, 2, 5, 10, 30, 60, 300, Infinity];

// Whole pictures and news come as deflated text: the length of the JSON, the JSON, the arrays.
async function opened(text) {
  const all = await inflated(text), size = new DataView(all.buffer).getUint32(0, true);
  bytes = all.subarray(4 + size);
  return JSON.parse(new TextDecoder().decode(all.subarray(4, 4 + size)));
}

// Tells the state of the connection, and why the picture stands still if it does.
function tell(link = live.link, told = live.link === link ? live.told : link) {
  live.link = link;
  live.told = told;
  const stands = !live.follows, lost = link === "reconnecting" || link === "failed";
  document.documentElement.dataset.live = stands && !lost && link !== "complete" ? "paused" : link;
  const text = stands ? [live.why, link === "live" ? "" : told].filter(Boolean).join("; ") : told;
  if ($("state").textContent !== text) $("state").textContent = text;
}

function follow() {
  live.follows = true;
  $("pause").setAttribute("aria-pressed", "false");
  tell();
  drawTables();
  followEnd();
}

function pause(why = "paused") {
  if (!live.follows) return;
  live.follows = false;
  live.why = why;
  $("pause").setAttribute("aria-pressed", "true");
  tell();
}

function followEnd() {
  const window_s = Number($("window").value);
  live.moving = true;
  if (Number.isFinite(window_s)) setRange(SPAN - window_s, SPAN, false); else whole_range();
  live.moving = false;
}

function takePicture(told) {
  const first = report === null, open = new Map(), focused = document.activeElement ? document.activeElement.id : "";
  for (const one of document.querySelectorAll("#charts > section")) open.set(one.id, one.querySelector("details").open);
  const top = scrollY, until = SPAN, known = new Set(first ? [] : report.incidents.list.slice(-200).map((one) => one.slice(1).join()));
  clearPicture();
  adopt(told);
  compose();
  indexLines();
  forgetDetail();
  for (const one of document.querySelectorAll("#charts > section")) {
    if (open.has(one.id)) one.querySelector("details").open = open.get(one.id);
  }
  takeRows("presence", told.presence, true);
  takeRows("identifiers", told.identifiers, true);
  if (first) {
    listen();
    past.length = 0;
    if (fromHash()) pause(); else followEnd();
  }
  layout();
  redraw();
  rangeDetail();
  if (words) find(words);
  scrollTo(0, top);
  if (focused && $(focused)) $(focused).focus({ preventScroll: true });
  const { list: all, kinds } = report.incidents;
  notice(first ? [] : all.filter((one) => one[0] * time.tick_s > until - 1e-3 && !known.has(one.slice(1).join()))
    .map(([at, severity, kind, place, text]) => ({ at: at * time.tick_s, severity, kind: kinds[kind], place, text })));
}

function clearPicture() {
  panels.length = redrawn.length = 0;
  drawOverview.curve = null;
  for (const one of [...charts.children]) if (one.tagName === "SECTION") one.remove();
  for (const id of ["facts", "notes", "places", "quantities", "list"]) $(id).replaceChildren();
  report = null;
}

function takeNews(told) {
  const fresh = grow(told);
  if (told.presence) takeRows("presence", told.presence, true);
  if (told.identifiers) takeRows("identifiers", told.identifiers, false);
  addToList(fresh);
  const now = performance.now();
  if (now - live.overviewAt > 1000) { live.overviewAt = now; drawOverview.curve = null; }
  notice(fresh);
}

// Stops the picture at the first new incident that is the trigger; tells of errors.
function notice(fresh) {
  const hit = fresh.find(isTrigger);
  if (hit && live.follows) {
    followEnd();
    drawTables();
    pause(`stopped at ${timeText(hit.at, 1e-3)}: ${hit.kind}, ${hit.text}`);
    show(hit.at);
  }
  for (const one of fresh) if (one.severity === 2) $("alarm").textContent = `${timeText(one.at, 1e-3)} ${one.kind}: ${one.text}`;
}

function isTrigger(one) {
  const kind = $("trigger").value, text = $("trigger-text").value.trim().toLowerCase();
  if (kind === "none") return false;
  if (kind !== "any" && one.severity < Number(kind)) return false;
  return text === "" ? kind !== "any" : `${one.kind} ${one.place} ${one.text}`.toLowerCase().includes(text);
}

function addToList(fresh) {
  const body = document.querySelector("#list tbody");
  if (!body || !fresh.length) return;
  for (const one of fresh) {
    const row = make("tr", body), button = make("button", make("td", row), timeText(one.at));
    button.type = "button";
    button.addEventListener("click", () => { show(one.at); scrollTo({ top: 0 }); });
    for (const part of [report.incidents.severities[one.severity], one.kind, one.place, one.text]) make("td", row, part);
    while (body.rows.length > 1001) body.rows[1].remove();
    row.hidden = words !== "" && !row.textContent.toLowerCase().includes(words);
  }
  $("list").querySelector("h2").textContent = `Faults and events, as a list (${report.incidents.list.length})`;
}

// Draws after an event: a stopped picture stays as it is, except for the overview.
function drawEvent() {
  $("now").textContent = timeText(SPAN, 1e-3);
  const length = [...document.querySelectorAll("#facts div")].find((one) => one.firstChild.textContent === "length");
  if (time.kind !== "order") length.lastChild.textContent = `${short(SPAN, 6)} s`;
  const root = document.documentElement;
  root.dataset.state = "ready";
  root.dataset.panels = panels.length;
  root.dataset.span = SPAN;
  root.dataset.messages = report.messages;
  root.dataset.events = ++live.events;
  if (live.follows) { followEnd(); drawTables(); redraw(); } else ask();
}

async function receive(kind, event) {
  const told = await opened(event.data);
  if (kind === "whole") takePicture(told); else takeNews(told);
  report.messages = told.messages;
  document.documentElement.dataset.position = event.lastEventId;
  if (live.link === "connecting" || live.link === "reconnecting") tell("live");
  drawEvent();
}

function connect() {
  const source = new EventSource("events" + location.search);
  for (const kind of ["whole", "more"]) {
    source.addEventListener(kind, (event) => { live.queue = live.queue.then(() => receive(kind, event)).catch((error) => { fail(String(error)); }); });
  }
  source.addEventListener("hands", (event) => takeHands(JSON.parse(event.data)));
  const end = (link, text) => {
    source.close();
    endHands();
    live.queue = live.queue.then(() => tell(link, text));
  };
  source.addEventListener("over", () => end("complete", "complete: the whole record is here"));
  source.addEventListener("problem", (event) => end("failed", event.data));
  source.addEventListener("error", () => {
    if (source.readyState === EventSource.CLOSED) tell("failed", "the server refuses this page: open the address that motorhil printed");
    else tell("reconnecting", "connection lost; trying again");
  });
  source.addEventListener("open", () => {
    if (report === null) tell("connecting", "waiting for the first message");
    else if (live.link === "reconnecting") tell("live");
  });
}

function begin() {
  $("bar").prepend($("live"));
  $("bar").after($("hands"), $("tables"));
  for (const window_s of WINDOWS) {
    const option = make("option", $("window"), Number.isFinite(window_s) ? `last ${window_s} s` : "all");
    option.value = window_s;
  }
  $("window").value = "10";
  $("window").addEventListener("change", () => { follow(); });
  $("pause").addEventListener("click", () => { if (live.follows) pause(); else follow(); });
  $("find").addEventListener("input", () => find($("find").value));
  $("report").href = "report" + location.search;
  document.addEventListener("range", () => { if (!live.moving && report && live.link !== "complete") pause(); if (report) rangeDetail(); });
  KEYS[" "] = () => { if (live.follows) pause(); else follow(); };
  KEYS.l = KEYS.End = () => follow();
  KEYS["/"] = () => $("find").focus();
  buildTables();
  tell();
  connect();
}

begin();
