// Requests to the service. A refusal is an Error with its sentence and `status`.

let token = sessionStorage.getItem("topoloc token") ?? "";

export function setToken(text) {
  token = text;
  sessionStorage.setItem("topoloc token", text);
}

/** What a WebSocket is opened with: a browser cannot send headers with it, so the token is one of its subprotocols. */
export const subprotocols = () => ["topoloc", ...(token ? [`bearer.${token}`] : [])];

async function asked(path, { headers = {}, ...options } = {}) {
  let reply;
  const bearer = token ? { authorization: `Bearer ${token}` } : {};
  try {
    reply = await fetch(path, { ...options, headers: { accept: "application/json", ...headers, ...bearer } });
  } catch {
    throw Object.assign(new Error("The service does not answer."), { status: 0 });
  }
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

export const streamAddress = (map) => `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${addressOf(map)}/sessions`;
