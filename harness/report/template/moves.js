// The cursor, the range of time, keys and pointer.
const $ = (id) => document.getElementById(id);
const charts = $("charts");
let cursor = null, mark = null;

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
  if (mark !== null && cursor !== null) text += `, ${cursor < mark ? "−" : "+"}${spanText(Math.abs(cursor - mark))} from the mark`;
  $("cursor-time").textContent = text;
  for (const panel of panels) if (panel.visible(0)) panel.read(cursor, 0, null);
}

// Formats a log time as wall time; a time out of range becomes the last possible one.
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

// Moves the cursor to a time and brings it into view.
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
    if (event.target.closest("input, select, dialog, button, summary, a") && !event.altKey) {
      if (event.target.closest("input, select, dialog") || event.key === "Enter" || event.key === " ") return;
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
  addEventListener("beforeprint", () => dress(true));
  addEventListener("afterprint", () => dress(false));
  addEventListener("hashchange", () => { if (fromHash()) redraw(); });
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => { readTheme(); redrawn.forEach((draw) => draw()); redraw(); });
}

// Draws everything in light colours for printing, then restores the colours of the screen.
function dress(printing) {
  document.documentElement.classList.toggle("printing", printing);
  readTheme();
  redrawn.forEach((draw) => draw());
  redraw(printing);
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
    try { event.target.setPointerCapture(event.pointerId); } catch { /* the pointer is gone already */ }
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

