// Start of a page that carries its own data.
async function start() {
  const begun = performance.now();
  adopt(JSON.parse($("document").textContent));
  bytes = await inflated($("packed").textContent);
  $("packed").textContent = "";
  compose();
  listen();
  view.from = view.to = NaN;
  whole_range();
  fromHash();
  past.length = 0;
  layout(); // a scroll bar may have appeared
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
