// The thermal network as a drawing: places found once, colours and flows brought up to date.
import { effectWords, heat, number, toUnit, unitName, watts } from "./format.js";

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = 58, APART = 125;
let WIDTH = 900, HEIGHT = 430;

const draw = (tag, attributes, text) => {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== undefined) element.textContent = text;
  return element;
};

// Stress majorisation (Gansner, Koren, North 2004): drawn distances follow the links between two places. Radiators are
// drawn longer, so that the sink which all of them share comes to lie beside the conductors and not on top of them.
const LENGTH = { radiator: 1.6 };

function layout(names, links) {
  const n = names.length, index = new Map(names.map((name, i) => [name, i]));
  const far = Array.from({ length: n }, (_, i) => Array.from({ length: n }, (_, j) => (i === j ? 0 : Infinity)));
  for (const { ends: [a, b], kind } of links) {
    const i = index.get(a), j = index.get(b);
    if (i !== undefined && j !== undefined && i !== j) far[i][j] = far[j][i] = Math.min(far[i][j], LENGTH[kind] || 1);
  }
  for (let k = 0; k < n; k++) for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) far[i][j] = Math.min(far[i][j], far[i][k] + far[k][j]);
  const spots = names.map((_, i) => [Math.cos((2 * Math.PI * i) / n) * n * 0.4, Math.sin((2 * Math.PI * i) / n) * n * 0.25]);
  for (let round = 0; round < 300; round++) {
    for (let i = 0; i < n; i++) {
      let x = 0, y = 0, total = 0;
      for (let j = 0; j < n; j++) {
        if (i === j) continue;
        const d = Number.isFinite(far[i][j]) ? far[i][j] : 3, w = 1 / (d * d);
        const dx = spots[i][0] - spots[j][0], dy = spots[i][1] - spots[j][1], length = Math.hypot(dx, dy) || 1e-6;
        x += w * (spots[j][0] + (d * dx) / length);
        y += w * (spots[j][1] + (d * dy) / length);
        total += w;
      }
      if (total) spots[i] = [x / total, y / total];
    }
  }
  return fit(names, spots);
}

function fit(names, spots) {
  const [xs, ys] = [0, 1].map((c) => spots.map((s) => s[c]));
  const scale = (values, size) => {
    const low = Math.min(...values), high = Math.max(...values), room = size - 2 * MARGIN;
    return values.map((v) => (high - low < 1e-9 ? size / 2 : MARGIN + ((v - low) / (high - low)) * room));
  };
  const [x, y] = [scale(xs, WIDTH), scale(ys, HEIGHT)];
  return new Map(names.map((name, i) => [name, [x[i], y[i]]]));
}

// Moves places apart that would cover each other, and labels with them.
function spread(places) {
  const spots = [...places.values()], inside = (v, size) => Math.min(size - MARGIN, Math.max(MARGIN, v));
  for (let round = 0; round < 120; round++) {
    for (const a of spots) for (const b of spots) {
      if (a === b) continue;
      const dx = a[0] - b[0] || 0.1, dy = (a[1] - b[1] || 0.1) * 0.85, gap = Math.hypot(dx, dy);
      if (gap >= APART) continue;
      const push = (APART - gap) / gap / 4;
      a[0] = inside(a[0] + dx * push, WIDTH);
      a[1] = inside(a[1] + dy * push, HEIGHT);
      b[0] = inside(b[0] - dx * push, WIDTH);
      b[1] = inside(b[1] - dy * push, HEIGHT);
    }
  }
  return places;
}

function curve([ax, ay], [bx, by], bend) {
  const length = Math.hypot(bx - ax, by - ay) || 1;
  const mx = (ax + bx) / 2 - ((by - ay) / length) * bend, my = (ay + by) / 2 + ((bx - ax) / length) * bend;
  const at = (t) => [[ax, mx, bx], [ay, my, by]].map(([from, over, to]) => (1 - t) ** 2 * from + 2 * t * (1 - t) * over + t * t * to);
  return { path: `M${ax} ${ay}Q${mx} ${my} ${bx} ${by}`, middle: at(0.5), at };
}

// A link's arrowhead with its figure stands where that covers no place, no name and no other figure: in the middle, or
// else towards an end.
const ALONG = [0.5, 0.42, 0.58, 0.35, 0.65, 0.28, 0.72];

function clearSpot(at, lift, text, taken) {
  const half = 3.4 * text.length + 2, boxes = ALONG.map((t) => ((p) => [p[0] - half, p[1] - lift - 11, p[0] + half, p[1] - lift + 3])(at(t)));
  const covered = ([x0, y0, x1, y1]) => taken.reduce((sum, [u0, v0, u1, v1]) =>
    sum + Math.max(0, Math.min(x1, u1) - Math.max(x0, u0)) * Math.max(0, Math.min(y1, v1) - Math.max(y0, v0)), 0);
  const areas = boxes.map(covered), best = areas.indexOf(Math.min(...areas));
  taken.push(boxes[best]);
  return at(ALONG[best]);
}

export class NetworkDrawing {
  constructor(host) {
    this.host = host;
    this.key = null;
    this.focused = null;
    new ResizeObserver(() => this.last && this.update(...this.last)).observe(host);
  }

  // picture: {nodes: [{id, temperature_K, heat_W, sensed}], boundaries, links, loads, effects}; temperatures may be null.
  update(picture, unit) {
    this.last = [picture, unit];
    const names = [...picture.nodes, ...picture.boundaries].map((p) => p.id);
    const narrow = this.host.clientWidth < 620;
    const few = names.length <= 3;
    [WIDTH, HEIGHT] = narrow ? [480, few ? 260 : 520] : [900, few ? 220 : 430];
    const key = JSON.stringify([narrow, names, picture.links.map((l) => l.ends)]);
    if (key !== this.key) {
      this.places = spread(layout(names, picture.links));
      this.key = key;
    }
    const svg = draw("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "group", "aria-label": describe(picture, unit) });
    if (!narrow) svg.style.height = `${HEIGHT - 10}px`;
    const strongest = Math.max(1e-9, ...picture.links.map((l) => Math.abs(l.heat_W || 0)));
    const joined = new Set();
    const labels = [];
    this.taken = [...this.places].flatMap(([name, [x, y]]) => [[x - 27, y - 27, x + 27, y + 27], [x - 4 * name.length, y + 29, x + 4 * name.length, y + 46]]);
    this.taken.push(...picture.loads.map(({ node }) => this.places.get(node)).map(([x, y]) => [x - 30, y - 44, x + 30, y - 27]));
    for (const link of picture.links) svg.append(...this.link(link, strongest, joined, labels));
    for (const effect of picture.effects) svg.append(...this.effect(effect));
    const known = picture.nodes.map((p) => p.temperature_K).filter((t) => t !== null);
    const low = Math.min(...known), high = Math.max(...known);
    for (const boundary of picture.boundaries) svg.append(...this.sink(boundary, unit));
    for (const node of picture.nodes) {
      const loads = picture.loads.filter((l) => l.node === node.id).reduce((sum, l) => sum + l.heat_W, 0);
      svg.append(...this.node(node, (node.temperature_K - low) / Math.max(high - low, 1), unit, loads));
    }
    svg.append(...labels);
    const kept = this.host.contains(document.activeElement) ? this.focused : null;
    this.focused = null;
    this.host.replaceChildren(svg);
    if (kept) [...svg.querySelectorAll(".place")].find((g) => g.getAttribute("aria-label").startsWith(`${kept}:`))?.focus({ preventScroll: true });
  }

  // The flows of the node that has the focus stand out.
  follow(id) {
    this.focused = id;
    for (const flow of this.host.querySelectorAll(".flow")) flow.classList.toggle("aside", id !== null && !flow.dataset.ends.split("|").includes(id));
  }

  link(link, strongest, joined, labels) {
    const [a, b] = link.ends.map((end) => this.places.get(end));
    const pair = [...link.ends].sort().join("|");
    const bend = link.kind === "radiator" || joined.has(pair) ? 22 : 0;
    joined.add(pair);
    const { path, at } = curve(a, b, bend);
    const share = Math.abs(link.heat_W || 0) / strongest, width = 2 + 7 * Math.sqrt(share);
    const parts = [draw("path", { d: path, class: "tube", "stroke-width": width, opacity: link.kind === "radiator" ? 0.45 : 0.9 })];
    if (link.heat_W === null) return parts;
    const flow = draw("path", {
      d: path, class: `flow${link.heat_W < 0 ? " back" : ""}`, "stroke-width": Math.max(1.5, width * 0.5),
      stroke: link.kind === "radiator" ? "#7a6ff0" : "#e8743b",
    });
    flow.style.animationDuration = `${(1.9 - 1.4 * Math.sqrt(share)).toFixed(2)}s`;
    if (share < 0.004) flow.style.animation = "none";
    const way = link.heat_W < 0 ? [...link.ends].reverse() : link.ends;
    flow.append(draw("title", {}, `${way.join(" → ")}: ${watts(Math.abs(link.heat_W))}`));
    flow.dataset.ends = link.ends.join("|");
    const size = 5 + width, flows = share >= 0.004;  // the figure stands clear of the arrowhead
    const figure = watts(Math.abs(link.heat_W)), lift = flows ? size + 4 : 9, [x, y] = clearSpot(at, lift, figure, this.taken);
    labels.push(draw("text", { x, y: y - lift, class: "value halo" }, figure));
    if (!flows) return [...parts, flow];
    const [from, to] = link.heat_W < 0 ? [b, a] : [a, b];
    const turn = (Math.atan2(to[1] - from[1], to[0] - from[0]) * 180) / Math.PI;
    const head = draw("path", { d: `M${size} 0L${-size * 0.7} ${size * 0.75}L${-size * 0.7} ${-size * 0.75}Z`, class: "head", fill: link.kind === "radiator" ? "#7a6ff0" : "#e8743b", transform: `translate(${x} ${y}) rotate(${turn})` });
    return [...parts, flow, head];
  }

  effect(effect) {
    const ends = effect.where.nodes || [effect.where.node, effect.where.sink || effect.where.boundary];
    const heated = Object.keys(effect.heat_W).find((node) => this.places.has(node)), into_W = effect.heat_W[heated];
    const figure = into_W === undefined ? "" : watts(Math.abs(into_W)), words = effectWords({ effect: effect.effect, where: {} });
    const [first, second] = [ends[0] || heated, ends[1]], [a, b] = [this.places.get(first), this.places.get(second)];
    if (a && b) {
      const { path, middle: [x, y] } = curve(a, b, -30), parts = [draw("path", { d: path, class: "effect" })];
      if (into_W) {  // heat flows to the heated end, or from the cooled one
        const [from, to] = (heated === first) === into_W > 0 ? [b, a] : [a, b];
        const turn = (Math.atan2(to[1] - from[1], to[0] - from[0]) * 180) / Math.PI;
        parts.push(draw("path", { d: "M8 0L-6 6L-6 -6Z", class: "head effect-head", transform: `translate(${x} ${y}) rotate(${turn})` }));
      }
      return [...parts, draw("text", { x, y: y - 13, class: "effect-label halo" }, `${words} ${figure}`.trim())];
    }
    if (!a) return [];
    const way = into_W ? `${into_W < 0 ? "↑" : "↓"} ${figure}` : figure;
    return [draw("circle", { cx: a[0], cy: a[1], r: 33, class: "effect" }), draw("text", { x: a[0], y: a[1] - 48, class: "effect-label halo" }, `${words} ${way}`.trim())];
  }

  sink({ id, temperature_K }, unit) {
    const [x, y] = this.places.get(id);
    const parts = [draw("rect", { x: x - 24, y: y - 16, width: 48, height: 32, rx: 8, class: "sink" }), draw("text", { x, y: y + 32, class: "halo" }, id)];
    const text = temperature_K === null ? "" : number(toUnit(temperature_K, "K", unit), 0);
    return [...parts, draw("text", { x, y: y + 4, class: "value" }, text)];
  }

  node({ id, temperature_K, heat_W, sensed }, share, unit, loads) {
    const [x, y] = this.places.get(id), known = temperature_K !== null;
    const disc = draw("circle", { cx: x, cy: y, r: 25, class: sensed === false ? "node hidden-node" : "node", fill: known ? heat(share) : "var(--line-strong)" });
    const words = known ? `${id}: ${number(toUnit(temperature_K, "K", unit))} ${unitName(unit)}, ${net(heat_W)}` : id;
    const ink = known && share > 0.78 ? "#221408" : "#ffffff";
    const parts = [disc, draw("text", { x, y: y + 4, class: "inside", style: `fill:${ink}` }, known ? number(toUnit(temperature_K, "K", unit), 1) : "")];
    parts.push(draw("text", { x, y: y + 41, class: "halo" }, id));
    if (Math.abs(loads) > 1e-6) parts.push(draw("text", { x, y: y - 31, class: "value halo" }, `${loads < 0 ? "↑" : "↓"} ${watts(Math.abs(loads))}`));
    const group = draw("g", { class: "place", tabindex: 0, role: "img", "aria-label": words });
    group.append(draw("title", {}, words), draw("circle", { cx: x, cy: y, r: 30, class: "ring" }), ...parts);
    group.addEventListener("focus", () => this.follow(id));
    group.addEventListener("blur", () => this.follow(null));
    return [group];
  }
}

const net = (heat_W) => (Math.abs(heat_W) < 1e-9 ? "in balance" : `${heat_W > 0 ? "warming" : "cooling"} with ${watts(Math.abs(heat_W))}`);

const describe = (picture, unit) => {
  const temperatures = picture.nodes.filter((p) => p.temperature_K !== null)
    .map((p) => `${p.id} ${number(toUnit(p.temperature_K, "K", unit), 1)} ${unitName(unit)}`);
  return `Thermal network of ${picture.nodes.length} nodes. ${temperatures.join(", ")}`;
};

// What can be drawn before any model is active: the declaration with the sensors' last readings.
export function declared(specification, latest_K) {
  const sensorOf = (node) => (Array.isArray(node.sensor) ? node.sensor[0] : node.sensor);
  return {
    nodes: specification.nodes.map((n) => ({ id: n.id, temperature_K: latest_K[sensorOf(n)] ?? null, heat_W: 0, sensed: Boolean(n.sensor) })),
    boundaries: Object.entries(specification.boundaries || {}).map(([id, b]) => ({ id, temperature_K: b.value_K ?? null })),
    links: [
      ...(specification.conductors || []).map((c) => ({ kind: "conductor", ends: c.between, heat_W: null })),
      ...(specification.radiators || []).map((r) => ({ kind: "radiator", ends: [r.node, r.sink], heat_W: null })),
    ],
    loads: [], effects: [],
  };
}
