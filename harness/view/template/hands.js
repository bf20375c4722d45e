// Hands on a rig: its time, inputs of controllers, faults of buses. Absent for files and live buses.
const hands = { elements: null, state: null, shown: null, over: false };
const INPUTS_SHOWN = 16;
const PACES = [0.01, 0.1, 0.2, 0.5, 1, 2, 5, 10, 100];

// Sends a request; returns true if the rig has taken it. Its answer is shown.
async function request(act) {
  let status = 0, text = "the page's server does not answer";
  try {
    const answer = await fetch("hands" + location.search, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(act) });
    status = answer.status;
    text = await answer.text();
  } catch { /* the text says it */ }
  $("hand-problem").textContent = status === 200 || status === 202 ? "" : text;
  if (status === 202) $("hand-told").textContent = text;
  return status === 200 || status === 202;
}

const standing = () => Boolean(hands.state && hands.state.stands);
const DO_TIME = {
  stand: () => request({ act: standing() ? "continue" : "stop" }),
  step: () => {
    const for_s = Number($("step-ms").value) / 1e3;
    if (Number.isFinite(for_s)) return request({ act: "step", for_s });
    $("hand-problem").textContent = `step: ${$("step-ms").value} is not a number of ms`;
  },
};

function takeHands(state) {
  hands.state = state;
  hands.over = hands.over || state.over;
  if (hands.elements) return drawHands();
  if (hands.elements === null) {
    hands.elements = false; // asked for
    fetch("hands" + location.search).then((answer) => answer.json()).then((told) => { hands.elements = told; beginHands(); drawHands(); })
      .catch(() => { hands.elements = null; });
  }
}

function endHands() {
  hands.over = true;
  if (hands.elements) drawHands();
}

function beginHands() {
  const { controllers, buses } = hands.elements;
  $("hands").hidden = false;
  for (const one of controllers) {
    const others = one.motors.filter((name) => name !== one.name);
    make("option", $("element"), others.length ? `${one.name} (${others.join(", ")})` : one.name).value = `controller ${one.name}`;
  }
  for (const one of buses) make("option", $("element"), one.name).value = `bus ${one.name}`;
  $("element").closest("label").hidden = !controllers.length && !buses.length;
  for (const pace of PACES) make("option", $("pace"), `${pace} ×`).value = pace;
  make("option", $("pace"), "no limit").value = "none";
  $("element").addEventListener("change", drawHands);
  $("pace").addEventListener("change", () => request($("pace").value === "none" ? { act: "pace" } : { act: "pace", pace: Number($("pace").value) }));
  $("stand").addEventListener("click", DO_TIME.stand);
  $("step").addEventListener("click", DO_TIME.step);
  KEYS.t = DO_TIME.stand;
  KEYS["."] = DO_TIME.step;
}

function drawHands() {
  const { state } = hands, standing_ = state.stands && !hands.over;
  $("stand").setAttribute("aria-pressed", String(standing_));
  $("hands-at").textContent = hands.over ? "the run is over" : standing_ ? `time stands still at ${state.at_s.toFixed(6)} s` : "time passes";
  const pace = state.pace === null ? "none" : String(state.pace);
  if (![...$("pace").options].some((one) => one.value === pace)) make("option", $("pace"), `${pace} ×`).value = pace;
  if (document.activeElement !== $("pace")) $("pace").value = pace;
  if (state.told && $("hand-told").textContent !== state.told) $("hand-told").textContent = state.told;
  if (hands.shown !== $("element").value) {
    hands.shown = $("element").value;
    $("inputs").replaceChildren();
    hands.draws = [];
    const [kind, name] = hands.shown.split(/ (.*)/);
    if (kind === "controller") drawController(hands.elements.controllers.find((one) => one.name === name));
    if (kind === "bus") drawBus(hands.elements.buses.find((one) => one.name === name));
  }
  for (const draw of hands.draws || []) draw();
  drawFaults();
  for (const one of $("hands").querySelectorAll("button, input, select")) if (one.id !== "element") one.disabled = hands.over;
}

function drawController(controller) {
  if (controller.can_be_cut) {
    const keys = `nodes = ${JSON.stringify([controller.name])}`;
    const cut = () => hands.state.faults.find((one) => one.kind === "cut" && one.bus === controller.bus && one.keys === keys);
    const button = addButton($("inputs"), "", () => request(cut() ? { act: "mend", name: cut().name } : { act: "fault", bus: controller.bus, kind: "cut", keys }));
    button.id = "cable";
    hands.draws.push(() => {
      button.textContent = cut() ? "mend the cable" : "cut the cable";
      button.setAttribute("aria-pressed", String(Boolean(cut())));
    });
  }
  const [first, more] = [controller.inputs.slice(0, INPUTS_SHOWN), controller.inputs.slice(INPUTS_SHOWN)];
  for (const input of first) DRAW_INPUT[input.kind](controller.name, input, $("inputs"));
  if (!more.length) return;
  const rest = make("details", $("inputs"));
  make("summary", rest, `${more.length} more inputs`);
  const row = make("div", rest, "", "row");
  for (const input of more) DRAW_INPUT[input.kind](controller.name, input, row);
}

const valueOf = (controller, input) => ((hands.state.values[controller] || {})[input.name] ?? input.rest);

// A control that sends its latest value, one request at a time: a drag never queues.
function sender(controller, input) {
  let wanted = null, busy = false;
  return async (value) => {
    wanted = value;
    if (busy) return;
    busy = true;
    while (wanted !== null) {
      const value_ = wanted;
      wanted = null;
      await request({ act: "stimulus", controller, name: input.name, value: value_ });
    }
    busy = false;
  };
}

const DRAW_INPUT = {
  number: (controller, input, parent) => {
    const row = make("div", parent, "", "input"), send = sender(controller, input);
    make("span", row, input.unit ? `${input.name} [${input.unit}]` : input.name);
    const range = make("input", row), exact = make("input", row);
    Object.assign(range, { type: "range", min: input.low, max: input.high, step: (input.high - input.low) / 200 });
    Object.assign(exact, { type: "number", step: "any" });
    range.setAttribute("aria-label", `${controller} ${input.name}, slider`);
    exact.setAttribute("aria-label", `${controller} ${input.name}`);
    range.addEventListener("input", () => { exact.value = Number(range.value); send(Number(range.value)); });
    exact.addEventListener("change", () => { if (exact.value !== "") { range.value = exact.value; send(Number(exact.value)); } });
    hands.draws.push(() => {
      for (const one of [range, exact]) if (document.activeElement !== one) one.value = valueOf(controller, input);
    });
  },
  toggle: (controller, input, parent) => {
    const send = sender(controller, input);
    const button = addButton(parent, input.name, () => send(1 - valueOf(controller, input)));
    hands.draws.push(() => button.setAttribute("aria-pressed", String(valueOf(controller, input) === 1)));
  },
  switch: (controller, input, parent) => {
    const label = make("label", parent, `${input.name} `), select = make("select", label), send = sender(controller, input);
    select.setAttribute("aria-label", input.name);
    for (const [value, text] of [[-1, "free"], [0, "0"], [1, "1"]]) make("option", select, text).value = value;
    select.addEventListener("change", () => send(Number(select.value)));
    hands.draws.push(() => { if (document.activeElement !== select) select.value = valueOf(controller, input); });
  },
  code: (controller, input, parent) => {
    const row = make("span", parent, "", "row"), exact = make("input", make("label", row, `${input.name} `)), send = sender(controller, input);
    Object.assign(exact, { size: 8, placeholder: "code" });
    addButton(row, `cause ${input.name}`, () => {
      const text = exact.value.trim(), value = /^[0-9a-f]+h$/i.test(text) ? parseInt(text, 16) : Number(text);
      if (text !== "" && Number.isFinite(value)) send(value); else $("hand-problem").textContent = `${input.name}: ${text || "nothing"} is not a number, such as 8611h`;
    });
  },
};

function drawBus(bus) {
  const kind = make("select", make("label", $("inputs"), "fault ")), keys = make("input", make("label", $("inputs"), "with "));
  kind.id = "fault-kind";
  Object.assign(keys, { id: "fault-keys", size: 30, maxLength: 1000, placeholder: "identifier = 0x181, limit = 1" });
  for (const one of bus.kinds) make("option", kind, one.kind).value = one.kind;
  kind.addEventListener("change", () => { keys.value = bus.kinds.find((one) => one.kind === kind.value).keys; });
  const begin_ = () => request({ act: "fault", bus: bus.name, kind: kind.value, ...(keys.value.trim() ? { keys: keys.value } : {}) });
  keys.addEventListener("keydown", (event) => { if (event.key === "Enter") begin_(); });
  addButton($("inputs"), "begin the fault", begin_);
}

function drawFaults() {
  const list = $("hand-faults"), known = hands.state.faults.map((one) => one.name).join();
  if (list.dataset.known === known) return;
  list.dataset.known = known;
  list.replaceChildren();
  for (const one of hands.state.faults) {
    const item = make("li", list, `${one.bus}: ${one.kind} ${one.keys} `);
    addButton(item, "mend", () => request({ act: "mend", name: one.name })).setAttribute("aria-label", `mend ${one.name}: ${one.bus} ${one.kind}`);
  }
}

function addButton(parent, text, act) {
  const button = make("button", parent, text);
  button.type = "button";
  button.addEventListener("click", act);
  return button;
}
