/** Requests to the service of the twins. */
export class Api {
  /**
   * @param {string} url where the service is reached, absolute or below the page's origin
   * @param {string} [key] API key; not needed where a proxy adds it
   */
  constructor(url, key) {
    this.base = new URL(`${url.replace(/\/$/, '')}/`, document.baseURI);
    this.key = key;
  }

  /** Returns the answer to a GET; null where there is none yet (404 or 409). Throws with the service's own words. */
  async get(path, query = {}, signal = undefined) {
    const url = new URL(path, this.base);
    for (const [name, value] of Object.entries(query)) {
      if (value !== undefined && value !== null) {
        url.searchParams.set(name, value);
      }
    }
    const headers = this.key ? { Authorization: `Bearer ${this.key}` } : {};
    const response = await fetch(url, { headers, signal });
    if (response.status === 404 || response.status === 409) {
      return null;
    }
    const body = await response.json();
    if (!response.ok) {
      throw new Error(`thermal twin: ${response.status} ${body.detail ?? response.statusText}`);
    }
    return body;
  }

  /** Opens the stream of a twin; after a message's number the stream goes on behind it. */
  stream(twin, afterSeq) {
    const url = new URL(`v1/twins/${twin}/stream`, this.base);
    url.protocol = url.protocol.replace('http', 'ws');
    if (afterSeq !== null) {
      url.searchParams.set('after_seq', afterSeq);
    }
    return this.key ? new WebSocket(url, [`bearer.${this.key}`]) : new WebSocket(url);
  }
}
