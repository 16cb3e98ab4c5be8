// Run by tests/apps/service/test_js_client.py, which starts the service.
import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { test } from "node:test";
import { geoposeRequest, TopolocClient, TopolocError } from "../index.js";

const { TOPOLOC_URL, TOPOLOC_TOKEN, TOPOLOC_IMAGE, TOPOLOC_CAMERA } = process.env;
if (!TOPOLOC_URL) {
  console.error("these tests ask a service: run `pytest tests/apps/service/test_js_client.py`, or start one and set TOPOLOC_URL, TOPOLOC_TOKEN, TOPOLOC_IMAGE (a file) and TOPOLOC_CAMERA (JSON)");
  process.exit(1);
}
const client = new TopolocClient(`${TOPOLOC_URL}/`, { token: TOPOLOC_TOKEN });
const image = await readFile(TOPOLOC_IMAGE);
const camera = JSON.parse(TOPOLOC_CAMERA);
// a picture without any feature
const grey = Buffer.from(`P5\n64 48\n255\n${"z".repeat(64 * 48)}`);
const parts = (answer) => [answer.localized, answer.localized ? answer.world_from_cam.translation : answer.reason];

test("maps and their facts", async () => {
  assert.deepEqual(await client.maps(), ["earth"]);
  const facts = await client.map("earth");
  assert.equal(facts.name, "earth");
  assert.ok(facts.nodes.length > 1);
});

test("a scene and the notes of a map", async () => {
  const scene = await client.scene("earth");
  assert.ok(scene.nodes.length > 1);
  const id = await client.addNote("earth", " A door ", new Float32Array([0.5, 0, 2]));
  const note = (await client.notes("earth")).find((one) => one.id === id);
  assert.equal(note.text, "A door");
  assert.ok(note.position.every((metres, axis) => Math.abs(metres - [0.5, 0, 2][axis]) < 1e-9));
  await client.removeNote("earth", id);
  assert.equal((await client.notes("earth")).some((one) => one.id === id), false);
  await assert.rejects(client.removeNote("earth", id), { status: 404 });
  await assert.rejects(client.addNote("earth", "", [0, 0, 0]), { status: 422 });
});

test("an image is localized, given as Blob, bytes or buffer", async () => {
  const answers = [];
  for (const one of [image, new Blob([image], { type: "image/png" }), Uint8Array.from(image).buffer]) {
    answers.push(await client.localize("earth", one, { camera, name: "view", maxMs: 20_000 }));
  }
  for (const one of answers) {
    assert.equal(one.localized, true);
    assert.equal(one.query, "view");
    assert.deepEqual(parts(one), parts(answers[0]));
  }
  assert.ok(answers[0].probability > 0.5);
  const prior = answers[0].world_from_cam;
  assert.equal((await client.localize("earth", image, { camera, prior })).localized, true);
});

test("a refusal is a result with a reason", async () => {
  const answer = await client.localize("earth", grey, { camera: "unknown" });
  assert.deepEqual([answer.localized, answer.reason], [false, "too_few_matches"]);
  const all = await client.localizeEverywhere(image, { camera });
  assert.equal(all.map, "earth");
  assert.ok((await client.explain("earth", image, { camera })).picture_size);
});

test("by the GeoPose Protocol", async () => {
  const colmap = { model: "PINHOLE", modelParams: [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5] };
  const found = await client.geopose(image, { camera: colmap, size: [320, 240], id: "7", map: "earth" });
  assert.equal(found.localized, true);
  assert.equal(found.id, "7");
  assert.ok(Math.abs(found.geopose.position.lat - 50.87) < 0.01);
  const refused = await client.geopose(grey, { camera: colmap, geolocation: { latitude: 50.87, longitude: 4.7, accuracy: 5 } });
  assert.deepEqual([refused.localized, refused.reason], [false, "too_few_matches"]);
  assert.match(refused.detail, /not localized/);
  await assert.rejects(client.geopose(image, { map: "nowhere" }), { status: 404 });
  const request = await geoposeRequest(new Uint8Array(100_000).fill(255));
  assert.equal(Buffer.from(request.sensorReadings.cameraReadings[0].imageBytes, "base64").length, 100_000);
});

for (const transport of ["websocket", "http"]) {
  test(`a stream by ${transport}`, async () => {
    const stream = await client.stream("earth", { camera, transport });
    const t = 1_700_000_000_000_000_001n;
    const first = await stream.next(image, { tNs: t });
    assert.equal(first.state, "localized");
    assert.equal(BigInt(first.t_ns), BigInt(Number(t)));
    await assert.rejects(stream.next(Buffer.from("no picture"), { tNs: t + 10n }), /not a picture/);
    assert.equal((await stream.next(image, { tNs: t + 100_000_000n, camera })).localized, true);
    const both = await Promise.allSettled([stream.next(image), stream.next(image)]);
    const errors = both.filter((one) => one.status === "rejected");
    assert.ok(errors.every((one) => one.reason.status === 409));
    if (transport === "websocket") assert.equal(errors.length, 1);
    await stream.close();
    await assert.rejects(stream.next(image), TopolocError);
  });
}

test("errors have a status and the id of the request", async () => {
  await assert.rejects(client.map("nowhere"), (error) => {
    assert.ok(error instanceof TopolocError);
    assert.equal(error.status, 404);
    assert.match(error.message, /no map .nowhere./);
    assert.match(error.requestId, /^[0-9a-f]{32}$/);
    return true;
  });
  await assert.rejects(client.localize("earth", image, { camera: "0,0,1,1" }), { status: 422 });
  await assert.rejects(new TopolocClient(TOPOLOC_URL, { token: "wrong" }).maps(), { status: 401 });
  await assert.rejects(new TopolocClient("http://127.0.0.1:9").maps(), { status: 0, message: /no answer/ });
  await assert.rejects(client.stream("nowhere"), /is there such a map/);
  await assert.rejects(new TopolocClient(TOPOLOC_URL, { WebSocket: null }).stream("earth"), /WebSocket/);
});

test("a signal ends a call, a stream and the wait before a repeated request", async () => {
  const gone = { name: "AbortError" };
  await assert.rejects(client.localize("earth", image, { camera, signal: AbortSignal.abort() }), gone);
  const controller = new AbortController();
  const stream = await client.stream("earth", { camera, signal: controller.signal });
  const waiting = stream.next(image);
  controller.abort();
  await assert.rejects(waiting, gone);
  await assert.rejects(client.stream("earth", { signal: controller.signal }), gone);
});

test("a busy service is asked again after the delay that it names", async () => {
  const replies = [429, 429, 200];
  const real = globalThis.fetch;
  globalThis.fetch = async () => new Response('{"maps": ["a"]}', { status: replies.shift(), headers: { "retry-after": "0" } });
  try {
    assert.deepEqual(await client.maps(), ["a"]);
    assert.equal(replies.length, 0);
    globalThis.fetch = async () => new Response("{}", { status: 429, headers: { "retry-after": "9" } });
    const signal = AbortSignal.timeout(50);
    await assert.rejects(client.maps({ signal }), { name: "TimeoutError" });
    globalThis.fetch = async () => new Response("<html>", { status: 200 });
    await assert.rejects(client.maps(), /no answer of a topoloc service/);
  } finally {
    globalThis.fetch = real;
  }
});
