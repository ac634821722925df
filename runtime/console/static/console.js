"use strict";
// Asks for /state.json about once a second and shows it. Administrators may recalibrate and roll back; else it changes nothing.

// `span`: the least range of values that is drawn, so that noise does not look like a crash. `signs`: the monitor's signs
// whose usual and alarm values are drawn, one for each line.
const CHARTS = [
  { title: "Margin", unit: "bit a symbol", digits: 3, lines: [["margin_bits", "margin"]], signs: ["margin_bits"], span: 0.15, limit: 0, need: "the code needs",
    about: "Information beyond what a page's code needs. At 0 pages are lost." },
  { title: "AIR, estimated", unit: "bit a symbol", digits: 3, lines: [["air_bits", "AIR"]], signs: ["air_bits"], span: 0.5, calibrated: true,
    about: "Information that a symbol is claimed to carry, as far as the pilots bear it out." },
  { title: "Pilots", unit: "share", digits: 3, lines: [["trust", "trust"], ["share", "confirmed"]], signs: ["trust", "share"], span: 0.25,
    about: "What the pilots bear out of the claimed concentration, and of the claimed information." },
  { title: "Image shift", unit: "camera px", digits: 2, lines: [["shift_x_px", "x"], ["shift_y_px", "y"]], signs: ["shift_px"], either: true, span: 1,
    about: "Where the image lies, against where calibration saw it." },
  { title: "Piston", unit: "rad", digits: 2, lines: [["piston_rad", "piston"]], signs: [], span: 2 * Math.PI, turns: true,
    about: "Common phase of a page, which is taken off. It wanders by itself." },
  { title: "Phase residual", unit: "rad", digits: 4, lines: [["residual_rad", "residual"]], signs: ["residual_rad"], span: 0.01, limit: 0,
    about: "Smooth phase error that was taken off, root mean square." },
  { title: "Modulator's stroke", unit: "relative", digits: 4, lines: [["stroke_relative", "stroke"]], signs: ["stroke_relative"], either: true, span: 0.002,
    about: "Its change since calibration, as the pilots show it. It goes with temperature." },
];
const CONDITIONS = { reading: "good", idle: "", "no page yet": "", "recalibration is due": "warn", "pages are being lost": "bad" };
const H = 150, LEFT = 46, RIGHT = 8, TOP = 14, BOTTOM = 22;
const IDLE = 8, IDLE_S = 20; // times the usual step between pages, and seconds, beyond which a pause is cut short
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
element.svg = new Set(["line", "path", "text", "title"]);

function ticks(low, high) {
  const step = 10 ** Math.floor(Math.log10((high - low) / 3));
  const best = [1, 2, 5, 10].map((m) => m * step).find((s) => (high - low) / s <= 4);
  const found = [];
  for (let value = Math.ceil(low / best) * best; value <= high + 1e-9 * best; value += best) found.push(value);
  return [found, Math.max(0, -Math.floor(Math.log10(best)))];
}

// Places of pages along the axis, 0 to 1: by time, with idle times cut short, since they would press the pages into spikes.
function places(times) {
  const steps = times.slice(1).map((t, i) => Math.max(0, t - times[i]));
  const longest = Math.max(IDLE_S, IDLE * (steps.slice().sort((a, b) => a - b)[steps.length >> 1] || 0));
  const at = [0];
  steps.forEach((step) => at.push(at[at.length - 1] + Math.min(step, longest)));
  const whole = at[at.length - 1];
  return [at.map((place) => (whole > 0 ? place / whole : 0.5)), steps.map((step) => step > longest)];
}

// What to compare a chart's values with: [values, words, kind].
function marksOf(chart, state) {
  const marks = [];
  chart.signs.forEach((name, k) => {
    const { baseline: usual, raise_at: alarm } = state.signs[name], whose = chart.signs.length > 1 ? `${chart.lines[k][1]} ` : "";
    if (usual === null) return;
    const far = Math.abs(alarm - usual), about = chart.either ? "±" : "";
    if (!chart.either) marks.push([[usual], `${whose}usual ${shown(usual, chart.digits)}`, "usual"]);
    marks.push([chart.either ? [usual - far, usual + far] : [alarm], `${whose}alarm ${about}${shown(chart.either ? far : alarm, chart.digits)}`, "alarm"]);
  });
  const current = state.models.find((model) => model.current);
  if (chart.calibrated && current && current.air !== null) marks.push([[current.air], `calibrated ${shown(current.air, chart.digits)}`, "calibrated"]);
  if (chart.need) marks.push([[0], `${chart.need} 0`, "limit"]);
  return marks;
}

// The range of a chart: that of its values, widened to `span` and by marks that do not lie far off.
function rangeOf(chart, values, marks) {
  let low = Math.min(...values), high = Math.max(...values);
  if (chart.limit !== undefined) { low = Math.min(low, chart.limit); high = Math.max(high, chart.limit); }
  if (chart.turns) { low = -Math.PI; high = Math.PI; }
  const lacks = Math.max(0, chart.span - (high - low)) / 2;
  low -= lacks; high += lacks;
  if (chart.limit !== undefined && low < chart.limit && lacks) { high += chart.limit - low; low = chart.limit; }
  const far = 1.5 * (high - low), [first, last] = [low - far, high + far];
  for (const value of marks.flatMap(([values]) => values)) if (value > first && value < last) { low = Math.min(low, value); high = Math.max(high, value); }
  const room = 0.06 * (high - low);
  return [low - room, high + room];
}

function draw(chart, state) {
  const { svg, now, told } = chart, series = state.series, W = svg.clientWidth || 420;
  const times = series.time_s, values = chart.lines.map(([name]) => series[name]);
  const all = values.flat().filter((v) => v !== null);
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${W} ${H}`);
  if (!all.length) {
    svg.append(element("text", { x: W / 2, y: H / 2, "text-anchor": "middle" }, "no figures yet"));
    now.textContent = "–";
    told.replaceChildren();
    return;
  }
  const marks = marksOf(chart, state), [low, high] = rangeOf(chart, all, marks);
  const [place, idle] = places(times);
  const x = (i) => LEFT + place[i] * (W - LEFT - RIGHT);
  const y = (v) => TOP + ((high - v) / (high - low)) * (H - TOP - BOTTOM);
  const [ruled, digits] = ticks(low, high);
  for (const value of ruled) {
    svg.append(element("line", { class: "grid", x1: LEFT, x2: W - RIGHT, y1: y(value), y2: y(value) }));
    svg.append(element("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, value.toFixed(digits)));
  }
  svg.append(element("text", { x: LEFT, y: H - 5 }, clock(times[0])));
  svg.append(element("text", { x: W - RIGHT, y: H - 5, "text-anchor": "end" }, clock(times[times.length - 1])));
  idle.forEach((pause, i) => {
    if (!pause) return;
    const middle = (x(i) + x(i + 1)) / 2, line = element("line", { class: "idle", x1: middle, x2: middle, y1: TOP, y2: H - BOTTOM });
    line.append(element("title", {}, `idle for ${span(times[i + 1] - times[i])}`));
    svg.append(line);
  });
  const lost = times.map((_, i) => i).filter((i) => series.lost[i] || series.unread[i]);
  if (lost.length) svg.append(element("path", { class: "lost", d: lost.map((i) => `M${x(i).toFixed(1)} ${H - BOTTOM}v-6`).join("") }));
  told.replaceChildren();
  for (const [compared, words, kind] of marks) {
    const seen = compared.filter((value) => value > low && value < high);
    for (const value of seen) svg.append(element("line", { class: kind, x1: LEFT, x2: W - RIGHT, y1: y(value), y2: y(value) }));
    told.append(element("span", { class: kind }, `${words}${seen.length ? "" : " (beyond the scale)"}`), " ");
  }
  values.forEach((line, k) => {
    let path = "", before = null;
    line.forEach((value, i) => {
      if (value === null) { before = null; return; }
      const joined = before !== null && !idle[i - 1] && !(chart.turns && Math.abs(value - before) > Math.PI);
      path += `${joined ? "L" : "M"}${x(i).toFixed(1)} ${y(value).toFixed(1)}${joined ? "" : "h0.01"}`;
      before = value;
    });
    svg.append(element("path", { class: `line ${"ab"[k]}`, d: path, "stroke-linecap": "round" }));
  });
  const cursor = element("line", { class: "cursor", y1: TOP, y2: H - BOTTOM, x1: -9, x2: -9 });
  svg.append(cursor);
  const raised = chart.signs.map((name) => state.signs[name].raised);
  const tell = (i, when) => {
    now.replaceChildren();
    chart.lines.forEach(([, label], k) => {
      const value = element("span", { class: `key-${"ab"[k]}` }, `${chart.lines.length > 1 ? label + " " : ""}${shown(values[k][i], chart.digits)} `);
      now.append(value);
    });
    now.append(`${chart.unit}${when ? ` at ${clock(times[i])}` : ""}`);
    if (!when && raised.some((each) => each)) now.append(element("span", { class: "raised" }, " alarm"));
  };
  const newest = () => { let i = times.length - 1; while (i > 0 && values.every((v) => v[i] === null)) i--; tell(i, false); cursor.setAttribute("x1", -9); cursor.setAttribute("x2", -9); };
  svg.onpointermove = (event) => {
    const px = event.clientX - svg.getBoundingClientRect().left;
    let best = 0;
    times.forEach((_, i) => { if (Math.abs(x(i) - px) < Math.abs(x(best) - px)) best = i; });
    cursor.setAttribute("x1", x(best)); cursor.setAttribute("x2", x(best));
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
      ["quadrature", "/frames/quadrature.png", state.picture.frames], ["air", "/air.png", state.picture.air]]) {
      at(id).hidden = !there;
      if (there) at(id).src = `${path}?${picture}`;
    }
  }
  charts.forEach((chart) => draw(chart, state));
  rows("losses", state.losses.map((loss) => [[loss.reason, "bad"], [String(loss.count), "number"],
    [`${((100 * loss.count) / Math.max(1, state.pages)).toFixed(1)}%`, "number"], [`${clock(loss.time_s)}  ${loss.detail}`, "long"]]), "none so far", 4);
  rows("models", state.models.slice().reverse().map((model) => [[`${model.version}${model.current ? " (in service)" : ""}`],
    [model.created], [shown(model.air_before, 3), "number"], [shown(model.air, 3), "number"]]), "none", 4);
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
  const svg = element("svg", { role: "img", "aria-label": `${chart.title}, ${chart.unit}, over time` });
  title.append(now);
  const told = element("p", { class: "told" });
  card.append(title, told, svg);
  at("charts").append(card);
  return { ...chart, svg, now, told };
});
at("recalibrate").onclick = () => act("recalibrate", (version) => `Recalibrate ${version} with the source's next two known pages?`);
at("roll-back").onclick = () => act("roll back", (version) => `Take ${version} out of service, and put the model before back?`);
turn();
