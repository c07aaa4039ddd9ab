// The fleet: one page of the twins at a time, sorted, filtered and counted by the service.
import { call } from "./api.js";
import { count, make, number, seconds, span } from "./format.js";

const PAGE = 50, EVERY_MS = 4000, TYPING_MS = 200;
const BAR = 6;  // a residual of so many standard deviations fills its bar
const STANDING = { live: ["", "live"], delayed: ["warn", "from a recording"], partly: ["warn", "partly silent"], stale: ["bad", "silent"], never: ["unknown", "no telemetry yet"] };
const KINDS = [["all", "twins", ""], ["red", "beyond red", "bad"], ["yellow", "beyond yellow", "warn"], ["ahead", "limit ahead", "warn"], ["anomalies", "with anomalies", "warn"], ["stale", "silent", "warn"], ["no_model", "without a model", ""]];
const COLUMNS = [["Twin", "id"], ["Telemetry", "silence"], ["Worst residual", "residual"], ["Limits", "attention"], ["Limit ahead", "ahead"], ["Anomalies", "anomalies"], ["Model", "model_age"]];

export class Fleet {
  constructor(section, onPick) {
    this.onPick = onPick;
    this.asked = { sort: "attention", reverse: false, only: "all", find: "", offset: 0 };
    this.timer = null;
    this.number = 0;
    this.note = section.querySelector("#fleet-note");
    this.kinds = section.querySelector("#fleet-kinds");
    this.table = section.querySelector("#fleet-table");
    this.pager = section.querySelector("#fleet-pager");
    this.find = section.querySelector("#fleet-find");
    let typing = null;
    this.find.addEventListener("input", () => {
      clearTimeout(typing);
      typing = setTimeout(() => this.ask({ find: this.find.value.trim(), offset: 0 }), TYPING_MS);
    });
    this.find.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && this.shown?.twins.length) this.onPick(this.shown.twins[0].id);
    });
    this.section = section;
  }

  show(is_on) {
    this.section.hidden = !is_on;
    clearTimeout(this.timer);
    if (is_on) this.load();
  }

  ask(change) {
    Object.assign(this.asked, change);
    this.load();
  }

  // The answer to an older question that comes late is dropped.
  async load() {
    clearTimeout(this.timer);
    const mine = ++this.number;
    try {
      const page = await call(`v1/fleet?${new URLSearchParams({ ...this.asked, limit: PAGE })}`);
      if (mine === this.number && !this.section.hidden) this.draw(page);
    } catch (error) {
      if (mine === this.number) this.note.textContent = `no answer: ${error.message}`;
    }
    if (mine === this.number && !this.section.hidden) this.timer = setTimeout(() => this.load(), EVERY_MS);
  }

  draw(page) {
    if (!page.twins.length && this.asked.offset > 0) return this.ask({ offset: Math.max(0, PAGE * Math.floor((page.matched - 1) / PAGE)) });
    this.shown = page;
    const focused = document.activeElement?.dataset.key;
    this.drawKinds(page.counts);
    this.drawTable(page.twins);
    this.drawPager(page);
    const { sort } = this.asked;
    this.note.textContent = sort === "attention" ? "twins that need attention come first" : `by ${COLUMNS.find(([, key]) => key === sort)[0].toLowerCase()}`;
    if (focused) this.section.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus({ preventScroll: true });
    return undefined;
  }

  drawKinds(counts) {
    this.kinds.replaceChildren(...KINDS.map(([kind, words, look]) => make("button",
      { class: `kind ${counts[kind] ? look : ""}`, "aria-pressed": String(this.asked.only === kind), "data-key": `kind-${kind}`, disabled: !counts[kind] && kind !== "all" && this.asked.only !== kind, onclick: () => this.ask({ only: kind, offset: 0 }) },
      make("b", {}, count(counts[kind])), make("span", {}, words))));
  }

  drawTable(twins) {
    const { sort, reverse } = this.asked;
    const head = COLUMNS.map(([words, key]) => make("th", { "aria-sort": key === sort ? (reverse ? "ascending" : "descending") : null, scope: "col" },
      make("button", { class: "sort", "data-key": `sort-${key}`, onclick: () => this.ask({ sort: key, reverse: key === sort && !reverse, offset: 0 }) },
        words, make("i", { "aria-hidden": "true" }, key === sort ? (reverse ? "↑" : "↓") : ""))));
    const nobody = make("tr", {}, make("td", { class: "nobody", colspan: COLUMNS.length }, this.asked.find ? `No twin's name holds “${this.asked.find}”.` : "None."));
    this.table.replaceChildren(make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...(twins.length ? twins.map((twin) => this.row(twin)) : [nobody])));
  }

  row(twin) {
    const [look, words] = STANDING[twin.state];
    const state = twin.red ? "bad" : twin.yellow || twin.open_anomalies || twin.ahead ? "warn" : look === "bad" ? "warn" : look;
    const silence = twin.silent_s === null || twin.state === "never" ? "" : `${span(twin.silent_s)} ago`;
    const open = () => this.onPick(twin.id);
    const limits = [[twin.red, "bad", "red"], [twin.yellow, "warn", "yellow"]].filter(([n]) => n);
    return make("tr", { onclick: open },
      make("td", { class: "name" }, make("span", { class: `state ${state}`, role: "img", "aria-label": words }),
        make("button", { class: "open", "data-key": `twin-${twin.id}`, onclick: (event) => { event.stopPropagation(); open(); } }, twin.id),
        twin.family ? make("span", { class: "sub" }, twin.family) : null),
      make("td", {}, make("span", { class: look === "bad" || look === "warn" ? `chip ${look}` : "sub" }, words), silence ? make("span", { class: "sub after" }, silence) : null),
      make("td", {}, make("div", { class: "worst" }, ...this.worst(twin.worst))),
      make("td", {}, ...limits.map(([n, c, name]) => make("span", { class: `chip ${c}` }, `${n} ${name}`))),
      make("td", { class: "ahead" }, ...this.ahead(twin.ahead)),
      make("td", {}, twin.open_anomalies ? make("span", { class: "chip warn" }, count(twin.open_anomalies)) : null),
      make("td", { class: "model" }, twin.active_model === null ? make("span", { class: "sub" }, "no model") : make("b", {}, `v${twin.active_model}`),
        twin.active_model === null ? null : make("span", { class: "sub after" }, span(twin.model_age_s))));
  }

  worst(worst) {
    if (!worst) return [make("span", { class: "sub" }, "–")];
    const share = Math.min(worst.deviations / BAR, 1), look = worst.deviations >= 4 ? "bad" : worst.deviations >= 3 ? "warn" : "good";
    return [
      make("span", { class: "bar", "aria-hidden": "true" }, make("i", { class: look, style: `width:${(100 * share).toFixed(0)}%` })),
      make("span", { class: "sigma" }, `${number(worst.deviations, 1)} σ`),
      make("span", { class: "sub" }, `${worst.sensor} ${worst.residual_K > 0 ? "+" : "−"}${number(Math.abs(worst.residual_K))} K`),
    ];
  }

  ahead(alarm) {
    if (!alarm) return [];
    const in_s = alarm.expected ? seconds(alarm.expected) - Date.now() / 1000 : null;
    const when = in_s === null ? "possible" : in_s > 0 ? `in ${span(in_s)}` : "due";
    return [make("span", { class: `chip ${alarm.colour === "red" ? "bad" : "warn"}`, title: alarm.message }, when), make("span", { class: "sub" }, `${alarm.channel} · ${alarm.colour}`)];
  }

  drawPager({ matched, offset, twins }) {
    const last = offset + twins.length;
    const turn = (words, to, is_off) => make("button", { class: "small", "aria-label": words === "‹" ? "Page before" : "Next page", "data-key": `page-${words}`, disabled: is_off, onclick: () => this.ask({ offset: to }) }, words);
    this.pager.replaceChildren(make("span", { class: "sub" }, matched ? `${count(offset + 1)}–${count(last)} of ${count(matched)}` : "0"),
      turn("‹", Math.max(0, offset - PAGE), offset === 0), turn("›", offset + PAGE, last >= matched));
  }
}
