/** The object tree: twins, their sensors with what is forecast and what is left over, inputs, anomalies, findings. */

export const KIND = {
  twin: 'thermal-twin.twin',
  measured: 'thermal-twin.measured',
  forecast: 'thermal-twin.forecast',
  residual: 'thermal-twin.residual',
  anomalies: 'thermal-twin.anomalies',
  findings: 'thermal-twin.findings'
};

const TIME = { key: 'utc', source: 'time', name: 'Time', format: 'utc', hints: { domain: 1 } };

/** What of a forecast each object shows; the two quantiles are the ends of the band of 90 %. */
export const FORECASTS = {
  forecast: { name: 'forecast', column: 'mean' },
  low: { name: 'forecast, 5 %', column: 'q05' },
  high: { name: 'forecast, 95 %', column: 'q95' }
};

/** What the plot of a sensor draws, and how. */
const DRAWN = [
  ['measured', { color: '#43b0ff', limitLines: true }],
  ['forecast', { color: '#ff9c00', markers: false }],
  ['low', { color: '#a06a18', markers: false }],
  ['high', { color: '#a06a18', markers: false }]
];

const TYPES = {
  [KIND.twin]: ['Thermal twin', 'icon-box-round-corners'],
  [KIND.measured]: ['Telemetry of a twin', 'icon-telemetry'],
  [KIND.forecast]: ['Forecast', 'icon-telemetry'],
  [KIND.residual]: ['Residual', 'icon-telemetry'],
  [KIND.anomalies]: ['Anomalies', 'icon-alert-rect'],
  [KIND.findings]: ['Findings', 'icon-magnify']
};

/** Splits the key of an object: kind, twin and channel. Ids of twins hold no tilde; channels come last. */
export function parts(identifier) {
  const [kind, twin, ...channel] = identifier.key.split('~');
  return { kind, twin, channel: channel.join('~') };
}

export function addTypes(openmct) {
  for (const [key, [name, cssClass]] of Object.entries(TYPES)) {
    openmct.types.addType(key, { name, cssClass, description: name });
  }
}

export class Objects {
  constructor(api, namespace, title) {
    Object.assign(this, { api, namespace, title });
    this.twins = new Map();
  }

  id(...key) {
    return { namespace: this.namespace, key: key.join('~') };
  }

  /** Returns a twin with its specification; it is asked for once a minute at most. */
  async twin(name) {
    const kept = this.twins.get(name);
    if (kept && Date.now() - kept.at < 60_000) {
      return kept.asked;
    }
    const asked = this.api.get(`v1/twins/${name}`);
    this.twins.set(name, { at: Date.now(), asked });
    asked.catch(() => this.twins.delete(name));
    return asked;
  }

  async channel(twin, name) {
    return (await this.twin(twin))?.specification.channels[name];
  }

  async get(identifier) {
    const { kind, twin, channel } = parts(identifier);
    if (kind === 'root') {
      return { identifier, name: this.title, type: 'folder', location: 'ROOT' };
    }
    if (kind === 'twin') {
      return { identifier, name: twin, type: KIND.twin, location: this.keyString('root') };
    }
    if (kind === 'anomalies') {
      return {
        identifier, name: 'Anomalies', type: KIND.anomalies, location: this.keyString('twin', twin),
        telemetry: { values: anomalyValues() }
      };
    }
    if (kind === 'findings') {
      return {
        identifier, name: 'Findings', type: KIND.findings, location: this.keyString('twin', twin),
        telemetry: { values: findingValues() }
      };
    }
    const declared = await this.channel(twin, channel);
    if (!declared) {
      return { identifier, name: `${channel} (not declared any more)`, type: 'unknown', location: this.keyString('twin', twin) };
    }
    const unit = declared.unit;
    const below = { location: this.keyString('sensor', twin, channel) };
    switch (kind) {
      case 'sensor':
        return {
          identifier, name: channel, type: 'telemetry.plot.overlay', location: this.keyString('twin', twin),
          composition: DRAWN.map(([kind]) => this.id(kind, twin, channel)),
          configuration: {
            objectStyles: {},
            series: DRAWN.map(([kind, style]) => ({ identifier: this.id(kind, twin, channel), ...style }))
          }
        };
      case 'measured':
        return {
          identifier, name: `${channel} measured`, type: KIND.measured, ...below,
          telemetry: { values: [TIME, range('value', channel, unit, 1)] }
        };
      case 'forecast':
      case 'low':
      case 'high':
        return {
          identifier, name: `${channel} ${FORECASTS[kind].name}`, type: KIND.forecast, ...below,
          telemetry: { values: [TIME, range('value', FORECASTS[kind].name, unit, 1)] }
        };
      case 'residual':
        return {
          identifier, name: `${channel} residual`, type: KIND.residual, ...below,
          telemetry: {
            values: [TIME, range('residual', 'Residual', 'K', 1), range('sigma', 'Expected deviation', 'K', 2)]
          }
        };
      default:
        return { identifier, name: identifier.key, type: 'unknown' };
    }
  }

  keyString(...key) {
    return `${this.namespace}:${key.join('~')}`;
  }

  appliesTo(object) {
    return object.identifier.namespace === this.namespace && ['root', 'twin', 'sensor'].includes(parts(object.identifier).kind);
  }

  async load(object) {
    const { kind, twin, channel } = parts(object.identifier);
    if (kind === 'root') {
      const { twins } = await this.api.get('v1/twins');
      return twins.map((found) => this.id('twin', found.id));
    }
    if (kind === 'sensor') {
      return DRAWN.map(([what]) => this.id(what, twin, channel));
    }
    const { channels, nodes } = (await this.twin(twin)).specification;
    const names = Object.keys(channels);
    const sensed = new Set(nodes.flatMap((node) => node.sensor ?? [])); // a boundary's temperature is given, not predicted
    const sensors = names.filter((name) => sensed.has(name));
    return [
      this.id('anomalies', twin),
      this.id('findings', twin),
      ...sensors.flatMap((name) => [this.id('sensor', twin, name), this.id('residual', twin, name)]),
      ...names.filter((name) => !sensors.includes(name)).map((name) => this.id('measured', twin, name))
    ];
  }
}

function range(key, name, unit, priority) {
  return { key, name, unit: unit ?? undefined, format: 'number', hints: { range: priority } };
}

const text = (key, name) => ({ key, name, format: 'string' });

function findingValues() {
  return [TIME, { ...text('message', 'Event'), hints: { label: 0 } }, text('effect', 'Effect'), text('report', 'Report')];
}

function anomalyValues() {
  return [TIME, { ...text('message', 'Event'), hints: { label: 0 } }, text('sensor', 'Sensor'), text('state', 'State'), text('cause', 'Cause'),
    { key: 'score', name: 'Score', format: 'number' }];
}
