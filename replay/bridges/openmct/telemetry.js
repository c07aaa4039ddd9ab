/** Telemetry of the tree's objects: from the archive, from forecasts, and live. */

import { FORECASTS, KIND, parts } from './objects.js';

const OURS = new Set([KIND.measured, KIND.forecast, KIND.residual, KIND.anomalies, KIND.findings]);
const MOST_STEPS = 500;
const LEAST_STEP_S = 1;
const MOST_AHEAD_S = 7 * 86_400;
const FORECAST_EVERY_MS = 15_000;
const SHARED_MS = 5_000;
/** Colours of a twin's limits as levels of Open MCT. */
const LEVELS = { yellow: 'WARNING', red: 'CRITICAL' };

const iso = (ms) => new Date(ms).toISOString();
const instant = (text) => Date.parse(text);

export class Telemetry {
  constructor(api, objects, streams) {
    Object.assign(this, { api, objects, streams, forecasts: new Map() });
  }

  supportsRequest(object) {
    return OURS.has(object.type);
  }

  supportsSubscribe(object) {
    return OURS.has(object.type);
  }

  /** Returns data within options.start and options.end: `latest` the last one, `minmax` about options.size with all extremes. */
  async request(object, options) {
    const { kind, twin, channel } = parts(object.identifier);
    const data = await this.read(kind, twin, channel, options);
    const within = data.filter((datum) => datum.time >= options.start && datum.time <= options.end);
    return options.strategy === 'latest' ? within.slice(-(options.size ?? 1)) : within;
  }

  read(kind, twin, channel, options) {
    return kind in FORECASTS ? this.forecast(kind, twin, channel, options) : this[kind](twin, channel, options);
  }

  /** Readings; the service keeps the extremes where it thins out, which is what `minmax` asks for. */
  async measured(twin, channel, options) {
    const read = async (start, points) => {
      const query = { start: iso(start), stop: iso(options.end + 1), channels: channel, max_points: points };
      const found = await this.api.get(`v1/twins/${twin}/telemetry`, query, options.signal);
      return columns(found, found?.values[channel], (value) => ({ value }));
    };
    return this.newestFirst(options, read);
  }

  async residual(twin, channel, options) {
    const read = async (start, points) => {
      const query = { start: iso(start), stop: iso(options.end + 1), max_points: points };
      const found = await this.api.get(`v1/twins/${twin}/residuals`, query, options.signal);
      return columns(found, found?.residual_K[channel], (residual, k) => ({ residual, sigma: found.std_K[channel][k] }));
    };
    return this.newestFirst(options, read);
  }

  /** Reads all of the span, or for `latest` only as far back as needed. */
  async newestFirst(options, read) {
    if (options.strategy !== 'latest') {
      return read(options.start, options.size ? Math.max(2, Math.round(options.size)) : undefined);
    }
    for (let span = 60_000; ; span *= 8) {
      const start = Math.max(options.start, options.end - span);
      const data = await read(start, undefined);
      if (data.length || start === options.start) {
        return data;
      }
    }
  }

  /** What is expected from now on; of the past a twin keeps no forecasts. */
  async forecast(kind, twin, channel, options) {
    const found = await this.ahead(twin, options);
    return columns(found, found?.values[channel]?.[FORECASTS[kind].column], (value) => ({ value }));
  }

  /** Returns a forecast up to the end of the options; views that ask for the same one at the same time share it. */
  async ahead(twin, options) {
    const steps = Math.min(Math.round(options.size ?? 200), MOST_STEPS);
    const key = `${twin}~${options.end}~${steps}`;
    const kept = this.forecasts.get(key);
    if (kept && Date.now() - kept.at < SHARED_MS) {
      return kept.asked;
    }
    const asked = this.askAhead(twin, options.end, steps);
    this.forecasts = new Map([[key, { at: Date.now(), asked }]]);
    return asked;
  }

  async askAhead(twin, end, steps) {
    const detail = await this.api.get(`v1/twins/${twin}`);
    const ahead = detail?.last_time ? (end - instant(detail.last_time)) / 1000 : 0;
    const horizon = Math.min(ahead, MOST_AHEAD_S); // of a recording of the past, the page may show a time years ahead
    if (horizon <= 0 || detail.active_model === null) {
      return null;
    }
    const step = Math.min(Math.max(LEAST_STEP_S, horizon / Math.max(steps, 2)), horizon);
    return this.api.get(`v1/twins/${twin}/forecast`, { horizon_s: horizon, step_s: step });
  }

  async anomalies(twin, _, options) {
    const query = { start: iso(options.start), stop: iso(options.end + 1) };
    const found = await this.api.get(`v1/twins/${twin}/anomalies`, query, options.signal);
    return (found?.anomalies ?? []).map(event).sort((a, b) => a.time - b.time);
  }

  /** What diagnoses found, at the time that they ended. */
  async findings(twin, _, options) {
    const found = await this.api.get(`v1/twins/${twin}/diagnoses`, {}, options.signal);
    return (found?.jobs ?? []).flatMap((job) => this.told(twin, job)).sort((a, b) => a.time - b.time);
  }

  /** Returns one event per finding of a diagnosis, or one that it found nothing. */
  told(twin, job) {
    if (job.state !== 'succeeded' || !job.result) {
      return [];
    }
    const report = `${this.api.base}v1/twins/${twin}/diagnoses/${job.id}/report.html`;
    const findings = job.result.findings ?? [];
    const events = findings.length
      ? findings.map((finding) => ({ message: words(finding), effect: finding.effect }))
      : [{ message: `${job.result.verdict ?? ''}`.replaceAll('_', ' '), effect: '' }];
    return events.map((told, k) => ({ id: `${job.id}~${k}`, time: instant(job.finished), ...told, report }));
  }

  followFindings(twin, callback) {
    return this.streams.listen(twin, async (message) => {
      if (message.type === 'job' && message.job.kind === 'diagnosis' && message.job.state === 'succeeded') {
        const job = await this.api.get(`v1/twins/${twin}/diagnoses/${message.job.id}`);
        this.told(twin, job).forEach(callback);
      }
    });
  }

  subscribe(object, callback) {
    const { kind, twin, channel } = parts(object.identifier);
    const live = { measured: liveValues, residual: liveResiduals, anomalies: liveAnomalies }[kind];
    if (kind in FORECASTS) {
      return this.followForecast(kind, twin, channel, callback);
    }
    if (kind === 'findings') {
      return this.followFindings(twin, callback);
    }
    let last = null;
    return this.streams.listen(twin, async (message) => {
      if (message.type === 'dropped' && last !== null) { // too slow: the archive holds what was missed
        const missed = await this[kind](twin, channel, { start: last + 1, end: Date.parse(message.time) });
        missed.forEach(callback);
        return;
      }
      const datum = live(message, channel);
      if (datum) {
        last = Math.max(last ?? datum.time, datum.time);
        callback(datum);
      }
    });
  }

  /** Hands on what lies beyond the forecast so far, as time goes on. */
  followForecast(kind, twin, channel, callback) {
    let reached = null;
    let horizon = null;
    let askedAt = Date.now();
    return this.streams.listen(twin, async (message) => {
      const switched = message.type === 'model';
      if ((message.type !== 'residual' && !switched) || (Date.now() - askedAt < FORECAST_EVERY_MS && !switched)) {
        return;
      }
      askedAt = Date.now();
      const now = Date.parse(message.time);
      horizon ??= this.aheadMs(now);
      const data = await this.forecast(kind, twin, channel, { start: now, end: now + horizon });
      for (const datum of data.filter((found) => reached === null || found.time > reached)) {
        reached = datum.time;
        callback(datum);
      }
    });
  }

  /** How far beyond now the time of the page reaches, an hour at least. */
  aheadMs(now) {
    const end = this.bounds?.().end ?? now;
    return Math.max(3_600_000, end - now);
  }

  supportsLimits(object) {
    return object.type === KIND.measured || object.type === KIND.forecast;
  }

  getLimitEvaluator(object) {
    const { twin, channel } = parts(object.identifier);
    let limits = null;
    this.objects.channel(twin, channel).then((declared) => {
      limits = declared?.limits ?? null;
    });
    return { evaluate: (datum, metadata) => (metadata && limits ? beyond(limits, datum[metadata.key]) : undefined) };
  }

  getLimits(object) {
    const { twin, channel } = parts(object.identifier);
    return {
      limits: async () => {
        const limits = (await this.objects.channel(twin, channel))?.limits ?? {};
        const found = {};
        for (const [colour, level] of Object.entries(LEVELS)) {
          const [low, high] = limits[colour] ?? [null, null];
          found[level] = {
            ...(low === null ? {} : { low: { color: colour, value: low } }),
            ...(high === null ? {} : { high: { color: colour, value: high } })
          };
        }
        return found;
      }
    };
  }
}

/** Returns which limit a value is beyond, the red ones first. */
function beyond(limits, value) {
  for (const colour of ['red', 'yellow']) {
    const [low, high] = limits[colour] ?? [null, null];
    if (high !== null && value > high) {
      return { cssClass: `is-limit--upr is-limit--${colour}`, low: high, high: Number.POSITIVE_INFINITY, name: `${colour} high` };
    }
    if (low !== null && value < low) {
      return { cssClass: `is-limit--lwr is-limit--${colour}`, low: Number.NEGATIVE_INFINITY, high: low, name: `${colour} low` };
    }
  }
  return undefined;
}

function columns(found, values, shape) {
  if (!found || !values) {
    return [];
  }
  const data = [];
  found.time.forEach((text, k) => {
    if (values[k] !== null) {
      data.push({ time: instant(text), ...shape(values[k], k) });
    }
  });
  return data;
}

function event(anomaly) {
  return {
    id: `${anomaly.id}`, time: instant(anomaly.start), sensor: anomaly.sensor, message: anomaly.message, score: anomaly.score,
    state: anomaly.stop === null ? 'lasts' : `until ${anomaly.stop}`,
    cause: anomaly.cause ? `${anomaly.cause.effect}` : ''
  };
}

/** A finding in one line: effect, place, parameters with their standard deviation. */
function words({ effect, where, parameters }) {
  const place = Object.entries(where).map(([key, value]) => `${key} ${[value].flat().join(' - ')}`).join(', ');
  const numbers = Object.entries(parameters).map(([name, value]) => `${name} = ${span(value)}`).join(', ');
  return `${effect} at ${place}${numbers && `: ${numbers}`}`;
}

function span(value) {
  if (typeof value?.mean !== 'number') {
    return Array.isArray(value) || typeof value === 'object' ? JSON.stringify(value) : `${value}`;
  }
  const short = (number, digits) => `${Number(number.toPrecision(digits))}`;
  return short(value.mean, 4) + (typeof value.std === 'number' ? ` ± ${short(value.std, 2)}` : '');
}

function liveValues(message, channel) {
  const value = message.type === 'sample' ? message.values[channel] : undefined;
  return value === undefined ? null : { time: instant(message.time), value };
}

function liveResiduals(message, channel) {
  const residual = message.type === 'residual' ? message.residual_K[channel] : undefined;
  return residual === undefined ? null : { time: instant(message.time), residual };
}

function liveAnomalies(message) {
  return message.type === 'anomaly' ? event(message.anomaly) : null;
}
