// Speaks to the service. The key, if one is needed, lives in this tab's session storage and travels in a header.
const KEY = "thermal-twin-key";
let askForKey = async () => "";

export const onKeyNeeded = (ask) => { askForKey = ask; };

export class ApiError extends Error {
  constructor(status, detail) { super(detail); this.status = status; }
}

const headers = (key = sessionStorage.getItem(KEY)) => {
  return key ? { Authorization: `Bearer ${key}` } : {};
};

export async function call(path, { method = "GET", body } = {}) {
  const key = sessionStorage.getItem(KEY);
  const response = await fetch(path, {
    method,
    headers: { ...headers(key), ...(body === undefined ? {} : { "Content-Type": "application/json" }) },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  if (response.status === 401) {
    sessionStorage.setItem(KEY, await askForKey(Boolean(key)));
    return call(path, { method, body });
  }
  if (!response.ok) {
    const problem = await response.json().catch(() => ({}));
    throw new ApiError(response.status, problem.detail || response.statusText);
  }
  const type = response.headers.get("content-type") || "";
  return type.includes("json") ? response.json() : response.text();
}

// Follows the event stream of a twin and calls back with each message; resumes where it broke off until aborted.
export async function follow(twin, signal, onMessage, onState) {
  let last = null;
  while (!signal.aborted) {
    try {
      const query = last === null ? "" : `?after_seq=${last}`;
      const response = await fetch(`v1/twins/${twin}/events${query}`, { headers: headers(), signal });
      if (!response.ok) throw new ApiError(response.status, response.statusText);
      onState("live");
      for await (const message of messages(response.body)) {
        last = message.seq;
        onMessage(message);
      }
    } catch (error) {
      if (signal.aborted) return;
    }
    onState("off");
    await new Promise((resolve) => setTimeout(resolve, 1500));
  }
}

async function* messages(stream) {
  const reader = stream.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    const parts = text.split("\n\n");
    text = parts.pop();
    for (const part of parts) {
      const line = part.split("\n").find((item) => item.startsWith("data: "));
      if (line) yield JSON.parse(line.slice(6));
    }
  }
}
