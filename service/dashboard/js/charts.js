// The two plots: temperatures with their forecast, residuals with anomalies marked.
import { clock, colour, css, make, number } from "./format.js";

const PAST_SHARE = 0.35;

function axes(unit) {
  const grid = { stroke: css("--line"), width: 1 };
  const common = { stroke: css("--muted"), font: "12px system-ui, sans-serif", grid, ticks: { show: false } };
  return [
    { ...common, grid: { show: false }, space: 90, values: (u, splits) => ticks(u, splits) },
    { ...common, size: 58, label: unit, labelSize: 16, labelFont: "12px system-ui, sans-serif", values: (u, v) => v.map((x) => +x.toPrecision(6)) },
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
  // view: {range, sensors: [{name, index, shown}], measured: {time, values}, forecast: {time, mean, low, high} | null, unit}
  update(view) {
    this.range = view.range;
    this.view = view;
    const { data, series, bands } = this.columns(view);
    const shape = JSON.stringify([view.sensors, view.unit, css("--line"), view.forecast !== null]);
    this.draw(shape, {
      series, bands, axes: axes(view.unit), plugins: [tooltip(this.host, (u, i) => this.rows(i))],
      hooks: { draw: [(u) => this.drawPresent(u)] },
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
        series.push({ label: `${sensor.name} ${kind}`, stroke, show, points, ...style });
      }
      const top = series.length - 2;
      bands.push({ series: [top, top + 1], fill: `${stroke}2b` });
    }
    return { data, series, bands };
  }

  rows(i) {
    const { view } = this, n = view.measured.time.length;
    const known = i < n;
    return view.sensors.filter((s) => s.shown).map((s) => {
      const source = known ? view.measured.values[s.name][i] : view.forecast.mean[s.name][i - n];
      if (source === null) return null;
      const band = known ? "" : ` ± ${number((view.forecast.high[s.name][i - n] - view.forecast.low[s.name][i - n]) / 2)}`;
      return [colour(s.index), s.name, `${number(source)}${band} ${view.unit}`];
    }).filter(Boolean);
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
    ctx.fillText("forecast →", x + 6 * devicePixelRatio, bbox.top + 12 * devicePixelRatio);
    ctx.restore();
  }
}

const lastOf = (column) => {
  for (let i = column.length - 1; i >= 0; i--) if (column[i] !== null) return column[i];
  return null;
};

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
