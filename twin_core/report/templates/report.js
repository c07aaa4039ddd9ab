// Draws the charts of the report. The data stands in the element #data; colours come from the style sheet.
(() => {
  "use strict";

  const data = JSON.parse(document.getElementById("data").textContent);
  const charts = [];
  const PRINTED = 312; // CSS pixels of one of two columns on A4: the layout of the page is not known before it is printed
  let printing = false;

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
  const written = (value, digits) => (isNumber(value) ? value.toFixed(digits) : "–");

  // Times: unix seconds where the telemetry is dated, else seconds shown in the unit that fits their span.
  const span = data.time.length ? data.time[data.time.length - 1] - data.time[0] : 0;
  const unit = span > 3 * 86400 ? ["d", 86400] : span > 2 * 3600 ? ["h", 3600] : span > 600 ? ["min", 60] : ["s", 1];
  const scaled = (times) => (data.dated ? times : times.map((t) => t / unit[1]));
  const when = (time) => {
    if (!data.dated) return `${written(time, 2)} ${unit[0]}`;
    return new Date(time * 1000).toISOString().slice(0, 16).replace("T", " ");
  };

  const axis = (label) => ({
    stroke: colour("quiet"),
    font: "12px system-ui, sans-serif",
    grid: { stroke: colour("line"), width: 1 },
    ticks: { show: false },
    ...label,
  });
  const valueAxis = (suffix) =>
    axis({ size: 58, values: (_, splits) => splits.map((value) => (value === null ? "" : `${+value.toFixed(6)} ${suffix}`)) });
  const dates = [
    [365 * 86400, "{YYYY}", null, null, null, null, null, null, 1],
    [28 * 86400, "{YYYY}-{MM}", null, null, null, null, null, null, 1],
    [86400, "{MM}-{DD}", "\n{YYYY}", null, null, null, null, null, 1],
    [60, "{HH}:{mm}", "\n{YYYY}-{MM}-{DD}", null, "\n{MM}-{DD}", null, null, null, 1],
    [1, "{HH}:{mm}:{ss}", "\n{YYYY}-{MM}-{DD}", null, "\n{MM}-{DD}", null, null, null, 1],
  ];
  const timeAxis = () => (data.dated ? axis({ size: 42, values: dates }) : axis({ size: 30, values: (_, s) => s.map((v) => `${+v.toFixed(3)} ${unit[0]}`) }));
  const line = (label, name, width, more) => ({ label, stroke: colour(name), width, points: { show: false }, ...more });

  // One card with a title, a read-out that follows the cursor, and a plot as wide as the card.
  function card(parent, title, build) {
    const box = document.createElement("article");
    box.className = "chart";
    const head = document.createElement("header");
    const name = document.createElement("b");
    const readout = document.createElement("span");
    name.textContent = title;
    head.append(name, readout);
    box.append(head);
    parent.append(box);
    const chart = { box, readout, build, plot: null };
    chart.draw = () => {
      if (chart.plot) chart.plot.destroy();
      const width = printing ? PRINTED : Math.max(240, box.clientWidth - 24);
      const { options, columns, read } = build(width);
      const follow = (plot) => (readout.textContent = plot.cursor.idx === null || plot.cursor.idx === undefined ? "" : read(plot.cursor.idx));
      options.hooks = { ...(options.hooks || {}), setCursor: [follow] };
      chart.plot = new uPlot({ width, height: 210, legend: { show: false }, padding: [10, 20, 0, 0], ...options }, columns, box);
    };
    charts.push(chart);
  }

  // Shades everything from the start of the hold-out on.
  const shadeHoldout = (start) => (plot) => {
    const left = Math.max(plot.valToPos(start, "x", true), plot.bbox.left);
    const right = plot.bbox.left + plot.bbox.width;
    if (!(right > left)) return;
    plot.ctx.fillStyle = colour("shade");
    plot.ctx.fillRect(left, plot.bbox.top, right - left, plot.bbox.height);
  };

  const timeScale = { x: { time: data.dated } };
  const inUtc = (stamp) => uPlot.tzDate(new Date(stamp * 1000), "Etc/UTC");

  function drawSensor(parent, name, sensor) {
    card(parent, name, () => {
      const { measured, before, after } = sensor;
      const start = isNumber(data.holdout_start) ? scaled([data.holdout_start])[0] : null;
      return {
        columns: [scaled(data.time), measured, before, after],
        read: (i) => `${when(scaled(data.time)[i])}   ${written(measured[i], 2)} · ${written(before[i], 2)} → ${written(after[i], 2)} K`,
        options: {
          scales: timeScale,
          tzDate: inUtc,
          cursor: { sync: { key: "time" }, y: false },
          axes: [timeAxis(), valueAxis("K")],
          series: [{}, line("measured", "measured", 2.5), line("before", "before", 1.6), line("after", "after", 1.6)],
          hooks: isNumber(start) ? { drawClear: [shadeHoldout(start)] } : {},
        },
      };
    });
  }

  const plusMinus = (mean, spread, sign) => mean.map((m, i) => (isNumber(m) && isNumber(spread[i]) ? m + sign * 2 * spread[i] : null));
  const band = () => [{ series: [2, 1], fill: `color-mix(in srgb, ${colour("heat")} 16%, transparent)` }];
  const edge = () => line("", "heat", 0);

  function drawHeatOverTime(parent, item) {
    const times = scaled(item.time);
    const effect = item.effect_W || times.map(() => null);
    card(parent, `${item.node}: over time`, () => ({
      columns: [times, plusMinus(item.mean_W, item.std_W, -1), plusMinus(item.mean_W, item.std_W, 1), item.mean_W, effect],
      read: (i) => `${when(times[i])}   ${written(item.mean_W[i], 1)} ± ${written(2 * item.std_W[i], 1)} W`,
      options: {
        scales: timeScale,
        tzDate: inUtc,
        cursor: { y: false },
        axes: [timeAxis(), valueAxis("W")],
        series: [{}, edge(), edge(), line("heat", "heat", 1.8), line("effect", "after", 1.8, { dash: [7, 5] })],
        bands: band(),
      },
    }));
  }

  // The cloud of single instants lies under the bins, on the same axes.
  const cloud = (points) => (plot) => {
    const [xs, ys] = points;
    const size = 2 * devicePixelRatio;
    plot.ctx.save();
    plot.ctx.beginPath();
    plot.ctx.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
    plot.ctx.clip();
    plot.ctx.fillStyle = `color-mix(in srgb, ${colour("heat")} 35%, transparent)`;
    for (let i = 0; i < xs.length; i += 1) {
      plot.ctx.fillRect(plot.valToPos(xs[i], "x", true) - size / 2, plot.valToPos(ys[i], "y", true) - size / 2, size, size);
    }
    plot.ctx.restore();
  };

  function drawHeatOver(parent, title, unit, over) {
    const [centre, mean, spread, effect] = over.bins;
    if (centre.length < 2) return;
    card(parent, title, () => ({
      columns: [centre, plusMinus(mean, spread, -1), plusMinus(mean, spread, 1), mean, effect],
      read: (i) => `${written(centre[i], 1)} ${unit}   ${written(mean[i], 1)} ± ${written(2 * spread[i], 1)} W`,
      options: {
        scales: { x: { time: false } },
        cursor: { y: false },
        axes: [axis({ size: 30, values: (_, splits) => splits.map((value) => `${+value.toFixed(3)} ${unit}`) }), valueAxis("W")],
        series: [{}, edge(), edge(), line("heat", "heat", 2), line("effect", "after", 2, { dash: [7, 5] })],
        bands: band(),
        hooks: { drawAxes: [cloud(over.points)] },
      },
    }));
  }

  const redraw = () => charts.forEach((chart) => chart.draw());

  function build() {
    const temperatures = document.getElementById("temperatures");
    if (temperatures) Object.entries(data.sensors).forEach(([name, sensor]) => drawSensor(temperatures, name, sensor));
    const heat = document.getElementById("heat");
    if (heat) {
      data.missing_heat.forEach((item) => {
        if (item.by_temperature) drawHeatOver(heat, `${item.node}: over its temperature`, "K", item.by_temperature);
        drawHeatOverTime(heat, item);
      });
    }
    const driven = document.getElementById("driven");
    if (driven) data.driven_heat.forEach((item) => drawHeatOver(driven, `into ${item.node}, over ${item.axis}`, item.unit, item.over));
    redraw();
  }

  let pending = 0;
  const soon = () => {
    cancelAnimationFrame(pending);
    pending = requestAnimationFrame(redraw);
  };
  let width = innerWidth;
  addEventListener("resize", () => {
    if (innerWidth !== width) soon();
    width = innerWidth;
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", soon);
  const print = (on) => () => {
    printing = on;
    document.documentElement.classList.toggle("printing", on);
    redraw();
  };
  addEventListener("beforeprint", print(true));
  addEventListener("afterprint", print(false));
  build();
})();
