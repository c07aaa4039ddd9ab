// The page: one twin at a time, brought up to date by its event stream.
import { ApiError, call, follow, onKeyNeeded } from "./api.js";
import { readAddress, writeAddress } from "./address.js";
import { InputChart, ResidualChart, TemperatureChart, forecastLength } from "./charts.js";
import { csvOf, save } from "./csv.js";
import { Fleet } from "./fleet.js";
import { clock, colour, count, isDark, make, seconds, span, toUnit, typed, unitName } from "./format.js";
import { NetworkDrawing, declared } from "./network.js";
import { drawAlarms, drawAnomalies, drawComparison, drawJobs, drawModels, drawNow } from "./panels.js";
import { PlanEditor } from "./plan.js";

const $ = (id) => document.getElementById(id);
const RANGES = [["1 h", 3600], ["6 h", 21600], ["1 d", 86400], ["7 d", 604800], ["all", Infinity]];
const HORIZONS = [["as the range", 0], ["1 h", 3600], ["3 h", 10800], ["6 h", 21600], ["12 h", 43200], ["1 d", 86400], ["3 d", 259200]];
const POINTS = 1500;
const MOST_CHANGES = 12;  // a channel that changes more often than that has no marks of its own
const LEAST_PAUSE_MS = 700;
const CATCH_UP_MS = 1000;  // what is assimilated in arrears is not told one by one

const state = {
  twin: null, detail: null, range_s: 86400, zoom: null, unit: null, kind: "residual", hidden: new Set(),
  latest: {}, anomalies: [], alarms: [], jobs: new Map(), models: [], archive: null, residuals: null, ahead: null, stop: null, again: null, link: "off",
  horizon_s: 0, predicted: false, plan: null, planned: null, activations: [], fleet: false, twins: [],
};
let zoomTo = () => {};
const temperatures = new TemperatureChart($("temperatures"), (ends) => zoomTo(ends));
const inputs = new InputChart($("inputs"), (ends) => zoomTo(ends));
const residuals = new ResidualChart($("residuals"), (ends) => zoomTo(ends));
const drawing = new NetworkDrawing($("network"));
const fleet = new Fleet($("fleet"), (twin) => select(twin));

// ---- what is shown

const units = () => Object.fromEntries(Object.entries(state.detail.specification.channels).map(([name, c]) => [name, c.unit]));

const sensors = () => {
  const names = state.detail.specification.nodes.flatMap((n) => n.sensor || []);
  return names.map((name, index) => ({ name, index, shown: !state.hidden.has(name) }));
};

// What drives the temperatures: every channel that reads no node, boundaries included.
const drivers = () => {
  const read = new Set(sensors().map((s) => s.name)), channels = state.detail.specification.channels;
  return Object.entries(channels).filter(([name]) => !read.has(name)).map(([name, c], index) => ({
    name, index: index + 3, shown: !state.hidden.has(name), unit: c.unit || (c.kind === "auxiliary" ? "1" : ""), kind: c.kind, levels: Boolean(c.levels),
    held: c.kind !== "temperature" && c.interpolation !== "linear",
  }));
};

const unitShown = () => state.unit || (sensors().some((s) => units()[s.name] === "degC") ? "degC" : "K");

function window_s() {
  const { first_time, last_time } = state.detail;
  if (!last_time) return null;
  const first = seconds(first_time), last = seconds(last_time);
  if (state.zoom) return { start: state.zoom[0], stop: state.zoom[1], live: state.zoom[1] >= last };
  const length = Math.min(state.range_s, Math.max(last - first, 60));
  return { start: last - length, stop: last, live: true };
}

function toast(text, look = "") {
  const box = make("div", { class: `toast ${look}` }, text);
  $("toasts").append(box);
  setTimeout(() => box.remove(), 6000);
}

const attempt = async (work) => {
  try {
    return await work();
  } catch (error) {
    toast(error.message, "bad");
    return null;
  }
};

// ---- fetching: what changed is marked, a loop fetches it and takes breaks that grow with the effort

const stale = new Set();
let fetching = null;

function refresh(...parts) {
  parts.forEach((part) => stale.add(part));
  fetching ||= pump().finally(() => { fetching = null; });
}

async function pump() {
  await new Promise((resolve) => setTimeout(resolve, 30));
  while (stale.size && state.twin) {
    const parts = new Set(stale), begun = performance.now();
    stale.clear();
    try {
      await load(parts);
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      if (error.status !== 404) toast(error.message, "bad");
    }
    await new Promise((resolve) => setTimeout(resolve, Math.max(LEAST_PAUSE_MS, 3 * (performance.now() - begun))));
  }
}

async function load(parts) {
  const twin = state.twin, path = `v1/twins/${twin}`;
  if (parts.has("detail") || parts.has("plots")) state.detail = await call(path);
  if (parts.has("models")) ({ models: state.models, activations: state.activations } = await call(`${path}/models`));
  if (parts.has("jobs")) {
    const lists = await Promise.all([call(`${path}/calibrations`), call(`${path}/diagnoses`)]);
    for (const job of lists.flatMap((l) => l.jobs)) state.jobs.set(job.id, job);
  }
  if (parts.has("anomalies")) {
    [state.anomalies, state.alarms] = await Promise.all([call(`${path}/anomalies`).then((a) => a.anomalies), call(`${path}/alarms`).then((a) => a.alarms)]);
  }
  if (parts.has("plots") && state.detail.last_time) await loadPlots(path);
  if (state.twin !== twin) return;
  render(parts);
  clearTimeout(state.again);
  if (state.detail.catching_up) state.again = setTimeout(() => refresh("plots", "anomalies"), CATCH_UP_MS);
}

async function loadPlots(path) {
  const { start, stop, live } = window_s();
  const names = [...sensors(), ...drivers()].map((s) => s.name).join(",");
  const query = `start=${start}&stop=${stop + 1e-6}&max_points=${POINTS}`;
  const horizon = state.horizon_s || forecastLength(stop - start);
  const look = { horizon_s: horizon, step_s: horizon / 120 };
  const active = state.detail.active_model !== null;
  const optional = (promise) => promise.catch((error) => { if (error instanceof ApiError && error.status < 500) return null; throw error; });
  [state.archive, state.residuals, state.ahead, state.network, state.planned] = await Promise.all([
    call(`${path}/telemetry?channels=${encodeURIComponent(names)}&${query}`),
    active ? optional(call(`${path}/residuals?${query}${state.predicted ? "&predicted=true" : ""}`)) : null,
    active && live ? optional(call(`${path}/forecast?horizon_s=${look.horizon_s}&step_s=${look.step_s}`)) : null,
    active ? optional(call(`${path}/network`)) : null,
    active && live && state.plan ? optional(call(`${path}/forecasts`, { method: "POST", body: { ...look, plan: state.plan } })) : null,
  ]);
  for (const [name, column] of Object.entries(state.archive.values)) {
    const known = live ? column.filter((v) => v !== null).at(-1) : undefined;
    if (known !== undefined) state.latest[name] = known;
  }
}

// ---- drawing

function render(parts) {
  drawTimes();
  drawFacts();
  drawLink();
  if (parts.has("detail")) renderNow();
  if (parts.has("jobs")) renderJobs();
  if (parts.has("models")) renderModels();
  if (parts.has("plots") || parts.has("anomalies") || parts.has("look")) renderPlots();
}

function drawFacts() {
  const { samples, last_time, active_model } = state.detail;
  const kept = state.detail.quarantined;
  const fact = (label, value) => make("span", {}, `${label} `, make("b", {}, value));
  $("facts").replaceChildren(
    fact("samples", count(samples)), fact("last", last_time ? `${clock(seconds(last_time))} UTC` : "–"),
    fact("model", active_model === null ? "none" : `v${active_model}`), ...(kept ? [fact("in quarantine", count(kept))] : []));
}

// "Live" is said of telemetry, not of the connection: silent sensors are told, and recordings that arrive late.
function drawLink() {
  const heard = state.detail ? sensors().map((s) => state.detail.telemetry[s.name]) : [];
  const silent = heard.filter((c) => c.state === "stale"), late = heard.filter((c) => c.state === "delayed");
  const ages = (list, key) => list.map((c) => c[key]).filter((v) => v !== null);
  let look = "live", words = "live";
  if (state.link !== "live") [look, words] = ["off", "reconnecting"];
  else if (!heard.some((c) => c.state !== "never")) words = "waiting for telemetry";
  else if (silent.length === heard.length) [look, words] = ["stale", ages(silent, "age_s").length ? `no telemetry for ${span(Math.min(...ages(silent, "age_s")))}` : "no telemetry now"];
  else if (silent.length) [look, words] = ["stale", `${silent.length} of ${heard.length} sensors silent`];
  else if (late.length) words = `arriving ${span(Math.max(...ages(late, "delay_s")))} late`;
  $("link").dataset.state = look;
  $("link-text").textContent = words;
}

const underWay = () => {
  const { catching_up, assimilation } = state.detail;
  return catching_up && assimilation ? `assimilating ${count(assimilation.done)} of ${count(assimilation.of)}` : "";
};
const standing = () => (state.detail.active_model === null ? "no model is active" : underWay());

function renderNow() {
  // A sensor behaves as expected only where something was expected: until a residual exists nobody knows.
  const has_residual = (name) => state.residuals !== null && state.residuals.residual_K[name].some((v) => v !== null);
  const doubt = (name) => (state.detail.active_model === null ? standing() : has_residual(name) ? "" : underWay() || "no residual yet");
  const unit = unitShown(), { latest, ahead, anomalies, alarms } = state;
  drawNow($("now"), { sensors: sensors(), units: units(), limits: limitsByName(), latest, ahead: ahead && ahead.values, unit, anomalies, alarms, doubt, telemetry: state.detail.telemetry });
  $("now-note").textContent = ahead ? `${unitName(unit)}, expected in ${span(seconds(ahead.time.at(-1)) - seconds(ahead.from))}` : unitName(unit);
}

function renderPlots() {
  const list = sensors(), unit = unitShown(), from = units();
  $("unit").textContent = unitName(unit);
  renderLegend(list);
  drawAlarms($("alarms"), state.alarms, { onAcknowledge: (a) => tell(a, "acknowledge"), onShelve: (a) => tell(a, "shelve", { for_s: a.shelved_until ? 0 : 3600 }) });
  drawAnomalies($("anomalies"), state.anomalies, list, standing(), (a) => zoomTo([seconds(a.start) - 1800, (a.stop ? seconds(a.stop) : seconds(state.detail.last_time)) + 1800]));
  const open = state.anomalies.filter((a) => a.stop === null).length;
  $("anomaly-note").textContent = open ? `${open} open` : "";
  if (!state.archive || !state.detail.last_time) {
    temperatures.clear(make("b", {}, "No telemetry yet"), make("span", {}, "Send samples and they appear here at once."));
    residuals.clear(make("span", {}, "Residuals need telemetry and an active model."));
    inputs.clear();
    $("inputs").hidden = drivers().length === 0;
  } else {
    renderTemperatures(list, unit, from);
    renderInputs(unit);
    renderResiduals(list);
  }
  renderNow();
  renderNetwork(unit, from);
}

function renderTemperatures(list, unit, from) {
  const { start, stop } = window_s(), { archive, ahead } = state;
  const convert = (column, name) => column.map((v) => toUnit(v, from[name], unit));
  const per = (pick) => Object.fromEntries(list.map((s) => [s.name, convert(pick(s.name), s.name)]));
  const forecast = ahead && {
    time: ahead.time.map(seconds), mean: per((n) => ahead.values[n].mean), low: per((n) => ahead.values[n].q05), high: per((n) => ahead.values[n].q95),
  };
  const end = forecast ? forecast.time.at(-1) : stop, found = state.residuals;
  const predicted = state.predicted && found && found.predicted
    ? { time: found.time.map(seconds), values: per((n) => found.predicted[n]) } : null;
  const planned = state.planned && forecast ? { time: state.planned.time.map(seconds), values: per((n) => state.planned.values[n].mean) } : null;
  temperatures.update({
    range: [start, end], sensors: list, unit: unitName(unit), now: ahead ? seconds(ahead.from) : null, forecast,
    predicted, planned, limits: limits(list, unit, from), marks: marks(),
    measured: { time: archive.time.map(seconds), values: per((n) => archive.values[n]) },
  });
  $("plot-note").textContent = [
    archive.downsampled ? `extremes of ${count(archive.samples)} samples` : `${count(archive.samples)} samples`,
    ahead ? `dashed: forecast with its 90 % band${assumed(ahead.inputs)}` : "",
    predicted ? "dotted: predicted one sample ahead" : "",
    planned ? "thick: with your plan" : "",
    ahead && ahead.behind_s > 0 ? `not from the present: ${span(ahead.behind_s)} behind the last sample` : "",
  ].filter(Boolean).join(" · ");
}

const limitsByName = () => Object.fromEntries(Object.entries(state.detail.specification.channels).map(([name, channel]) => [name, channel.limits]));

function limits(list, unit, from) {
  return list.flatMap(({ name, index }) => Object.entries(state.detail.specification.channels[name].limits || {})
    .flatMap(([look, ends]) => ends.filter((v) => v !== null).map((v) => ({ name, index, colour: look, bound: toUnit(v, from[name], unit) }))));
}

// What happened in the time shown: modes and heaters that changed, models that were activated.
function marks() {
  const { archive } = state, found = [];
  for (const { name, kind, levels, unit } of drivers()) {
    const said = (value, last) => (levels ? value : value === 0 ? "off" : last === 0 ? "on" : `${value} ${unit}`);
    const column = archive.values[name] || [], known = column.filter((v) => v !== null);
    if (!levels && !(kind === "power" && new Set(known).size <= 3)) continue;
    let last = null;
    const changes = [];
    column.forEach((value, i) => {
      if (value === null) return;
      if (last !== null && value !== last) changes.push({ time: seconds(archive.time[i]), text: `${name} ${said(value, last)}` });
      last = value;
    });
    if (levels || changes.length <= MOST_CHANGES) found.push(...changes);
  }
  const together = new Map();  // what changed at one moment has one mark
  for (const { time, text } of found) together.set(time, together.has(time) ? `${together.get(time)}, ${text}` : text);
  const models = state.activations.map(({ version, time }) => ({ time: seconds(time), text: `model v${version}` }));
  return [...[...together].map(([time, text]) => ({ time, text })), ...models].sort((a, b) => a.time - b.time);
}

function renderInputs(unit) {
  const list = drivers(), { archive, ahead, plan } = state;
  $("inputs").hidden = list.length === 0;
  if (!list.length) return;
  const { start, stop } = window_s();
  const convert = (column, s) => (s.kind === "temperature" ? column.map((v) => toUnit(v, s.unit, unit)) : column);
  const shown = list.map((s) => ({ ...s, unit: s.kind === "temperature" ? unitName(unit) : s.unit }));
  const until = ahead ? seconds(ahead.time.at(-1)) : stop;  // what a plan says last holds on
  const held = (column) => [...column, column.findLast((v) => v !== null)];
  const planned = plan && { time: [...plan.time, until], values: Object.fromEntries(list.map((s) => [s.name, plan.values[s.name] ? held(plan.values[s.name]) : [...plan.time, until].map(() => null)])) };
  inputs.update({
    range: [start, until], inputs: shown, time: archive.time.map(seconds), planned,
    values: Object.fromEntries(list.map((s) => [s.name, convert(archive.values[s.name] || archive.time.map(() => null), s)])),
  });
  legend($("input-legend"), shown.map((s) => ({ ...s, aside: s.unit !== shown[0].unit && s.unit !== "1" })));  // those have scales of their own
}

// What the forecast takes the inputs to do, in words: ", Q_sun repeats, Q_box holds".
function assumed(inputs) {
  const named = (how, word) => {
    const names = Object.keys(inputs).filter((name) => inputs[name] === how);
    return names.length ? `${names.length > 4 ? `${names.length} inputs` : names.join(", ")} ${word}` : "";
  };
  const parts = [named("repeat", "as in the last period"), named("hold", "held"), named("orbit", "from the orbit")].filter(Boolean);
  return parts.length ? `; ${parts.join(", ")}` : "";
}

function renderResiduals(list) {
  const found = state.residuals;
  if (!found || !found.time.length) {
    const words = state.detail.active_model === null ? "No model is active yet: calibrate, and every sample is compared with what the model expects." : "No residuals in this range.";
    residuals.clear(make("span", {}, words));
    $("residual-note").textContent = "";
    return;
  }
  const { start, stop } = window_s();
  const anomalies = state.anomalies.filter((a) => a.model_version === found.model_version[0]).map((a) => ({ sensor: a.sensor, start: seconds(a.start), stop: a.stop && seconds(a.stop) }));
  const end = state.ahead ? seconds(state.ahead.time.at(-1)) : stop;
  residuals.update({ range: [start, end], kind: state.kind, sensors: list, time: found.time.map(seconds), values: found.residual_K, nis: found.nis, anomalies });
  $("residual-note").textContent = `measured minus predicted one step ahead, model v${found.model_version[0]}`;
}

const renderLegend = (list) => legend($("legend"), list);

function legend(box, list) {
  const focused = box.contains(document.activeElement) ? [...box.children].indexOf(document.activeElement) : -1;
  box.replaceChildren(...list.map((s) => {
    const dot = make("span", { class: "dot" });
    dot.style.background = colour(s.index);
    return make("button", { "aria-pressed": String(s.shown), title: "Click: show or hide. Alt-click: this one only.", onclick: (e) => toggle(s.name, e.altKey) }, dot, s.name, s.aside ? make("span", { class: "sub" }, s.unit) : null);
  }));
  if (focused >= 0) box.children[focused]?.focus();
}

function toggle(name, alone) {
  const room = sensors().some((s) => s.name === name) ? sensors() : drivers(), names = room.map((s) => s.name);
  if (alone) {
    const only = names.every((n) => (n === name) !== state.hidden.has(n));
    names.forEach((n) => state.hidden[only || n === name ? "delete" : "add"](n));
  } else if (!state.hidden.delete(name)) state.hidden.add(name);
  keepAddress();
  renderPlots();
}

function renderNetwork(unit, from) {
  const latest_K = Object.fromEntries(Object.entries(state.latest).map(([n, v]) => [n, toUnit(v, from[n], "K")]));
  drawing.update(state.network || declared(state.detail.specification, latest_K), unit);
  $("network-note").textContent = state.network ? `at ${clock(seconds(state.network.time))} UTC, ${unitName(unit)}; width: heat flow` : "as declared; calibrate to see the heat flows";
}

function renderJobs() {
  const jobs = [...state.jobs.values()].sort((a, b) => (a.created < b.created ? 1 : -1));
  drawJobs($("jobs"), jobs, { onCancel: cancel, onReport: openReport });
}

function renderModels() {
  $("model-note").textContent = state.models.length ? "" : "none yet";
  drawModels($("models"), state.models, (model) => attempt(async () => {
    if (!(await agreed(model))) return;
    await call(`v1/twins/${state.twin}/models/${model.version}/activate`, { method: "POST" });
    toast(`Version ${model.version} is active`, "good");
  }));
}

// ---- what the operator does

// Shows a version beside the active one; true if the operator wants the switch.
let withdraw = () => {};
function agreed(model) {
  const dialog = $("activate-dialog"), worse = drawComparison($("compare"), state.models.find((m) => m.active), model);
  withdraw();  // a question that was closed, the event of which has not come yet
  $("activate-title").textContent = worse || `Activate version ${model.version}?`;
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => {
    const answer = (yes) => { dialog.removeEventListener("close", closed); resolve(yes); };
    const closed = () => dialog.open || answer(dialog.returnValue === "yes");  // open: the event of the question before
    withdraw = () => answer(false);
    dialog.addEventListener("close", closed);
  });
}

// Compares a plan with the forecast; a plan that the service refuses leaves everything as it was.
async function comparePlan(plan) {
  if (plan) {
    const { start, stop } = window_s(), horizon_s = state.horizon_s || forecastLength(stop - start);
    await call(`v1/twins/${state.twin}/forecasts`, { method: "POST", body: { horizon_s, step_s: horizon_s / 120, plan } });
  }
  state.plan = plan;
  $("what-if").setAttribute("aria-pressed", String(Boolean(plan)));
  refresh("plots");
}
const editor = new PlanEditor($, comparePlan);

function openPlan() {
  const list = drivers().filter((s) => s.kind !== "auxiliary" || s.held);
  if (state.detail.active_model === null || !state.ahead) return toast("A plan needs an active model and a forecast from the present.", "bad");
  if (!list.length) return toast("This twin has no inputs to plan.", "bad");
  editor.open(list, seconds(state.ahead.from));
}

function download() {
  if (!state.archive) return;
  const { archive, ahead, planned } = state, shown = [...sensors(), ...drivers()].filter((s) => s.shown);
  save(`${state.twin}.csv`, csvOf({ archive, ahead, planned, names: shown.map((s) => s.name), units: units() }));
}

const keepAddress = () => history.replaceState(null, "", writeAddress(state.fleet ? { twin: null } : state));

function drawTimes() {
  const shown = state.detail?.last_time ? window_s() : null;
  if (!shown || $("times").contains(document.activeElement)) return;
  [$("from").value, $("to").value] = [clock(shown.start), clock(shown.stop)];
}

const room = (kind) => (kind === "calibration" ? "calibrations" : "diagnoses");

const startJob = (kind) => attempt(async () => {
  const job = await call(`v1/twins/${state.twin}/${room(kind)}`, { method: "POST", body: {} });
  state.jobs.set(job.id, job);
  renderJobs();
});

const cancel = (job) => attempt(async () => {
  await call(`v1/twins/${state.twin}/${room(job.kind)}/${job.id}`, { method: "DELETE" });
  refresh("jobs");
});

const openReport = (job) => attempt(async () => {
  $("report").srcdoc = await call(`v1/twins/${state.twin}/diagnoses/${job.id}/report.html`);
  $("report-dialog").showModal();
});

const tell = (alarm, what, body = {}) => attempt(async () => {
  await call(`v1/twins/${state.twin}/alarms/${alarm.id}/${what}`, { method: "POST", body });
  refresh("anomalies");
});

zoomTo = (ends) => {
  state.zoom = ends;
  drawRanges();
  keepAddress();
  refresh("plots");
};

// Moves the time shown by a share of its length, or makes it longer or shorter around its middle.
function move(by, scale = 1) {
  const shown = state.detail.last_time && window_s();
  if (!shown) return;
  const length = shown.stop - shown.start, middle = (shown.start + shown.stop) / 2 + by * length, half = Math.max(length * scale, 60) / 2;
  zoomTo([middle - half, middle + half]);
}

function drawRanges() {
  $("ranges").replaceChildren(...RANGES.map(([label, length]) => make("button", {
    "aria-pressed": String(!state.zoom && state.range_s === length),
    onclick: () => { state.range_s = length; zoomTo(null); },
  }, label)));
}

function drawKinds() {
  $("residual-kind").replaceChildren(...[["residual", "Residual"], ["nis", "NIS"]].map(([kind, label]) => make("button", {
    "aria-pressed": String(state.kind === kind),
    onclick: () => { state.kind = kind; drawKinds(); renderPlots(); },
  }, label)));
}

function hear(message) {
  if (message.type === "sample") {
    Object.assign(state.latest, message.values);
    if (!state.zoom) refresh("plots");
  } else if (message.type === "residual") {
    if (!state.zoom) refresh("plots");
  } else if (message.type === "anomaly" || message.type === "alarm") {
    refresh("anomalies");
  } else if (message.type === "job") {
    state.jobs.set(message.job.id, message.job);
    renderJobs();
    if (message.job.state === "succeeded") refresh("jobs", "anomalies");
  } else if (message.type === "model") {
    refresh("models", "plots", "anomalies");
  } else {
    refresh("plots", "jobs", "models", "anomalies");
  }
}

function showFleet(is_on) {
  state.fleet = is_on;
  if (is_on) {
    if (state.stop) state.stop.abort();
    state.twin = null;
    $("facts").replaceChildren();
    $("link").dataset.state = "live";
    $("link-text").textContent = `${count(state.twins.length)} twins`;
    keepAddress();
  }
  $("main").hidden = $("picker").hidden = is_on || !state.twins.length;
  $("to-fleet").hidden = is_on || state.twins.length < 2;
  fleet.show(is_on);
}

function select(twin, view = {}) {
  if (state.stop) state.stop.abort();
  showFleet(false);
  state.range_s = view.range_s ?? state.range_s;
  state.unit = view.unit ?? state.unit;
  state.horizon_s = view.horizon_s ?? state.horizon_s;
  $("horizon").value = String(state.horizon_s);
  $("what-if").setAttribute("aria-pressed", "false");
  Object.assign(state, { twin, detail: null, zoom: view.zoom ?? null, hidden: new Set(view.hidden ?? []), plan: null, planned: null, activations: [], latest: {}, anomalies: [], alarms: [], jobs: new Map(), models: [], archive: null, residuals: null, ahead: null, network: null });
  state.stop = new AbortController();
  $("twin").value = twin;
  keepAddress();
  drawRanges();
  temperatures.clear();
  residuals.clear();
  inputs.clear();
  refresh("detail", "models", "jobs", "anomalies", "plots");
  follow(twin, state.stop.signal, hear, (link) => {
    state.link = link;
    drawLink();
    if (link === "live") refresh("plots", "jobs", "models", "anomalies");
  });
}

async function findTwins() {
  const { twins: names } = await call("v1/fleet/names");
  state.twins = names;
  $("empty").hidden = names.length > 0;
  $("to-fleet").hidden = state.fleet || names.length < 2;
  if (state.fleet) $("link-text").textContent = `${count(names.length)} twins`;
  else $("main").hidden = $("picker").hidden = names.length === 0;
  if ([...$("twin").options].map((o) => o.value).join() !== names.join()) {
    $("twin").replaceChildren(...names.map((name) => make("option", { value: name }, name)));
    if (state.twin) $("twin").value = state.twin;
  }
  if (!names.length) $("link-text").textContent = "waiting for a twin";
  const asked = readAddress(location.hash);
  if (!names.length) state.twin = null;
  else if (state.fleet || names.includes(state.twin)) return;
  else if (names.includes(asked.twin)) select(asked.twin, asked);
  else if (names.length > 1) showFleet(true);
  else select(names[0]);
}

const step = (by) => {
  const names = [...$("twin").options].map((o) => o.value);
  if (names.length > 1) select(names[(names.indexOf(state.twin) + by + names.length) % names.length]);
};

function switchTheme() {
  document.documentElement.dataset.theme = isDark() ? "light" : "dark";
  localStorage.setItem("thermal-twin-theme", document.documentElement.dataset.theme);
  if (state.detail) { renderPlots(); renderJobs(); renderModels(); }
}

function switchUnit() {
  state.unit = unitShown() === "K" ? "degC" : "K";
  keepAddress();
  renderPlots();
}

const KEYS = [
  ["1–5", "time range: an hour to everything"], ["0", "follow the present again"],
  ["← →", "earlier, later"], ["+ −", "closer, wider"], ["c", "calibrate"], ["d", "diagnose"],
  ["n", "residual or NIS"], ["p", "what was predicted"], ["w", "what if: plan inputs"], ["s", "save as CSV"], ["f", "all twins"], ["u", "kelvin or degrees Celsius"], ["t", "light or dark"], ["j / k", "next or previous twin"], ["?", "these keys"],
];

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, dialog") || !(state.detail || state.fleet)) return;
  if (state.fleet) return event.key === "t" ? switchTheme() : undefined;
  const acts = {
    c: () => $("calibrate").click(), d: () => $("diagnose").click(), t: switchTheme, u: switchUnit, j: () => step(1), k: () => step(-1),
    n: () => { state.kind = state.kind === "nis" ? "residual" : "nis"; drawKinds(); renderPlots(); },
    p: () => $("predicted").click(), w: openPlan, s: download, f: () => state.twins.length > 1 && showFleet(true),
    ArrowLeft: () => move(-0.5), ArrowRight: () => move(0.5), "+": () => move(0, 0.5), "-": () => move(0, 2),
    0: () => zoomTo(null), "?": () => $("help-dialog").showModal(),
  };
  RANGES.forEach(([, length], i) => { acts[i + 1] = () => { state.range_s = length; zoomTo(null); }; });
  if (acts[event.key]) {
    event.preventDefault();
    acts[event.key]();
  }
}

// ---- beginning


onKeyNeeded((refused) => new Promise((resolve) => {
  const dialog = $("key-dialog");
  $("key-refused").hidden = !refused;
  dialog.showModal();
  dialog.addEventListener("close", () => resolve($("key").value), { once: true });
}));

const chosen = localStorage.getItem("thermal-twin-theme");
if (chosen) document.documentElement.dataset.theme = chosen;
$("keys").replaceChildren(...KEYS.flatMap(([key, words]) => [make("dt", {}, key), make("dd", {}, words)]));
$("empty-code").textContent = `curl ${location.origin}/v1/twins -H 'Content-Type: application/json' -d @specification.json\n\ntwin replay orbits.mcap --url ${location.origin} --twin ID --rate 60`;
$("twin").addEventListener("change", () => select($("twin").value));
$("calibrate").addEventListener("click", () => startJob("calibration"));
$("diagnose").addEventListener("click", () => startJob("diagnosis"));
$("theme").addEventListener("click", switchTheme);
$("unit").addEventListener("click", switchUnit);
$("to-fleet").addEventListener("click", () => showFleet(true));
$("what-if").addEventListener("click", openPlan);
$("csv").addEventListener("click", download);
$("predicted").addEventListener("click", () => {
  state.predicted = !state.predicted;
  $("predicted").setAttribute("aria-pressed", String(state.predicted));
  refresh("plots");
});
$("horizon").replaceChildren(...HORIZONS.map(([label, length]) => make("option", { value: length }, label)));
$("horizon").addEventListener("change", () => {
  state.horizon_s = Number($("horizon").value);
  keepAddress();
  refresh("plots");
});
$("times").addEventListener("submit", (event) => {
  event.preventDefault();
  const ends = [$("from").value, $("to").value].map(typed);
  if (!ends.every(Number.isFinite)) return toast("Write both times as 2026-01-31 12:00, in UTC.", "bad");
  if (ends[0] >= ends[1]) return toast("The first time must come before the last one.", "bad");
  document.activeElement.blur();
  zoomTo(ends);
});
$("help").addEventListener("click", () => $("help-dialog").showModal());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (state.detail) renderPlots(); });
addEventListener("keydown", pressed);
drawRanges();
drawKinds();
const look = () => findTwins().catch(() => { $("link").dataset.state = "off"; $("link-text").textContent = "no answer"; });
await look();
setInterval(look, 4000);
setInterval(() => { if (state.twin) refresh("detail"); }, 5000);  // silence sends no message
