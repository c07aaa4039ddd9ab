/** The live streams: one socket per twin, however many views listen; a broken one goes on behind its last message. */

const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 15_000;

export class Streams {
  constructor(api) {
    this.api = api;
    this.open = new Map();
  }

  /** Calls `hear` with every message of a twin; returns a function that ends it. */
  listen(twin, hear) {
    if (!this.open.has(twin)) {
      this.open.set(twin, new Stream(this.api, twin));
    }
    const stream = this.open.get(twin);
    stream.listeners.add(hear);
    return () => {
      stream.listeners.delete(hear);
      if (stream.listeners.size === 0) {
        stream.close();
        this.open.delete(twin);
      }
    };
  }
}

class Stream {
  constructor(api, twin) {
    Object.assign(this, { api, twin, seq: null, pauseMs: FIRST_PAUSE_MS, closed: false });
    this.listeners = new Set();
    this.connect();
  }

  connect() {
    this.socket = this.api.stream(this.twin, this.seq);
    this.socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      this.pauseMs = FIRST_PAUSE_MS;
      this.seq = message.seq;
      for (const hear of this.listeners) {
        hear(message);
      }
    };
    this.socket.onclose = () => {
      if (!this.closed) {
        this.timer = setTimeout(() => this.connect(), this.pauseMs);
        this.pauseMs = Math.min(2 * this.pauseMs, LONGEST_PAUSE_MS);
      }
    };
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    this.socket.close();
  }
}
