"use strict";
// Asks for /state.json about once a second and shows it. Administrators may recalibrate and roll back; else it changes nothing.

const CHARTS = [
  { title: "Margin", unit: "bit a symbol", digits: 3, lines: [["margin_bits", "margin"]], limit: 0, zero: true,
    about: "Information beyond what a page's code needs. At 0 pages are lost." },
  { title: "AIR, estimated", unit: "bit a symbol", digits: 3, lines: [["air_bits", "AIR"]],
    about: "Information that a symbol is claimed to carry, as far as the pilots bear it out." },
  { title: "Pilots", unit: "share", digits: 3, lines: [["trust", "trust"], ["share", "confirmed"]],
    about: "What the pilots bear out of the claimed concentration, and of the claimed information." },
  { title: "Image shift", unit: "camera px", digits: 2, lines: [["shift_x_px", "x"], ["shift_y_px", "y"]],
    about: "Where the image lies, against where calibration saw it." },
  { title: "Piston", unit: "rad", digits: 2, lines: [["piston_rad", "piston"]],
    about: "Common phase of a page, which is taken off. It wanders by itself." },
  { title: "Phase residual", unit: "rad", digits: 4, lines: [["residual_rad", "residual"]], zero: true,
    about: "Smooth phase error that was taken off, root mean square." },
  { title: "Modulator's stroke", unit: "relative", digits: 4, lines: [["stroke_relative", "stroke"]],
    about: "Its change since calibration, as the pilots show it. It goes with temperature." },
];
const CONDITIONS = { reading: "good", idle: "", "no page yet": "", "recalibration is due": "warn", "pages are being lost": "bad" };
const W = 420, H = 150, LEFT = 46, RIGHT = 8, TOP = 10, BOTTOM = 22;
const at = (id) => document.getElementById(id);
const clock = (s) => new Date(1000 * s).toLocaleTimeString("en-GB");
const shown = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));
let picture = -1, wait = 1000, answered = null, inService = null;

function element(name, attributes = {}, text) {
  const made = name === "svg" || element.svg.has(name)
    ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}
element.svg = new Set(["line", "path", "text"]);

function ticks(low, high) {
  const step = 10 ** Math.floor(Math.log10((high - low) / 3));
  const best = [1, 2, 5, 10].map((m) => m * step).find((s) => (high - low) / s <= 4);
  const found = [];
  for (let value = Math.ceil(low / best) * best; value <= high + 1e-9 * best; value += best) found.push(value);
  return [found, Math.max(0, -Math.floor(Math.log10(best)))];
}

function draw(chart, series) {
  const { svg, now } = chart;
  const times = series.time_s, values = chart.lines.map(([name]) => series[name]);
  const all = values.flat().filter((v) => v !== null);
  svg.replaceChildren();
  if (!all.length) {
    svg.append(element("text", { x: W / 2, y: H / 2, "text-anchor": "middle" }, "no figures yet"));
    now.textContent = "–";
    return;
  }
  let low = Math.min(...all, ...(chart.zero ? [0] : [])), high = Math.max(...all, ...(chart.zero ? [0] : []));
  const room = (high - low || Math.abs(high) || 1) * 0.08;
  low -= room; high += room;
  const first = times[0], last = times[times.length - 1];
  const x = (t) => (last > first ? LEFT + ((t - first) / (last - first)) * (W - LEFT - RIGHT) : (LEFT + W - RIGHT) / 2);
  const y = (v) => TOP + ((high - v) / (high - low)) * (H - TOP - BOTTOM);
  const [marks, digits] = ticks(low, high);
  for (const mark of marks) {
    svg.append(element("line", { class: "grid", x1: LEFT, x2: W - RIGHT, y1: y(mark), y2: y(mark) }));
    svg.append(element("text", { x: LEFT - 6, y: y(mark) + 4, "text-anchor": "end" }, mark.toFixed(digits)));
  }
  svg.append(element("text", { x: LEFT, y: H - 5 }, clock(first)));
  svg.append(element("text", { x: W - RIGHT, y: H - 5, "text-anchor": "end" }, clock(last)));
  if (chart.limit !== undefined && chart.limit > low && chart.limit < high)
    svg.append(element("line", { class: "limit", x1: LEFT, x2: W - RIGHT, y1: y(chart.limit), y2: y(chart.limit) }));
  values.forEach((line, k) => {
    let path = "", pen = false;
    line.forEach((value, i) => {
      if (value === null) { pen = false; return; }
      path += `${pen ? "L" : "M"}${x(times[i]).toFixed(1)} ${y(value).toFixed(1)}`;
      if (!pen) path += "h0.01";
      pen = true;
    });
    svg.append(element("path", { class: `line ${"ab"[k]}`, d: path, "stroke-linecap": "round" }));
  });
  const cursor = element("line", { class: "cursor", y1: TOP, y2: H - BOTTOM, x1: -9, x2: -9 });
  svg.append(cursor);
  const tell = (i, when) => {
    now.replaceChildren();
    chart.lines.forEach(([, label], k) => {
      const value = element("span", { class: `key-${"ab"[k]}` }, `${chart.lines.length > 1 ? label + " " : ""}${shown(values[k][i], chart.digits)} `);
      now.append(value);
    });
    now.append(`${chart.unit}${when ? ` at ${clock(times[i])}` : ""}`);
  };
  const newest = () => { let i = times.length - 1; while (i > 0 && values.every((v) => v[i] === null)) i--; tell(i, false); cursor.setAttribute("x1", -9); cursor.setAttribute("x2", -9); };
  svg.onpointermove = (event) => {
    const box = svg.getBoundingClientRect(), px = ((event.clientX - box.left) / box.width) * W;
    let best = 0;
    times.forEach((t, i) => { if (Math.abs(x(t) - px) < Math.abs(x(times[best]) - px)) best = i; });
    cursor.setAttribute("x1", x(times[best])); cursor.setAttribute("x2", x(times[best]));
    tell(best, true);
  };
  svg.onpointerleave = newest;
  newest();
}

function rows(id, cells, empty, columns) {
  const body = at(id);
  body.replaceChildren();
  for (const row of cells) {
    const line = element("tr");
    for (const [text, kind] of row) line.append(element("td", kind ? { class: kind } : {}, text));
    body.append(line);
  }
  if (!cells.length) {
    const line = element("tr");
    line.append(element("td", { class: "none", colspan: columns }, empty));
    body.append(line);
  }
}

function span(seconds) {
  const minutes = Math.floor(seconds / 60), hours = Math.floor(minutes / 60), days = Math.floor(hours / 24);
  if (days) return `${days} d ${hours % 24} h`;
  return hours ? `${hours} h ${minutes % 60} min` : minutes ? `${minutes} min` : `${Math.floor(seconds)} s`;
}

function show(state) {
  const badge = at("condition");
  badge.textContent = state.condition;
  badge.className = `badge ${CONDITIONS[state.condition] || ""}`;
  const current = state.models.find((model) => model.current);
  at("facts").textContent = `${state.source} · model ${current ? current.version : "–"} · up ${span(state.uptime_s)} · ${state.pages} pages`;
  inService = current ? current.version : null;
  showActions(state);
  at("reasons").hidden = !state.reasons.length;
  at("reasons").textContent = state.reasons.length ? `Recalibration is due: ${state.reasons.join("; ")}.` : "";
  if (state.picture.number !== picture) {
    picture = state.picture.number;
    for (const [id, path, there] of [["in_phase", "/frames/in_phase.png", state.picture.frames],
      ["quadrature", "/frames/quadrature.png", state.picture.frames], ["confidence", "/confidence.png", state.picture.confidence]]) {
      at(id).hidden = !there;
      if (there) at(id).src = `${path}?${picture}`;
    }
  }
  charts.forEach((chart) => draw(chart, state.series));
  rows("losses", state.losses.map((loss) => [[loss.reason, "bad"], [String(loss.count), "number"],
    [`${((100 * loss.count) / Math.max(1, state.pages)).toFixed(1)}%`, "number"], [`${clock(loss.time_s)}  ${loss.detail}`, "long"]]), "none so far", 4);
  rows("models", state.models.slice().reverse().map((model) => [[`${model.version}${model.current ? " (in service)" : ""}`],
    [model.created], [shown(model.air_before, 3), "number"], [shown(model.air_after, 3), "number"]]), "none", 4);
  rows("recent", state.recent.map((page) => [[clock(page.time_s)], [page.page_index === null ? page.subject : String(page.page_index)],
    page.lost || page.unread ? [page.lost || page.unread, "bad"] : [page.recalibration_due ? "read, recalibration due" : "read"],
    [shown(page.margin_bits, 3), "number"], [shown(page.air_bits, 3), "number"], [shown(1000 * page.seconds, 0), "number"]]), "none yet", 6);
}

function showActions(state) {
  at("actions").hidden = !state.actions.length;
  at("caller").textContent = state.caller;
  const running = state.job !== null && state.job.state === "RUNNING";
  at("recalibrate").disabled = running || !state.actions.includes("recalibrate");
  at("roll-back").disabled = !state.actions.includes("roll back");
  if (state.job !== null) {
    const done = running ? ` ${Math.round(100 * state.job.fraction)}%` : "";
    at("outcome").textContent = `Recalibration ${state.job.id}: ${state.job.state.toLowerCase()}${done}${state.job.told ? `, ${state.job.told}` : ""}`;
  }
}

async function act(action, question) {
  const expected = inService;
  if (expected === null || !confirm(question(expected))) return;
  try {
    const reply = await fetch("/actions", { method: "POST", headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ action, expected }), signal: AbortSignal.timeout(60000) });
    const told = (await reply.text()).trim();
    if (reply.ok) at("outcome").textContent = told;
    else alert(`Not done: ${told}`);
  } catch {
    alert("No answer from the service.");
  }
}

async function turn() {
  try {
    const reply = await fetch("/state.json", { cache: "no-store", signal: AbortSignal.timeout(8000) });
    if (!reply.ok) throw new Error(String(reply.status));
    const state = await reply.json();
    answered = state.time_s; wait = 1000;
    at("silence").hidden = true;
    show(state);
  } catch {
    wait = Math.min(15000, 1.6 * wait);
    at("silence").hidden = false;
    at("silence").textContent = answered === null ? "No answer from the service." : `No answer from the service since ${clock(answered)}.`;
    at("condition").textContent = "no answer";
    at("condition").className = "badge bad";
  }
  setTimeout(turn, wait);
}

const charts = CHARTS.map((chart) => {
  const card = element("div", { class: "chart" }), title = element("h3", { title: chart.about }, chart.title);
  const now = element("span", { class: "now" }, "–");
  const svg = element("svg", { viewBox: `0 0 ${W} ${H}`, preserveAspectRatio: "none", role: "img", "aria-label": `${chart.title}, ${chart.unit}, over time` });
  title.append(now);
  card.append(title, svg);
  at("charts").append(card);
  return { ...chart, svg, now };
});
at("recalibrate").onclick = () => act("recalibrate", (version) => `Recalibrate ${version} with the source's next two known pages?`);
at("roll-back").onclick = () => act("roll back", (version) => `Take ${version} out of service, and put the model before back?`);
turn();
