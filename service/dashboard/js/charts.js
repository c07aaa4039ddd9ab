// The two plots: temperatures with their forecast, residuals with anomalies marked.
import { clock, colour, css, make, number } from "./format.js";

const PAST_SHARE = 0.35;
const MOST_MARKS = 40;

function axes(unit) {
  const grid = { stroke: css("--line"), width: 1 };
  const common = { stroke: css("--muted"), font: "12px system-ui, sans-serif", grid, ticks: { show: false } };
  return [
    { ...common, grid: { show: false }, space: 90, values: (u, splits) => ticks(u, splits) },
    { ...common, size: 58, label: unit, labelSize: 16, labelFont: "12px system-ui, sans-serif", values: (u, v) => v.map((x) => String(+x.toPrecision(6)).replace("-", "−")) },
  ];
}

// Hours and minutes, with the day where it changes.
function ticks(plot, splits) {
  let day = "";
  const length = plot.scales.x.max - plot.scales.x.min;
  return splits.map((t) => {
    const text = clock(t);
    const today = text.slice(5, 10);
    const label = length > 6 * 86400 ? today : length < 300 ? text.slice(11) : text.slice(11, 16);
    const first = today !== day && length <= 6 * 86400;
    day = today;
    return first ? `${label}\n${today}` : label;
  });
}

function tooltip(host, rows) {
  const tip = make("div", { class: "tip", hidden: true });
  return {
    hooks: {
      init: [(u) => u.over.append(tip)],
      setCursor: [(u) => {
        const { left, top, idx } = u.cursor;
        const lines = idx === null || idx === undefined || left < 0 ? [] : rows(u, idx);
        tip.hidden = lines.length === 0;
        if (tip.hidden) return;
        tip.replaceChildren(make("b", {}, clock(u.data[0][idx])), ...lines.map(([color, name, value]) =>
          make("div", {}, make("span", { class: "dot", style: `background:${color}` }), make("span", {}, name), make("span", {}, value))));
        const flip = left > u.over.clientWidth - tip.offsetWidth - 24;
        tip.style.left = `${flip ? left - tip.offsetWidth - 14 : left + 14}px`;
        tip.style.top = `${Math.max(0, Math.min(top - 20, u.over.clientHeight - tip.offsetHeight))}px`;
      }],
    },
  };
}

// A plot that follows the size of its host and reports zooming by the operator.
class Chart {
  constructor(host, onZoom) {
    this.host = host;
    this.onZoom = onZoom;
    this.plot = null;
    new ResizeObserver(() => this.resize()).observe(host);
  }

  resize() {
    if (this.plot) this.plot.setSize({ width: this.host.clientWidth, height: this.host.clientHeight });
  }

  clear(...content) {
    if (this.plot) this.plot.destroy();
    this.plot = null;
    this.shape = null;
    this.host.replaceChildren(make("div", { class: "blank" }, ...content));
  }

  draw(shape, options, data) {
    if (this.plot && this.shape === shape) {
      this.plot.setData(data, false);
      this.plot.batch(() => {
        this.plot.setScale("x", { min: this.range[0], max: this.range[1] });
        this.plot.redraw();
      });
      return;
    }
    if (this.plot) this.plot.destroy();
    this.host.replaceChildren();
    this.shape = shape;
    const width = this.host.clientWidth, height = this.host.clientHeight;
    this.plot = new uPlot({
      width, height, ms: 1e-3, tzDate: (t) => uPlot.tzDate(new Date(t * 1000), "Etc/UTC"),
      legend: { show: false }, padding: [10, 12, 0, 0],
      scales: { x: { time: true, range: () => this.range }, y: { range: (u, low, high) => paddedRange(low, high) } },
      cursor: { drag: { x: true, y: false, setScale: false }, points: { size: 6 }, bind: { dblclick: () => () => { this.onZoom(null); return null; } } },
      ...options,
      hooks: { ...options.hooks, setSelect: [(u) => this.selected(u)] },
    }, data, this.host);
  }

  selected(u) {
    if (u.select.width < 8) return;
    const ends = [u.select.left, u.select.left + u.select.width].map((x) => u.posToVal(x, "x"));
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.onZoom(ends);
  }
}

function paddedRange(low, high) {
  if (low === null || high === null || low === undefined) return [0, 1];
  const room = Math.max((high - low) * 0.08, 0.05);
  return [low - room, high + room];
}

export class TemperatureChart extends Chart {
  // view: {range, sensors: [{name, index, shown}], measured: {time, values}, forecast: {time, mean, low, high} | null, unit,
  //        predicted: {time, values} | null, planned: {time, mean} | null, limits: [{index, colour, bound}], marks: [{time, text}]}
  update(view) {
    this.range = view.range;
    this.view = view;
    const { data, series, bands } = this.columns(view);
    const shape = JSON.stringify([view.sensors, view.unit, css("--line"), view.forecast !== null, view.predicted !== null, view.planned !== null]);
    this.draw(shape, {
      series, bands, axes: axes(view.unit), plugins: [tooltip(this.host, (u, i) => this.rows(i))],
      hooks: { draw: [(u) => this.drawLimits(u), (u) => this.drawMarks(u), (u) => this.drawPresent(u)] },
    }, data);
  }

  columns(view) {
    const past = view.measured.time, future = view.forecast ? view.forecast.time : [];
    const join = past.length && future.length ? [past[past.length - 1]] : [];
    const time = [...past, ...future.map((t) => t)];
    const series = [{}], bands = [], data = [time];
    const before = (n) => new Array(n).fill(null);
    for (const sensor of view.sensors) {
      const stroke = colour(sensor.index), show = sensor.shown, points = { show: false };
      data.push([...view.measured.values[sensor.name], ...before(future.length)]);
      series.push({ label: sensor.name, stroke, width: 1.6, show, points, spanGaps: true });
      if (!view.forecast) continue;
      const lead = past.length ? before(past.length - 1) : [];
      const last = join.length ? [lastOf(view.measured.values[sensor.name])] : [];
      for (const [kind, style] of [["mean", { width: 1.6, dash: [5, 4] }], ["high", { width: 0 }], ["low", { width: 0 }]]) {
        data.push([...lead, ...last, ...view.forecast[kind][sensor.name]]);
        series.push({ label: `${sensor.name} ${kind}`, stroke, show, points, spanGaps: true, ...style });
      }
      const top = series.length - 2;
      bands.push({ series: [top, top + 1], fill: `${stroke}2b` });
    }
    return this.joined(view, data, series, bands);
  }

  // Adds what the model predicted, and what a plan leads to, which have times of their own.
  joined(view, data, series, bands) {
    const tables = [data], points = { show: false };
    for (const [extra, style] of [[view.predicted, { width: 1.2, dash: [1.5, 3] }], [view.planned, { width: 2.4 }]]) {
      if (!extra) continue;
      tables.push([extra.time, ...view.sensors.map((s) => extra.values[s.name])]);
      for (const s of view.sensors) series.push({ label: `${s.name} again`, stroke: colour(s.index), show: s.shown, points, spanGaps: true, ...style });
    }
    return { data: tables.length > 1 ? uPlot.join(tables, tables.map((t) => t.slice(1).map(() => 1))) : data, series, bands };
  }

  rows(at) {
    const { view } = this, n = view.measured.time.length;
    const time = this.plot.data[0][at], all = [...view.measured.time, ...(view.forecast ? view.forecast.time : [])];
    const i = all.indexOf(time);
    if (i < 0) return [];
    const known = i < n;
    return view.sensors.filter((s) => s.shown).map((s) => {
      const source = known ? view.measured.values[s.name][i] : view.forecast.mean[s.name][i - n];
      if (source === null) return null;
      const band = known ? "" : ` ± ${number((view.forecast.high[s.name][i - n] - view.forecast.low[s.name][i - n]) / 2)}`;
      return [colour(s.index), s.name, `${number(source)}${band} ${view.unit}`];
    }).filter(Boolean);
  }

  // Limits of the sensors shown, where the plot reaches them.
  drawLimits(u) {
    const { ctx, bbox } = u, dot = devicePixelRatio;
    ctx.save();
    ctx.font = `${10.5 * dot}px system-ui, sans-serif`;
    for (const { index, colour: look, bound, name } of this.view.limits) {
      const sensor = this.view.sensors.find((s) => s.name === name), y = u.valToPos(bound, "y", true);
      if (!sensor || !sensor.shown || y < bbox.top || y > bbox.top + bbox.height) continue;
      ctx.strokeStyle = look === "red" ? css("--bad") : css("--warn");
      ctx.globalAlpha = 0.75;
      ctx.lineWidth = dot;
      ctx.setLineDash(look === "red" ? [] : [7 * dot, 4 * dot]);
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
      ctx.globalAlpha = 1;
      ctx.fillStyle = colour(index);
      haloed(ctx, `${name} ${look}`, bbox.left + 4 * dot, y - 3 * dot);
    }
    ctx.restore();
  }

  // What happened: a mode or a heater that changed, a model that was activated.
  drawMarks(u) {
    const { ctx, bbox } = u, dot = devicePixelRatio;
    const seen = this.view.marks.filter((m) => m.time >= this.range[0] && m.time <= this.range[1]).slice(-MOST_MARKS);
    ctx.save();
    ctx.font = `${10 * dot}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    let free = -Infinity;
    for (const { time, text } of seen) {
      const x = u.valToPos(time, "x", true);
      ctx.strokeStyle = css("--accent");
      ctx.globalAlpha = 0.4;
      ctx.lineWidth = dot;
      ctx.setLineDash([2 * dot, 4 * dot]);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top + bbox.height * (text.startsWith("model") ? 0 : 0.85));
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      ctx.globalAlpha = 1;
      ctx.fillStyle = css("--accent");
      ctx.beginPath();
      ctx.moveTo(x - 4 * dot, bbox.top + bbox.height);
      ctx.lineTo(x + 4 * dot, bbox.top + bbox.height);
      ctx.lineTo(x, bbox.top + bbox.height - 7 * dot);
      ctx.fill();
      const at = besideLine(ctx, bbox, text, x, 5 * dot);
      if (at < free) continue;
      ctx.fillText(text, at, bbox.top + bbox.height - 5 * dot);
      free = Math.max(x, at + ctx.measureText(text).width) + 12 * dot;
    }
    ctx.restore();
  }

  drawPresent(u) {
    const now = this.view.now;
    if (now === null || !this.view.forecast) return;
    const x = u.valToPos(now, "x", true), { ctx, bbox } = u;
    if (x < bbox.left || x > bbox.left + bbox.width) return;
    ctx.save();
    ctx.strokeStyle = css("--line-strong");
    ctx.setLineDash([3, 3]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.fillStyle = css("--muted");
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    const text = "forecast →", room = 6 * devicePixelRatio;
    haloed(ctx, text, besideLine(ctx, bbox, text, x, room), bbox.top + 2 * room);
    ctx.restore();
  }
}

// Where a line's text begins: right of it, or left where it would be cut off.
function besideLine(ctx, bbox, text, x, gap) {
  const width = ctx.measureText(text).width;
  return x + gap + width <= bbox.left + bbox.width ? x + gap : x - gap - width;
}

// Text that stays readable over lines.
function haloed(ctx, text, x, y) {
  ctx.save();
  ctx.textAlign = "left";
  ctx.setLineDash([]);
  ctx.lineJoin = "round";
  ctx.lineWidth = 3 * devicePixelRatio;
  ctx.strokeStyle = css("--surface");
  ctx.strokeText(text, x, y);
  ctx.fillText(text, x, y);
  ctx.restore();
}

const lastOf = (column) => {
  for (let i = column.length - 1; i >= 0; i--) if (column[i] !== null) return column[i];
  return null;
};

// Inputs below the temperatures: held values as steps, each unit with a scale of its own.
export class InputChart extends Chart {
  // view: {range, inputs: [{name, index, shown, unit, held}], time, values, planned: {time, values} | null, now}
  update(view) {
    this.range = view.range;
    this.view = view;
    const uses = (unit) => view.inputs.filter((s) => s.unit === unit).length;
    const units = [...new Set(view.inputs.map((s) => s.unit))].sort((a, b) => uses(b) - uses(a));
    const steps = uPlot.paths.stepped({ align: 1 }), scales = {};
    const tables = [[view.time, ...view.inputs.map((s) => view.values[s.name])]];
    const series = [{}, ...view.inputs.map((s) => this.series(s, steps, { width: 1.4 }))];
    if (view.planned) {
      tables.push([view.planned.time, ...view.inputs.map((s) => view.planned.values[s.name])]);
      series.push(...view.inputs.map((s) => this.series(s, steps, { width: 2.2, dash: [4, 3] })));
    }
    units.forEach((unit) => { scales[`in ${unit}`] = { range: (u, low, high) => paddedRange(low, high) }; });
    const [time, value] = axes(units[0]);
    const side = { ...value, label: units[0], scale: `in ${units[0]}` };  // one axis only: the times of both plots stay in line
    this.draw(JSON.stringify([view.inputs, css("--line"), view.planned !== null]), {
      series, axes: [time, side], plugins: [tooltip(this.host, (u, i) => this.rows(u, i))],
      scales: { x: { time: true, range: () => this.range }, ...scales },
      hooks: { draw: [(u) => this.drawEnds(u, units.slice(1))] },
    }, tables.length > 1 ? uPlot.join(tables, tables.map((t) => t.slice(1).map(() => 1))) : tables[0]);
  }

  // Of the units that have no axis, the ends of what is shown, at the right margin.
  drawEnds(u, units) {
    const { ctx, bbox } = u, dot = devicePixelRatio;
    ctx.save();
    ctx.font = `${10.5 * dot}px system-ui, sans-serif`;
    let right = bbox.left + bbox.width - 4 * dot;
    for (const unit of units) {
      const shown = u.series.map((s, i) => (i && s.show && s.scale === `in ${unit}` ? i : 0)).filter(Boolean);
      const [first, last] = u.series[0].idxs || [0, u.data[0].length - 1];
      const seen = shown.flatMap((i) => u.data[i].slice(first, last + 1)).filter((x) => x !== null && x !== undefined);
      if (!seen.length) continue;
      const ends = [...new Set([seen.reduce((a, b) => Math.max(a, b)), seen.reduce((a, b) => Math.min(a, b))])];
      const texts = ends.map((x) => `${String(+x.toPrecision(3)).replace("-", "−")} ${unit || ""}`.trim());
      const width = Math.max(...texts.map((text) => ctx.measureText(text).width));
      ctx.fillStyle = u.series[shown[0]].stroke(u, shown[0]);
      ends.forEach((x, i) => haloed(ctx, texts[i], right - width, u.valToPos(x, `in ${unit}`, true) + (i ? -3 : 4) * dot));
      right -= width + 10 * dot;
    }
    ctx.restore();
  }

  series(s, steps, style) {
    return { label: s.name, scale: `in ${s.unit}`, stroke: colour(s.index), show: s.shown, points: { show: false }, spanGaps: true, ...(s.held ? { paths: steps } : {}), ...style };
  }

  rows(u, at) {
    return this.view.inputs.filter((s) => s.shown).map((s, i) => {
      const column = u.data[this.view.inputs.indexOf(s) + 1];
      let value = null;
      for (let k = at; k >= 0 && value === null; k--) value = column[k] ?? null;
      return value === null ? null : [colour(s.index), s.name, `${number(value)} ${s.unit}`];
    }).filter(Boolean);
  }
}

export class ResidualChart extends Chart {
  // view: {range, kind: "residual" | "nis", sensors, time, values, nis, anomalies: [{sensor, start, stop}]}
  update(view) {
    this.range = view.range;
    this.view = view;
    const nis = view.kind === "nis";
    const shown = nis ? [] : view.sensors;
    const data = [view.time, ...(nis ? [view.nis] : shown.map((s) => view.values[s.name]))];
    const points = { show: false };
    const series = [{}, ...(nis
      ? [{ label: "NIS", stroke: css("--accent"), width: 1.3, points }]
      : shown.map((s) => ({ label: s.name, stroke: `${colour(s.index)}cc`, width: 1, show: s.shown, points, spanGaps: true })))];
    this.draw(JSON.stringify([view.kind, view.sensors, css("--line")]), {
      series, axes: axes(nis ? "NIS" : "K"), plugins: [tooltip(this.host, (u, i) => this.rows(i))],
      hooks: { drawAxes: [(u) => this.drawAnomalies(u)], draw: [(u) => this.drawLevel(u)] },
    }, data);
  }

  rows(i) {
    const { view } = this;
    if (view.kind === "nis") return [[css("--accent"), "NIS", number(view.nis[i])]];
    return view.sensors.filter((s) => s.shown && view.values[s.name][i] !== null)
      .map((s) => [colour(s.index), s.name, `${number(view.values[s.name][i], 3)} K`]);
  }

  drawAnomalies(u) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    const lane = 4 * devicePixelRatio;
    for (const anomaly of this.view.anomalies) {
      const sensor = this.view.sensors.find((s) => s.name === anomaly.sensor);
      if (!sensor || !sensor.shown) continue;
      const left = u.valToPos(anomaly.start, "x", true);
      const last = this.view.time[this.view.time.length - 1];
      const right = u.valToPos(anomaly.stop === null ? last : anomaly.stop, "x", true);
      const width = Math.max(right - left, 2);
      ctx.fillStyle = colour(sensor.index);
      ctx.globalAlpha = 0.1;
      ctx.fillRect(left, bbox.top, width, bbox.height);
      ctx.globalAlpha = 0.9;
      ctx.fillRect(left, bbox.top + (sensor.index % 8) * (lane + 2), width, lane);
    }
    ctx.restore();
  }

  // Where residuals would be if the model were perfect: zero, or one per sensor for the NIS.
  drawLevel(u) {
    const level = this.view.kind === "nis" ? this.view.sensors.length : 0;
    const y = u.valToPos(level, "y", true), { ctx, bbox } = u;
    if (y < bbox.top || y > bbox.top + bbox.height) return;
    ctx.save();
    ctx.strokeStyle = css("--faint");
    ctx.setLineDash([4, 4]);
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    ctx.restore();
  }
}

export const forecastLength = (length_s) => Math.min(Math.max(length_s * PAST_SHARE, 300), 3 * 86400);
