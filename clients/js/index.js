// Ask a topoloc service from a browser or from Node. The types are in index.d.ts.

const MAX_TRIES = 5;
const MAX_WAIT_S = 10;
const GEOPOSE_TYPE = "application/vnd.oscp+json;version=2.0;";

/** A refusal of the service, or its silence. `status` is 0 where there was no response. */
export class TopolocError extends Error {
  constructor(message, { status = 0, requestId = null, cause } = {}) {
    super(message, { cause });
    this.name = "TopolocError";
    this.status = status;
    this.requestId = requestId;
  }
}

export class TopolocClient {
  #url;
  #token;
  #timeoutMs;
  #WebSocket;

  constructor(url, { token = null, timeoutMs = 60_000, WebSocket = globalThis.WebSocket } = {}) {
    this.#url = String(url).replace(/\/+$/, "");
    this.#token = token;
    this.#timeoutMs = timeoutMs;
    this.#WebSocket = WebSocket;
  }

  async maps({ signal } = {}) {
    return (await this.#json("/v1/maps", {}, signal)).maps;
  }

  map(name, { signal } = {}) {
    return this.#json(mapPath(name), {}, signal);
  }

  localize(map, image, { signal, ...fields } = {}) {
    return this.#post(`${mapPath(map)}/localize`, image, fields, signal);
  }

  localizeEverywhere(image, { signal, ...fields } = {}) {
    return this.#post("/v1/localize", image, fields, signal);
  }

  explain(map, image, { signal, ...fields } = {}) {
    return this.#post(`${mapPath(map)}/explain`, image, fields, signal);
  }

  scene(map, { signal } = {}) {
    return this.#json(`${mapPath(map)}/scene`, {}, signal);
  }

  async notes(map, { signal } = {}) {
    return (await this.#json(`${mapPath(map)}/notes`, {}, signal)).notes;
  }

  async addNote(map, text, position, { signal } = {}) {
    const headers = { "content-type": "application/json" };
    const body = JSON.stringify({ text, position: [...position] });
    return (await this.#json(`${mapPath(map)}/notes`, { method: "POST", body, headers }, signal)).id;
  }

  async removeNote(map, id, { signal } = {}) {
    await this.#json(`${mapPath(map)}/notes/${encodeURIComponent(id)}`, { method: "DELETE" }, signal);
  }

  async geopose(image, { map, signal, ...facts } = {}) {
    const body = JSON.stringify(await geoposeRequest(image, facts));
    const headers = { "content-type": "application/json", accept: GEOPOSE_TYPE };
    const path = `/localize/geopose${map === undefined ? "" : `?map=${encodeURIComponent(map)}`}`;
    const { response, data } = await this.#send(path, { method: "POST", body, headers }, signal);
    if (response.ok) return { localized: true, ...data };
    if (response.status !== 404 || !data.reason) throw refusal(response, data);
    return { localized: false, reason: data.reason, detail: data.ERROR, requestId: data.request_id };
  }

  async stream(map, { camera, signal, transport = "websocket" } = {}) {
    const query = camera === undefined ? "" : `?camera=${encodeURIComponent(cameraText(camera))}`;
    const path = `${mapPath(map)}/sessions`;
    if (transport === "websocket") return this.#open(path + query, signal);
    const { session } = await this.#json(path + query, { method: "POST" }, signal);
    return {
      next: (image, { tNs, ...fields } = {}) => {
        const time = tNs === undefined ? "" : `?t_ns=${BigInt(tNs)}`;
        return this.#post(`${path}/${session}/pictures${time}`, image, fields, signal);
      },
      close: async () => {
        await this.#json(`${path}/${session}`, { method: "DELETE" });
      },
    };
  }

  async #open(path, signal) {
    signal?.throwIfAborted();
    if (!this.#WebSocket) throw new TopolocError("no WebSocket here: give one as the option `WebSocket`");
    const url = new URL(this.#url + path, globalThis.location?.href);
    url.protocol = url.protocol.replace("http", "ws");
    const bearer = this.#token === null ? [] : [`bearer.${quoted(this.#token)}`];
    return SocketStream.open(new this.#WebSocket(url.href, ["topoloc", ...bearer]), signal);
  }

  async #post(path, image, fields, signal) {
    const form = new FormData();
    form.append("image", toBlob(image), fields.name ?? "image");
    for (const [key, value] of Object.entries(fieldTexts(fields))) form.append(key, value);
    return this.#json(path, { method: "POST", body: form }, signal);
  }

  async #json(path, options, signal) {
    const { response, data } = await this.#send(path, options, signal);
    if (!response.ok) throw refusal(response, data);
    return data;
  }

  /** Send a request, and again where the service names a delay. */
  async #send(path, options, signal) {
    const bearer = this.#token === null ? {} : { authorization: `Bearer ${this.#token}` };
    const headers = { accept: "application/json", ...options.headers, ...bearer };
    for (let attempt = 1; ; attempt++) {
      const timeout = AbortSignal.timeout(this.#timeoutMs);
      const limits = AbortSignal.any(signal ? [signal, timeout] : [timeout]);
      let response, text;
      try {
        response = await fetch(this.#url + path, { ...options, headers, signal: limits });
        text = await response.text();
      } catch (cause) {
        signal?.throwIfAborted();
        const why = timeout.aborted ? `within ${this.#timeoutMs / 1e3} s` : `(${cause.cause?.message || cause.message})`;
        throw new TopolocError(`${this.#url}: no answer ${why}`, { cause });
      }
      if (response.status === 429 && attempt < MAX_TRIES) {
        const named = Number(response.headers.get("retry-after") ?? 1);
        await wait(1e3 * Math.min(Number.isFinite(named) ? named : 1, MAX_WAIT_S), signal);
        continue;
      }
      return { response, data: parsed(response, text) };
    }
  }
}

/** A stream over a WebSocket: one image at a time. */
class SocketStream {
  #socket;
  #pending = null;
  #end = null;
  #closed;

  static open(socket, signal) {
    return new Promise((resolve, reject) => {
      const stream = new SocketStream(socket, signal, reject);
      socket.onopen = () => resolve(stream);
      signal?.addEventListener("abort", () => socket.close(), { once: true });
    });
  }

  constructor(socket, signal, reject) {
    this.#socket = socket;
    socket.onmessage = ({ data }) => {
      const answer = JSON.parse(data);
      if ("localized" in answer) this.#settle("resolve", answer);
      else this.#settle("reject", new TopolocError(answer.error));
    };
    this.#closed = new Promise((resolve) => {
      const end = ({ code = 1006, reason = "" }) => {
        const text = reason || `the stream ended with code ${code}, or never began: is there such a map, is the token right and the origin allowed?`;
        this.#end ??= signal?.aborted ? signal.reason : new TopolocError(text);
        this.#settle("reject", this.#end);
        reject(this.#end);
        resolve();
      };
      socket.onclose = end;
      socket.onerror = end; // after a refused handshake Node 20 has no event `close`
    });
  }

  next(image, { tNs, camera } = {}) {
    if (this.#end) return Promise.reject(this.#end);
    if (this.#pending) return Promise.reject(new TopolocError("the previous image is in progress; send the next one after it", { status: 409 }));
    const values = [
      ...(tNs === undefined ? [] : [`"t_ns": ${BigInt(tNs)}`]),
      ...(camera === undefined ? [] : [`"camera": ${JSON.stringify(camera)}`]),
    ];
    return new Promise((resolve, reject) => {
      this.#pending = { resolve, reject };
      if (values.length) this.#socket.send(`{${values.join()}}`);
      this.#socket.send(image);
    });
  }

  close() {
    this.#socket.close();
    return this.#closed;
  }

  #settle(how, value) {
    const pending = this.#pending;
    this.#pending = null;
    pending?.[how](value);
  }
}

/** Write an image as a request of the GeoPose Protocol, version 2. */
export async function geoposeRequest(image, { camera, size, geolocation, id = crypto.randomUUID(), timestamp = Date.now() } = {}) {
  const nothing = { dataRetention: [], dataAcceptableUse: [], dataSanitizationApplied: [], dataSanitizationRequested: [] };
  const reading = (sensorId) => ({ timestamp, sensorId, privacy: nothing });
  const imageBytes = toBase64(new Uint8Array(await toBlob(image).arrayBuffer()));
  const picture = { ...reading("camera"), sequenceNumber: 0, imageFormat: "JPG", imageBytes };
  if (size) picture.size = size;
  if (camera) picture.params = camera;
  const sensors = [{ id: "camera", type: "camera" }];
  const sensorReadings = { cameraReadings: [picture] };
  if (geolocation) {
    const { latitude, longitude, altitude, accuracy, altitudeAccuracy, heading, speed } = geolocation;
    const place = { latitude, longitude, altitude, accuracy, altitudeAccuracy, heading, speed };
    sensors.push({ id: "geolocation", type: "geolocation" });
    sensorReadings.geolocationReadings = [{ ...reading("geolocation"), ...place }];
  }
  return { id, timestamp, type: "geopose", sensors, sensorReadings };
}

const mapPath = (name) => `/v1/maps/${encodeURIComponent(name)}`;

const toBlob = (image) => (image instanceof Blob ? image : new Blob([image]));

const cameraText = (camera) => (typeof camera === "string" ? camera : JSON.stringify(camera));

/** The signs that encodeURIComponent leaves and a subprotocol may not have are parentheses. */
const quoted = (token) => encodeURIComponent(token).replace(/[()]/g, (sign) => `%${sign.charCodeAt(0).toString(16)}`);

function fieldTexts({ camera, prior, near, maxMs, name }) {
  const texts = {
    camera: camera && cameraText(camera),
    prior: prior && JSON.stringify(prior),
    near: near && `${near.latitude},${near.longitude},${near.radiusM}`,
    max_ms: maxMs && String(maxMs),
    name,
  };
  return Object.fromEntries(Object.entries(texts).filter(([, text]) => text !== undefined));
}

function toBase64(bytes) {
  let text = "";
  for (let start = 0; start < bytes.length; start += 32_768) text += String.fromCharCode(...bytes.subarray(start, start + 32_768));
  return btoa(text);
}

function parsed(response, text) {
  if (response.status === 204) return null;
  try {
    return JSON.parse(text);
  } catch (cause) {
    throw new TopolocError(`${response.url}: no answer of a topoloc service`, { status: response.status, cause });
  }
}

function refusal(response, data) {
  const text = data?.error ?? data?.ERROR ?? "refused";
  return new TopolocError(`${text} (status ${response.status})`, { status: response.status, requestId: data?.request_id ?? null });
}

function wait(ms, signal) {
  return new Promise((resolve, reject) => {
    const end = () => (clearTimeout(timer), reject(signal.reason));
    const timer = setTimeout(() => (signal?.removeEventListener("abort", end), resolve()), ms);
    if (signal?.aborted) end();
    signal?.addEventListener("abort", end, { once: true });
  });
}
