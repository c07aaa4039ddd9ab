// What the page shows as a file: measured values, predictions and the forecast with its band, one row per instant.
const cell = (value) => (value === null || value === undefined ? "" : typeof value === "string" && /[",\n]/.test(value) ? `"${value.replaceAll('"', '""')}"` : String(value));

export function csvOf({ archive, ahead, planned, names, units }) {
  const head = ["time", ...names.map((n) => (units[n] ? `${n} [${units[n]}]` : n))];
  const rows = archive.time.map((time, i) => [time, ...names.map((n) => archive.values[n]?.[i])]);
  const width = head.length;
  if (ahead) {
    const sensors = Object.keys(ahead.values);
    const kinds = [["mean", "forecast"], ["q05", "5 %"], ["q95", "95 %"]];
    for (const s of sensors) head.push(...kinds.map(([, word]) => `${s} ${word}`), ...(planned ? [`${s} with the plan`] : []));
    const pad = new Array(width - 1).fill(null);
    ahead.time.forEach((time, i) => rows.push([time, ...pad, ...sensors.flatMap((s) => [...kinds.map(([kind]) => ahead.values[s][kind][i]), ...(planned ? [planned.values[s].mean[i]] : [])])]));
  }
  return [head, ...rows].map((row) => Array.from({ length: head.length }, (_, i) => cell(row[i])).join(",")).join("\r\n") + "\r\n";
}

export function save(name, text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
