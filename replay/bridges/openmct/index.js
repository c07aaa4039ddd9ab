/**
 * Thermal twins in Open MCT: `openmct.install(ThermalTwin({ url: '/twin' }))`.
 *
 * @param {object} [options]
 * @param {string} [options.url] where the service of the twins is reached, best below the page's own origin
 * @param {string} [options.key] API key; better added by a proxy, since the page shows it to whoever opens it
 * @param {string} [options.namespace] of the objects
 * @param {string} [options.title] of the root folder
 */
import { Api } from './api.js';
import { addTypes, Objects } from './objects.js';
import { Streams } from './stream.js';
import { Telemetry } from './telemetry.js';

export default function ThermalTwin({ url = '/twin', key, namespace = 'thermal-twin', title = 'Thermal twins' } = {}) {
  return function install(openmct) {
    const api = new Api(url, key);
    const objects = new Objects(api, namespace, title);
    const telemetry = new Telemetry(api, objects, new Streams(api));
    telemetry.bounds = () => openmct.time.getBounds();
    addTypes(openmct);
    openmct.objects.addRoot({ namespace, key: 'root' });
    openmct.objects.addProvider(namespace, objects);
    openmct.composition.addProvider(objects);
    openmct.telemetry.addProvider(telemetry);
  };
}
