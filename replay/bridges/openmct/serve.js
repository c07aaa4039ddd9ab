#!/usr/bin/env node
/** Serves Open MCT with the plug-in, and passes /twin on to a service: one origin, and the API key stays here. */
import { createReadStream, existsSync, statSync } from 'node:fs';
import http from 'node:http';
import https from 'node:https';
import { createRequire } from 'node:module';
import { dirname, extname, join, normalize } from 'node:path';
import { fileURLToPath } from 'node:url';
import { parseArgs } from 'node:util';

const OPTIONS = {
  service: { type: 'string', default: 'http://127.0.0.1:8000' },
  port: { type: 'string', default: '8081' },
  host: { type: 'string', default: '127.0.0.1' },
  openmct: { type: 'string' }
};
const TYPES = {
  '.js': 'text/javascript', '.css': 'text/css', '.html': 'text/html', '.json': 'application/json', '.svg': 'image/svg+xml',
  '.png': 'image/png', '.woff': 'font/woff', '.woff2': 'font/woff2', '.ttf': 'font/ttf'
};
const PAGE = `<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><title>Thermal twins</title><link rel="icon" href="/openmct/favicons/favicon-32x32.png">
<script src="/openmct/openmct.js"></script></head>
<body><script type="module">
import ThermalTwin from '/plugin/index.js';
openmct.setAssetPath('/openmct');
for (const plugin of ['LocalStorage', 'Espresso', 'MyItems', 'UTCTimeSystem']) {
  openmct.install(openmct.plugins[plugin]());
}
const query = new URLSearchParams(location.search);
const minutes = (name, usual) => 60_000 * Number(query.get(name) ?? usual);
const at = (name, usual) => query.has(name) ? Date.parse(query.get(name)) : usual;
const fixed = { start: at('start', Date.now() - minutes('back', 60)), end: at('stop', Date.now() + minutes('ahead', 60)) };
openmct.install(openmct.plugins.Conductor({
  menuOptions: [
    { name: 'Fixed', timeSystem: 'utc', bounds: fixed },
    { name: 'Live', timeSystem: 'utc', clock: 'local', clockOffsets: { start: -minutes('back', 60), end: minutes('ahead', 60) } }
  ]
}));
openmct.install(ThermalTwin({ url: '/twin' }));
window.openmct = openmct;
openmct.start(document.body);
</script></body>
</html>`;

const { values: options } = parseArgs({ options: OPTIONS });
const service = new URL(options.service);
const own = dirname(fileURLToPath(import.meta.url));
const dist = options.openmct ?? dirname(createRequire(join(process.cwd(), 'x.js')).resolve('openmct'));
if (!existsSync(join(dist, 'openmct.js'))) {
  console.error(`no Open MCT in ${dist}; npm install openmct, or name its dist folder with --openmct`);
  process.exit(2);
}

/** Returns the headers for the service: its own host, no origin of a page, and the key. */
function headersFor(request) {
  const headers = { ...request.headers, host: service.host };
  delete headers.origin;
  delete headers.referer;
  if (process.env.TWIN_API_KEY) {
    headers.authorization = `Bearer ${process.env.TWIN_API_KEY}`;
  }
  return headers;
}

function ask(request) {
  const path = join(service.pathname, request.url.slice('/twin'.length));
  const { request: send } = service.protocol === 'https:' ? https : http;
  return send({ protocol: service.protocol, hostname: service.hostname, port: service.port, path, method: request.method, headers: headersFor(request) });
}

function file(root, path, response) {
  const found = join(root, normalize(`/${decodeURIComponent(path)}`));
  if (!found.startsWith(root) || !existsSync(found) || !statSync(found).isFile()) {
    response.writeHead(404).end();
    return;
  }
  response.writeHead(200, { 'Content-Type': TYPES[extname(found)] ?? 'application/octet-stream' });
  createReadStream(found).pipe(response);
}

const server = http.createServer((request, response) => {
  const path = request.url.split('?')[0];
  if (path.startsWith('/twin/') && !['GET', 'HEAD'].includes(request.method)) {
    response.writeHead(405, { Allow: 'GET, HEAD' }).end(); // the plug-in reads only, and other pages shall not write with our key
  } else if (path.startsWith('/twin/')) {
    const asked = ask(request);
    asked.on('response', (answer) => {
      response.writeHead(answer.statusCode, answer.headers);
      answer.pipe(response);
    });
    asked.on('error', () => response.headersSent ? response.destroy() : response.writeHead(502, { 'Content-Type': 'application/json' })
      .end(JSON.stringify({ detail: `the service at ${service} does not answer` })));
    response.on('close', () => asked.destroy());
    request.pipe(asked);
  } else if (path === '/') {
    response.writeHead(200, { 'Content-Type': TYPES['.html'] }).end(PAGE);
  } else if (path.startsWith('/plugin/')) {
    file(own, path.slice('/plugin/'.length), response);
  } else if (path.startsWith('/openmct/')) {
    file(dist, path.slice('/openmct/'.length), response);
  } else {
    file(dist, path, response);
  }
});

server.on('upgrade', (request, socket) => {
  const { origin, host } = request.headers;
  if (!request.url.startsWith('/twin/') || (origin && new URL(origin).host !== host)) {
    socket.end('HTTP/1.1 403 Forbidden\r\n\r\n');
    return;
  }
  const asked = ask(request);
  const lost = () => socket.destroy();
  asked.on('upgrade', (answer, other, head) => {
    const lines = Object.entries(answer.headers).map(([name, value]) => `${name}: ${value}`);
    socket.write(`HTTP/1.1 101 Switching Protocols\r\n${lines.join('\r\n')}\r\n\r\n`);
    socket.write(head);
    other.pipe(socket).pipe(other);
    other.on('error', lost);
    other.on('close', lost);
    socket.on('close', () => other.destroy());
    socket.on('error', () => other.destroy());
  });
  asked.on('response', lost);
  asked.on('error', lost);
  socket.on('error', () => asked.destroy());
  asked.end();
});

server.listen(Number(options.port), options.host, () => {
  console.log(`listening on http://${options.host}:${server.address().port}`);
});
