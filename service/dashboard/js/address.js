// The address of the page keeps what it shows: #twin?from=…&to=…, so that a link leads others to the same view.
const iso = (unix_s) => new Date(Math.round(unix_s) * 1000).toISOString().replace(".000Z", "Z");

export function readAddress(hash) {
  const [twin, query = ""] = decodeURIComponent(hash.slice(1)).split("?");
  const asked = new URLSearchParams(query);
  const instants = ["from", "to"].map((name) => Date.parse(asked.get(name)) / 1000);
  const number = (name) => (asked.has(name) && Number.isFinite(Number(asked.get(name))) ? Number(asked.get(name)) : null);
  return {
    twin: twin || null,
    zoom: instants.every(Number.isFinite) && instants[0] < instants[1] ? instants : null,
    range_s: asked.get("range") === "all" ? Infinity : number("range"),
    horizon_s: number("ahead"),
    unit: ["K", "degC"].includes(asked.get("unit")) ? asked.get("unit") : null,
    hidden: (asked.get("hidden") || "").split(",").filter(Boolean),
  };
}

export function writeAddress({ twin, zoom, range_s, horizon_s, unit, hidden }) {
  if (!twin) return "#";
  const parts = zoom ? [`from=${iso(zoom[0])}`, `to=${iso(zoom[1])}`] : [`range=${Number.isFinite(range_s) ? range_s : "all"}`];
  if (horizon_s) parts.push(`ahead=${horizon_s}`);
  if (unit) parts.push(`unit=${unit}`);
  if (hidden.size) parts.push(`hidden=${[...hidden].map(encodeURIComponent).join(",")}`);
  return `#${twin}?${parts.join("&")}`;
}
