// The page: one twin at a time, brought up to date by its event stream.
import { ApiError, call, follow, onKeyNeeded } from "./api.js";
import { ResidualChart, TemperatureChart, forecastLength } from "./charts.js";
import { clock, colour, count, isDark, make, seconds, span, toUnit, unitName } from "./format.js";
import { NetworkDrawing, declared } from "./network.js";
import { drawAlarms, drawAnomalies, drawJobs, drawModels, drawNow } from "./panels.js";

const $ = (id) => document.getElementById(id);
const RANGES = [["1 h", 3600], ["6 h", 21600], ["1 d", 86400], ["7 d", 604800], ["all", Infinity]];
const POINTS = 1500;
const LEAST_PAUSE_MS = 700;
const CATCH_UP_MS = 1000;  // what is assimilated in arrears is not told one by one

const state = {
  twin: null, detail: null, range_s: 86400, zoom: null, unit: null, kind: "residual", hidden: new Set(),
  latest: {}, anomalies: [], alarms: [], jobs: new Map(), models: [], archive: null, residuals: null, ahead: null, stop: null, again: null, link: "off",
};
let zoomTo = () => {};
const temperatures = new TemperatureChart($("temperatures"), (ends) => zoomTo(ends));
const residuals = new ResidualChart($("residuals"), (ends) => zoomTo(ends));
const drawing = new NetworkDrawing($("network"));

// ---- what is shown

const units = () => Object.fromEntries(Object.entries(state.detail.specification.channels).map(([name, c]) => [name, c.unit]));

const sensors = () => {
  const names = state.detail.specification.nodes.flatMap((n) => n.sensor || []);
  return names.map((name, index) => ({ name, index, shown: !state.hidden.has(name) }));
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
  if (parts.has("models")) state.models = (await call(`${path}/models`)).models;
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
  const names = sensors().map((s) => s.name).join(",");
  const query = `start=${start}&stop=${stop + 1e-6}&max_points=${POINTS}`;
  const horizon = forecastLength(stop - start);
  const active = state.detail.active_model !== null;
  const optional = (promise) => promise.catch((error) => { if (error instanceof ApiError && error.status < 500) return null; throw error; });
  [state.archive, state.residuals, state.ahead, state.network] = await Promise.all([
    call(`${path}/telemetry?channels=${encodeURIComponent(names)}&${query}`),
    active ? optional(call(`${path}/residuals?${query}`)) : null,
    active && live ? optional(call(`${path}/forecast?horizon_s=${horizon}&step_s=${horizon / 120}`)) : null,
    active ? optional(call(`${path}/network`)) : null,
  ]);
  for (const [name, column] of Object.entries(state.archive.values)) {
    const known = live ? column.filter((v) => v !== null).at(-1) : undefined;
    if (known !== undefined) state.latest[name] = known;
  }
}

// ---- drawing

function render(parts) {
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
  drawNow($("now"), { sensors: sensors(), units: units(), latest, ahead: ahead && ahead.values, unit, anomalies, alarms, doubt, telemetry: state.detail.telemetry });
  $("now-note").textContent = ahead ? `${unitName(unit)}, expected in ${span(seconds(ahead.time.at(-1)) - seconds(ahead.from))}` : unitName(unit);
}

function renderPlots() {
  const list = sensors(), unit = unitShown(), from = units();
  $("unit").textContent = unitName(unit);
  renderLegend(list);
  drawAlarms($("alarms"), state.alarms.filter((a) => a.stop === null), { onAcknowledge: (a) => tell(a, "acknowledge"), onShelve: (a) => tell(a, "shelve", { for_s: a.shelved_until ? 0 : 3600 }) });
  drawAnomalies($("anomalies"), state.anomalies, list, standing(), (a) => zoomTo([seconds(a.start) - 1800, (a.stop ? seconds(a.stop) : seconds(state.detail.last_time)) + 1800]));
  const open = state.anomalies.filter((a) => a.stop === null).length;
  $("anomaly-note").textContent = open ? `${open} open` : "";
  if (!state.archive || !state.detail.last_time) {
    temperatures.clear(make("b", {}, "No telemetry yet"), make("span", {}, "Send samples and they appear here at once."));
    residuals.clear(make("span", {}, "Residuals need telemetry and an active model."));
  } else {
    renderTemperatures(list, unit, from);
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
  const end = forecast ? forecast.time.at(-1) : stop;
  temperatures.update({
    range: [start, end], sensors: list, unit: unitName(unit), now: ahead ? seconds(ahead.from) : null, forecast,
    measured: { time: archive.time.map(seconds), values: per((n) => archive.values[n]) },
  });
  $("plot-note").textContent = [
    archive.downsampled ? `extremes of ${count(archive.samples)} samples` : `${count(archive.samples)} samples`,
    ahead ? `dashed: forecast with its 90 % band${assumed(ahead.inputs)}` : "",
    ahead && ahead.behind_s > 0 ? `not from the present: ${span(ahead.behind_s)} behind the last sample` : "",
  ].filter(Boolean).join(" · ");
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

function renderLegend(list) {
  $("legend").replaceChildren(...list.map((s) => {
    const dot = make("span", { class: "dot" });
    dot.style.background = colour(s.index);
    return make("button", { "aria-pressed": String(s.shown), title: "Click: show or hide. Alt-click: this one only.", onclick: (e) => toggle(s.name, e.altKey) }, dot, s.name);
  }));
}

function toggle(name, alone) {
  const names = sensors().map((s) => s.name);
  if (alone) {
    const only = names.every((n) => (n === name) !== state.hidden.has(n));
    state.hidden = new Set(only ? [] : names.filter((n) => n !== name));
  } else if (!state.hidden.delete(name)) state.hidden.add(name);
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
    await call(`v1/twins/${state.twin}/models/${model.version}/activate`, { method: "POST" });
    toast(`Version ${model.version} is active`, "good");
  }));
}

// ---- what the operator does

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

function select(twin) {
  if (state.stop) state.stop.abort();
  Object.assign(state, { twin, detail: null, zoom: null, hidden: new Set(), latest: {}, anomalies: [], alarms: [], jobs: new Map(), models: [], archive: null, residuals: null, ahead: null, network: null });
  state.stop = new AbortController();
  $("twin").value = twin;
  location.hash = twin;
  temperatures.clear();
  residuals.clear();
  refresh("detail", "models", "jobs", "anomalies", "plots");
  follow(twin, state.stop.signal, hear, (link) => {
    state.link = link;
    drawLink();
    if (link === "live") refresh("plots", "jobs", "models", "anomalies");
  });
}

async function findTwins() {
  const { twins } = await call("v1/twins");
  const names = twins.map((t) => t.id);
  $("empty").hidden = names.length > 0;
  $("main").hidden = $("picker").hidden = names.length === 0;
  if ([...$("twin").options].map((o) => o.value).join() !== names.join()) {
    $("twin").replaceChildren(...names.map((name) => make("option", { value: name }, name)));
    if (state.twin) $("twin").value = state.twin;
  }
  if (!names.length) $("link-text").textContent = "waiting for a twin";
  if (names.length && !names.includes(state.twin)) select(names.includes(location.hash.slice(1)) ? location.hash.slice(1) : names[0]);
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
  renderPlots();
}

const KEYS = [
  ["1–5", "time range: an hour to everything"], ["0", "follow the present again"],
  ["← →", "earlier, later"], ["+ −", "closer, wider"], ["c", "calibrate"], ["d", "diagnose"],
  ["n", "residual or NIS"], ["u", "kelvin or degrees Celsius"], ["t", "light or dark"], ["j / k", "next or previous twin"], ["?", "these keys"],
];

function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, dialog") || !state.detail) return;
  const acts = {
    c: () => $("calibrate").click(), d: () => $("diagnose").click(), t: switchTheme, u: switchUnit, j: () => step(1), k: () => step(-1),
    n: () => { state.kind = state.kind === "nis" ? "residual" : "nis"; drawKinds(); renderPlots(); },
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
$("help").addEventListener("click", () => $("help-dialog").showModal());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (state.detail) renderPlots(); });
addEventListener("keydown", pressed);
drawRanges();
drawKinds();
const look = () => findTwins().catch(() => { $("link").dataset.state = "off"; $("link-text").textContent = "no answer"; });
await look();
setInterval(look, 4000);
setInterval(() => { if (state.twin) refresh("detail"); }, 5000);  // silence sends no message
