// The plan of a what-if: steps of inputs in a small table, and what the service makes of them.
import { clock, make, typed } from "./format.js";

const minute = (unix_s) => clock(Math.round(unix_s / 60) * 60).slice(0, 16);

// The columns that the service takes: one row per instant, an input without a step there has no value.
export function columnsOf(steps) {
  const time = [...new Set(steps.map((s) => s.time_s))].sort((a, b) => a - b);
  const names = [...new Set(steps.map((s) => s.channel))];
  const values = Object.fromEntries(names.map((name) => [name, time.map((t) => steps.findLast((s) => s.channel === name && s.time_s === t)?.value ?? null)]));
  return { time, values };
}

export class PlanEditor {
  // inputs: [{name, unit}]; onShow gets the plan, or null if there is none.
  constructor($, onShow) {
    this.$ = $;
    this.onShow = onShow;
    $("plan-add").addEventListener("click", () => this.add());
    $("plan-clear").addEventListener("click", () => { this.$("plan-rows").replaceChildren(); this.show(); });
    $("plan-show").addEventListener("click", () => this.show());
  }

  open(inputs, now_s) {
    if (this.inputs?.map((i) => i.name).join() !== inputs.map((i) => i.name).join()) this.$("plan-rows").replaceChildren();
    Object.assign(this, { inputs, now_s });
    this.refuse("");
    if (!this.$("plan-rows").children.length) this.add();
    this.$("plan-dialog").showModal();
  }

  add() {
    const options = this.inputs.map((i) => make("option", { value: i.name }, `${i.name}${i.unit ? ` (${i.unit})` : ""}`));
    const row = make("tr", {},
      make("td", {}, make("select", { "aria-label": "Input" }, ...options)),
      make("td", {}, make("input", { class: "instant", value: minute(this.now_s + 600), "aria-label": "From, UTC", autocomplete: "off" })),
      make("td", {}, make("input", { type: "number", step: "any", value: 0, "aria-label": "Value" })),
      make("td", {}, make("button", { type: "button", class: "ghost", "aria-label": "Remove this step", onclick: () => row.remove() }, "×")));
    this.$("plan-rows").append(row);
  }

  steps() {
    return [...this.$("plan-rows").children].map((row) => {
      const [channel, from, value] = row.querySelectorAll("select, input");
      return { channel: channel.value, time_s: typed(from.value), value: Number(value.value) };
    });
  }

  refuse(reason) {
    this.$("plan-refused").textContent = reason;
    this.$("plan-refused").hidden = !reason;
  }

  async show() {
    const steps = this.steps();
    if (steps.some((s) => !Number.isFinite(s.time_s) || !Number.isFinite(s.value))) return this.refuse("Every step needs a time, such as 2026-01-31 12:00, and a value.");
    try {
      await this.onShow(steps.length ? columnsOf(steps) : null);
    } catch (error) {
      return this.refuse(error.message);
    }
    this.$("plan-dialog").close();
  }
}
