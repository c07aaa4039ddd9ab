// Numbers, times and colours as the page shows them.
export const seconds = (text) => Date.parse(text) / 1000;

const pad = (n) => String(n).padStart(2, "0");

export function clock(unix_s, withDate = true) {
  const d = new Date(unix_s * 1000);
  const day = `${d.getUTCFullYear()}-${pad(d.getUTCMonth() + 1)}-${pad(d.getUTCDate())}`;
  const time = `${pad(d.getUTCHours())}:${pad(d.getUTCMinutes())}:${pad(d.getUTCSeconds())}`;
  return withDate ? `${day} ${time}` : time;
}

// The unix second that somebody typed as "2026-01-31 12:00[:00]", NaN if it is none; UTC, as everything here.
export const typed = (text) => {
  const found = /^\s*(\d{4}-\d{2}-\d{2})[T ](\d{2}:\d{2}(?::\d{2}(?:\.\d+)?)?)\s*(?:Z|UTC)?\s*$/i.exec(text);
  return found ? Date.parse(`${found[1]}T${found[2]}Z`) / 1000 : NaN;
};

export function span(length_s) {
  const units = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]];
  const [size, name] = units.find(([size]) => length_s >= size * 1.5) || [1, "s"];
  const value = length_s / size;
  return `${value >= 10 ? Math.round(value) : Number(value.toFixed(1))} ${name}`;
}

export const count = (n) => n.toLocaleString("en-US");

export function number(value, digits = 2) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size < 1e-3 || size >= 1e6) ? size.toExponential(2) : size.toFixed(digits);
  return value < 0 && Number(text) !== 0 ? `−${text}` : text;
}

export const watts = (value) => {
  const size = Math.abs(value);
  return `${size >= 100 ? value.toFixed(0) : size >= 1 ? value.toFixed(1) : value.toFixed(2)} W`;
};

// Temperatures are shown in one unit whatever the channels use.
export const toUnit = (value, from, to) => {
  if (value === null || from === to || !["K", "degC"].includes(from)) return value;
  return to === "K" ? value + 273.15 : value - 273.15;
};

export const unitName = (unit) => (unit === "degC" ? "°C" : unit);

// Twelve hues that stay apart in both themes and for the common colour deficiencies; neighbours differ in lightness too.
const LIGHT = ["#3b5bdb", "#d9480f", "#2b8a3e", "#ae3ec9", "#0c8599", "#c2255c", "#866118", "#5f3dc4", "#e8890c", "#087f5b", "#6b7280", "#1c7ed6"];
const DARK = ["#7c9bff", "#ff9254", "#5fd07a", "#dd86f2", "#3fd0e0", "#ff7aa8", "#d9b25a", "#a996ff", "#ffc15e", "#4fd6a8", "#aab3c2", "#6cb8ff"];

export const isDark = () => {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
};

export const colour = (index) => (isDark() ? DARK : LIGHT)[index % LIGHT.length];

export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Cold to hot: indigo, magenta, amber (perceptually ordered, readable on both themes).
const STOPS = [[48, 52, 148], [122, 53, 160], [194, 65, 124], [232, 106, 76], [247, 173, 66]];

export function heat(share) {
  const x = Math.min(0.9999, Math.max(0, share)) * (STOPS.length - 1);
  const i = Math.floor(x);
  const mix = STOPS[i].map((low, c) => Math.round(low + (STOPS[i + 1][c] - low) * (x - i)));
  return `rgb(${mix.join(" ")})`;
}

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "class") element.className = value;
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") element.style.cssText = value;
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

export const effectWords = ({ effect, where }) => {
  const place = Object.values(where || {}).flat().join(" ↔ ");
  return `${effect.replaceAll("_", " ")}${place ? ` · ${place}` : ""}`;
};
