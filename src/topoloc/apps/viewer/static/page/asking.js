// Requests to the service. A refusal is an Error with its sentence and `status`.

let token = sessionStorage.getItem("topoloc token") ?? "";

export const hasToken = () => token !== "";

export function setToken(text) {
  token = text;
  sessionStorage.setItem("topoloc token", text);
}

/** Take the token of a link (`#token=...`) out of the address, where others may see it. Whether there was one. */
function takeToken() {
  const linked = new URLSearchParams(location.hash.slice(1)).get("token");
  if (!linked) return false;
  setToken(linked);
  history.replaceState(null, "", location.pathname + location.search);
  return true;
}

takeToken();
addEventListener("hashchange", () => takeToken() && location.reload());

async function asked(path, { headers = {}, ...options } = {}) {
  let reply;
  const bearer = token ? { authorization: `Bearer ${token}` } : {};
  try {
    reply = await fetch(path, { ...options, headers: { accept: "application/json", ...headers, ...bearer } });
  } catch {
    throw Object.assign(new Error("The service does not answer."), { status: 0 });
  }
  if (reply.status === 204) return null;
  if (reply.ok) return reply.json();
  const said = await reply.json().catch(() => ({}));
  const text = said.error ?? `The service answers with status ${reply.status}.`;
  throw Object.assign(new Error(text), { status: reply.status, retryAfterS: Number(reply.headers.get("retry-after")) || 0 });
}

const addressOf = (map) => `/v1/maps/${encodeURIComponent(map)}`;

export const mapNames = async () => (await asked("/v1/maps")).maps;
export const sceneOf = (map) => asked(`${addressOf(map)}/scene`);

/** Ask about a picture; `what` is localize or explain, `camera` as the service takes it. */
export function askAbout(map, what, picture, camera, signal) {
  const form = new FormData();
  form.append("image", picture, picture.name ?? "picture.jpg");
  form.append("camera", camera);
  return asked(`${addressOf(map)}/${what}`, { method: "POST", body: form, signal });
}

const SOCKET_MS = 8000; // until a WebSocket must be open
const nanoseconds = (ms) => `${BigInt(Math.round(1e3 * ms))}000`;

/** A stream over a WebSocket: `ask({file, time})` sends an image after the last answer, and gives its answer. */
export function openSocket(map, camera) {
  // A browser cannot send headers with it, so the token is one of its subprotocols.
  const protocols = ["topoloc", ...(token ? [`bearer.${encodeURIComponent(token)}`] : [])];
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}${addressOf(map)}/sessions`, protocols);
  let [resolve, reject] = [null, null];
  const next = () => new Promise((...both) => ([resolve, reject] = both));
  const over = (event) => reject(Object.assign(new Error(event.reason || "The stream has ended."), { isOver: true }));
  const link = {
    close: () => socket.close(1000),
    ask({ file, time }) {
      const answer = next();
      if (socket.readyState !== WebSocket.OPEN) over({});
      else [`{"t_ns": ${nanoseconds(time)}}`, file].forEach((one) => socket.send(one));
      return answer;
    },
  };
  const opened = next();
  const late = setTimeout(link.close, SOCKET_MS);
  socket.onopen = () => {
    clearTimeout(late);
    socket.send(JSON.stringify({ camera }));
    resolve(link);
  };
  socket.onmessage = (event) => {
    const answer = JSON.parse(event.data);
    if (answer.error) reject(new Error(answer.error));
    else resolve(answer);
  };
  socket.onclose = over;
  return opened;
}

/** The same stream by requests. */
export async function openRequests(map, camera) {
  const { session } = await asked(`${addressOf(map)}/sessions?camera=${encodeURIComponent(camera)}`, { method: "POST" });
  const path = `${addressOf(map)}/sessions/${session}`;
  const headers = { "content-type": "image/jpeg" };
  return {
    close: () => asked(path, { method: "DELETE", keepalive: true }).catch(() => {}),
    ask: ({ file, time }) => asked(`${path}/pictures?t_ns=${nanoseconds(time)}`, { method: "POST", body: file, headers }),
  };
}

export const notesOf = (map) => asked(`${addressOf(map)}/notes`);
export const removeNote = (map, id) => asked(`${addressOf(map)}/notes/${id}`, { method: "DELETE" });
export function addNote(map, text, position) {
  const headers = { "content-type": "application/json" };
  return asked(`${addressOf(map)}/notes`, { method: "POST", body: JSON.stringify({ text, position }), headers });
}
