// The panels beside the plots: readings, anomalies, jobs, model versions.
import { clock, colour, count, effectWords, make, number, seconds, span, toUnit, unitName } from "./format.js";

const quiet = (text) => make("li", { class: "quiet" }, text);

// Which limit of its channel a value lies beyond, in a colour and in words; null if none.
const beyondLimit = (value, limits) => {
  for (const [look, style] of [["red", "bad"], ["yellow", "warn"]]) {
    const [low, high] = (limits || {})[look] || [null, null];
    if (high !== null && value > high) return { style, words: `above its ${look} limit of ${high}` };
    if (low !== null && value < low) return { style, words: `below its ${look} limit of ${low}` };
  }
  return null;
};

export function drawNow(table, { sensors, units, limits, latest, ahead, unit, anomalies, alarms, doubt, telemetry }) {
  const open = new Set(anomalies.filter((a) => a.stop === null).map((a) => a.sensor));
  const judged = (value, name) => {
    const over = beyondLimit(value, limits[name]), text = number(toUnit(value, units[name], unit), 2);
    return over ? make("span", { class: `over ${over.style}`, title: `${over.words} ${unitName(units[name])}` }, text) : text;
  };
  const SIGNS = { stuck: "frozen", quantised: "repeats itself", dropout: "does not report" };
  const silent = ({ state, age_s, signs }) => (state === "stale" ? `silent${age_s === null ? "" : ` for ${span(age_s)}`}` : signs.map((kind) => SIGNS[kind]).join(", "));
  const beyond = (name) => alarms.find((a) => a.channel === name && a.on === "measured" && a.stop === null && !a.shelved_until);
  const limited = ({ colour, side }) => [`state ${colour === "red" ? "bad" : "warn"}`, `${side === "high" ? "above" : "below"} its ${colour} limit`];
  const look = (name) => (beyond(name) ? limited(beyond(name)) : silent(telemetry[name]) ? ["state warn", silent(telemetry[name])] : open.has(name) ? ["state bad", "anomaly"] : doubt(name) ? ["state unknown", doubt(name)] : ["state", "as expected"]);
  const light = ([looks, words]) => make("span", { class: looks, role: "img", "aria-label": words, title: words });
  const head = make("tr", {}, ...["Sensor", "Now", "Expected", "Range until then", ""].map((text, i) => make("th", { class: i && i < 4 ? "num" : "" }, text)));
  const rows = sensors.map((sensor) => {
    const { name } = sensor, next = ahead ? ahead[name] : null;
    return make("tr", {},
      make("td", {}, make("span", { class: "dot", style: `background:${colour(sensor.index)};margin-right:8px` }), name, silent(telemetry[name]) ? make("div", { class: "sub" }, silent(telemetry[name])) : ""),
      make("td", { class: "num big" }, latest[name] === undefined ? "–" : judged(latest[name], name)),
      make("td", { class: "num" }, next ? judged(next.mean.at(-1), name) : "–"),
      make("td", { class: "num sub" }, ...(next ? [judged(Math.min(...next.q05), name), " … ", judged(Math.max(...next.q95), name)] : [])),
      make("td", {}, light(look(name))));
  });
  table.replaceChildren(make("thead", {}, head), make("tbody", {}, ...rows));
  return unitName(unit);
}

const KINDS = {
  residual: "departs from its model", stuck: "is stuck", quantised: "reads in coarser steps", dropout: "does not report",
  joint: "together depart from the model", family: "is unlike its family",
};

// What no anomaly means, by how the twin stands.
const QUIET = {
  "": "Every sensor behaves as its model says.",
  "no model is active": "No model is active yet to compare the sensors with.",
};
const words = (standing) => QUIET[standing] || `None so far: ${standing} samples.`;

export function drawAnomalies(list, anomalies, sensors, standing, onPick) {
  if (!anomalies.length) return list.replaceChildren(quiet(words(standing)));
  list.replaceChildren(...anomalies.slice(0, 60).map((anomaly) => {
    const index = sensors.findIndex((s) => s.name === anomaly.sensor);
    const open = anomaly.stop === null, start = seconds(anomaly.start);
    const cause = anomaly.cause ? effectWords(anomaly.cause) : open ? "cause unknown yet" : `seen by model v${anomaly.model_version}`;
    const length = open ? "lasts" : `for ${span(Math.max(1, seconds(anomaly.stop) - start))}`;
    const name = anomaly.sensor === "*" ? "all sensors" : anomaly.sensor;
    return make("li", {}, make("button", { class: "item", onclick: () => onPick(anomaly), "aria-label": `Show anomaly of ${name}` },
      make("div", { class: "row" },
        make("span", { class: "dot", style: `background:${colour(Math.max(index, 0))}` }), make("b", {}, name),
        make("span", { class: `chip ${open ? "bad" : ""}` }, `${number(anomaly.score, 1)} σ`)),
      make("div", { class: "message" }, `${KINDS[anomaly.kind] || anomaly.kind} · ${clock(start)} · ${length} · ${cause}`)));
  }));
}

const MOST_OVER = 4;

// Alarms that last, with what an operator can say to them, and the last ones that are over.
export function drawAlarms(list, alarms, { onAcknowledge, onShelve }) {
  const lasting = alarms.filter((alarm) => alarm.stop === null);
  const over = alarms.filter((alarm) => alarm.stop !== null && alarm.on === "measured").slice(0, MOST_OVER);
  list.hidden = !lasting.length && !over.length;
  list.replaceChildren(...lasting.map((alarm) => {
    const quietly = alarm.shelved_until !== null;
    return make("li", { class: `alarm ${quietly ? "quietly" : ""}` },
      make("div", { class: "row" }, make("span", { class: `chip ${alarm.colour === "red" ? "bad" : "warn"}` }, `${alarm.colour}${alarm.on === "forecast" ? ", forecast" : ""}`),
        alarm.acknowledged ? make("span", { class: "sub", title: alarm.acknowledged.note || "" }, "acknowledged") : make("button", { class: "small", onclick: () => onAcknowledge(alarm) }, "Acknowledge"),
        make("button", { class: "small", onclick: () => onShelve(alarm), title: quietly ? `until ${alarm.shelved_until}` : "hear nothing of this limit for an hour" }, quietly ? "Unshelve" : "Shelve 1 h")),
      make("div", { class: "message" }, `${alarm.message} · since ${clock(seconds(alarm.start))}`));
  }), ...over.map((alarm) => {
    const [start, stop] = [clock(seconds(alarm.start)), clock(seconds(alarm.stop))];
    return make("li", { class: "past" }, make("div", { class: "message" }, `${alarm.message} · ${start} to ${stop.slice(0, 10) === start.slice(0, 10) ? stop.slice(11) : stop}`));
  }));
}

const LOOK = { queued: "", running: "accent", succeeded: "good", failed: "bad", cancelled: "warn" };

export function drawJobs(list, jobs, { onCancel, onReport }) {
  if (!jobs.length) return list.replaceChildren(quiet("Calibrate to fit the model to the archive. Diagnose to find what it lacks."));
  list.replaceChildren(...jobs.slice(0, 12).map((job) => {
    const busy = job.state === "queued" || job.state === "running";
    const button = busy
      ? make("button", { class: "small", onclick: () => onCancel(job) }, "Cancel")
      : job.kind === "diagnosis" && job.state === "succeeded"
        ? make("button", { class: "small", onclick: () => onReport(job) }, "Report") : make("span", { class: "sub" }, clock(seconds(job.created), false));
    return make("li", {},
      make("div", { class: "row" }, make("b", {}, job.kind), make("span", { class: `chip ${LOOK[job.state]}` }, job.state), button),
      busy ? make("progress", { max: 1, value: job.progress, "aria-label": `${job.kind} ${Math.round(job.progress * 100)} %` }) : null,
      make("div", { class: "message" }, jobWords(job)));
  }));
}

function jobWords(job) {
  const { result } = job;
  if (job.state !== "succeeded" || !result || job.kind === "calibration") return job.message;
  const names = (result.findings || []).map(effectWords).join(", ");
  const verdict = { effect_added: names || "an effect was found", no_effect_supported: "nothing is missing that the data support", unexplained: "something is missing that has no name" };
  return `${verdict[result.verdict] || result.verdict}${result.model_version ? `; version ${result.model_version}` : ""}`;
}

export function drawModels(table, models, onActivate) {
  const titles = ["Version", "", "Made by", "Created", "Trained on", "Error", "Effects beyond the declaration", ""];
  const head = make("tr", {}, ...titles.map((text) => make("th", {}, text)));
  const rows = [...models].reverse().map((model) => make("tr", {},
    make("td", {}, make("b", {}, `v${model.version}`)),
    make("td", {}, model.active ? make("span", { class: "chip good" }, "active") : null),
    make("td", {}, make("span", { class: `chip ${model.source === "diagnosis" ? "accent" : ""}` }, model.source)),
    make("td", { class: "sub" }, clock(seconds(model.created))),
    make("td", { class: "sub" }, model.train.samples ? `${count(model.train.samples)} samples` : "–"),
    make("td", {}, errorCell(model)),
    make("td", { class: "grow" }, ...(model.effects.length ? model.effects.map((e) => make("span", { class: "chip accent" }, effectWords(e))) : [make("span", { class: "sub" }, "none")])),
    make("td", {}, model.active ? null : make("button", { class: "small", onclick: () => onActivate(model) }, "Activate"))));
  table.replaceChildren(make("thead", {}, head), make("tbody", {}, ...rows));
}

// One measure for all versions: the same recent samples, open loop. What its maker measured is told beside it.
function errorCell({ error, validation }) {
  const made = Number.isFinite(validation.rmse_K) ? `${number(validation.rmse_K, 3)} K ${validation.on ? `on ${validation.on}` : "when it was made"}` : "no error was found when it was made";
  if (!error) return make("span", { class: "sub", title: made }, "–");
  return make("b", { title: `over the newest ${count(error.samples)} samples, open loop; ${made}` }, `${number(error.rmse_K, 3)} K`);
}

// What speaks for or against a switch: the version that would be active beside the one that is.
export function drawComparison(table, active, wanted) {
  const row = (label, pick) => make("tr", {}, make("th", {}, label), make("td", {}, active ? pick(active) : "–"), make("td", {}, pick(wanted)));
  const error = (m) => (m.error ? `${number(m.error.rmse_K, 3)} K over the newest ${count(m.error.samples)} samples` : "not known");
  table.replaceChildren(
    make("thead", {}, make("tr", {}, make("th", {}), make("th", {}, active ? `active: v${active.version}` : "active: none"), make("th", {}, `v${wanted.version}`))),
    make("tbody", {},
      row("Error, open loop", error), row("Made by", (m) => m.source), row("Created", (m) => clock(seconds(m.created))),
      row("Trained on", (m) => (m.train.samples ? `${count(m.train.samples)} samples until ${String(m.train.stop).slice(0, 16).replace("T", " ")}` : "–")),
      row("Effects", (m) => m.effects.map(effectWords).join(", ") || "none")));
  const worse = active && active.error && wanted.error && wanted.error.rmse_K > active.error.rmse_K;
  return worse ? `Version ${wanted.version} is ${number((wanted.error.rmse_K / active.error.rmse_K - 1) * 100, 0)} % worse than the active one` : "";
}
