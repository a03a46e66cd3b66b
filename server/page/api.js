// What the page asks of the service. Every refusal is one sentence.

const BASE = "api/v1";
const KEY = "gamesr-api-key";
const MOST_PATIENCE_S = 180; // for a picture that is being computed
const STEP_S = 1;
const TERMINAL = ["done", "failed", "cancelled"];

/** What the service refused, in its own sentence; `status` is 0 where it did not answer. */
export class Refusal extends Error {
  constructor(sentence, status) {
    super(sentence);
    this.status = status;
  }
}

/** The key goes with everything that changes something; it is forgotten with the tab. */
export function keepKey(key) {
  sessionStorage.setItem(KEY, key);
}

export async function get(path) {
  return (await answer(path)).json();
}

export async function post(path, body) {
  const headers = body === undefined ? keyHeader() : { ...keyHeader(), "Content-Type": "application/json" };
  return (await answer(path, { method: "POST", headers, body: JSON.stringify(body) })).json();
}

/** Sends a file as it is; `onShare` is told how much of it is there, 0 to 1. Resolves to the clip. */
export function upload(file, onShare) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest(); // fetch does not tell how far an upload is
    request.open("POST", `${BASE}/clips?title=${encodeURIComponent(file.name)}`);
    for (const [name, value] of Object.entries(keyHeader())) request.setRequestHeader(name, value);
    request.setRequestHeader("Content-Type", file.type || "application/octet-stream");
    request.upload.addEventListener("progress", (event) => onShare(event.loaded / event.total));
    request.addEventListener("load", () => {
      const body = parsed(request.responseText);
      if (request.status === 201) resolve(body);
      else reject(new Refusal(body?.detail ?? `The service answered ${request.status}.`, request.status));
    });
    request.addEventListener("error", () => reject(new Refusal("The upload broke off: the service is not reached.", 0)));
    request.send(file);
  });
}

/** Tells `onProgress` of every change of a sweep until it is over; returns what stops that. */
export function follow(id, onProgress) {
  const source = new EventSource(`${BASE}/sweeps/${encodeURIComponent(id)}/events`);
  source.addEventListener("progress", (event) => {
    const progress = JSON.parse(event.data);
    if (isOver(progress)) source.close();
    onProgress(progress);
  });
  return () => source.close();
}

export function isOver(progress) {
  return TERMINAL.includes(progress.state);
}

/** The address of a picture, once the service has it; `signal` ends the waiting. */
export async function picture(path, signal) {
  for (let waited = 0; waited < MOST_PATIENCE_S; ) {
    const response = await answer(path, { signal });
    if (response.status !== 202) {
      await response.blob(); // whole in the cache: the element that shows it does not ask again
      return `${BASE}/${path}`;
    }
    const pause = Number(response.headers.get("Retry-After")) || STEP_S;
    await new Promise((resolve) => setTimeout(resolve, 1000 * pause));
    waited += pause;
  }
  throw new Refusal("The picture did not come in three minutes.", 0);
}

async function answer(path, options) {
  let response;
  try {
    response = await fetch(`${BASE}/${path}`, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refusal("The service is not reached: is it running?", 0);
  }
  if (response.ok) return response;
  const body = parsed(await response.text());
  throw new Refusal(body?.detail ?? `The service answered ${response.status}.`, response.status);
}

function keyHeader() {
  const key = sessionStorage.getItem(KEY);
  return key ? { "X-API-Key": key } : {};
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null; // a proxy in between may answer something else
  }
}
