// The page at `/`: a picture goes in, and where it was taken comes out, in words and in the scene.
import { askAbout, mapNames, sceneOf, setToken } from "topoloc/page/asking";
import { Live } from "topoloc/page/live";
import { drawMatches } from "topoloc/page/matches";
import { Viewer, pictureAddress } from "topoloc/apps/viewer";
import { isLocalized, sentences, verdict } from "topoloc/words";

const part = (id) => document.getElementById(id);
const state = { map: "", viewer: null, asked: null, picture: null, live: null };

async function start() {
  let names;
  try {
    names = await mapNames();
  } catch (error) {
    part("token-field").hidden = error.status !== 401;
    if (error.status === 401 && !part("token").value) return part("token").focus();
    return tellFailure(error);
  }
  part("token-field").hidden = true;
  part("map").replaceChildren(...names.map((name) => new Option(name, name)));
  part("map-field").hidden = names.length < 2;
  const wanted = new URLSearchParams(location.search).get("map");
  if (names.includes(wanted)) part("map").value = wanted;
  await openMap();
}

async function openMap() {
  state.map = part("map").value;
  part("answer").replaceChildren();
  forgetPicture();
  document.title = `topoloc: ${state.map}`;
  try {
    const scene = await sceneOf(state.map);
    if (scene.name === state.map) state.viewer = new Viewer(part("scene"), scene);
  } catch (error) {
    tellFailure(error);
  }
}

/** What was said of the picture before. */
function forgetPicture() {
  state.asked?.abort();
  if (state.picture) URL.revokeObjectURL(state.picture);
  state.picture = null;
  part("matches").hidden = part("why").hidden = true;
}

function camera() {
  const kind = document.querySelector("input[name=camera]:checked").value;
  return kind === "numbers" ? part("numbers").value.replaceAll(" ", "") : kind;
}

async function ask(file) {
  if (!state.map) return;
  forgetPicture();
  const { signal } = (state.asked = new AbortController());
  const picture = (state.picture = URL.createObjectURL(file));
  part("answer").setAttribute("aria-live", "polite");
  tell("Localizing ...", []);
  part("answer").setAttribute("aria-busy", "true");
  try {
    const result = await askAbout(state.map, "localize", file, camera(), signal);
    tellResult(result);
    state.viewer?.showLive(result, { title: file.name ?? "picture", picture, quiet: true });
    await explain(file, picture, signal);
  } catch (error) {
    if (error.name !== "AbortError" && !signal.aborted) tellFailure(error);
  } finally {
    if (!signal.aborted) part("answer").removeAttribute("aria-busy");
  }
}

/** Matches on both pictures, and what would help; where the service is too busy for it, nothing. */
async function explain(file, picture, signal) {
  const explained = await askAbout(state.map, "explain", file, camera(), signal).catch(() => null);
  if (!explained || signal.aborted) return;
  const [best] = explained.compared;
  const node = best && state.viewer?.document.nodes.find((one) => one.id === best.node);
  if (node) {
    const nodePicture = node.picture && pictureAddress(node);
    const [canvas, caption] = part("matches").children;
    await drawMatches(canvas, picture, explained.picture_size, nodePicture, best);
    const became = isLocalized(explained) ? "" : `, which is ${best.verdict}`;
    caption.textContent = `Left the image, right node ${best.node}: ${best.num_inliers} matches agree on a pose${became}.`;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", caption.textContent);
    if (signal.aborted) return;
    part("matches").hidden = false;
  }
  if (!explained.advice.length) return;
  const items = explained.advice.map((text) => Object.assign(document.createElement("li"), { textContent: text }));
  part("why").querySelector("ul").replaceChildren(...items);
  part("why").hidden = false;
}

function tell(title, said, kind = "") {
  const heading = Object.assign(document.createElement("h2"), { textContent: title, className: kind });
  part("answer").replaceChildren(heading, ...said.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
}

const tellResult = (result) => tell(verdict(result), sentences(result), isLocalized(result) ? "good" : "bad");

function tellFailure(error) {
  const later = error.retryAfterS ? [`Try again in ${error.retryAfterS} s.`] : [];
  tell(`${error.message[0].toUpperCase()}${error.message.slice(1)}`, later, "bad");
}

function listenForPictures() {
  const drop = part("drop");
  part("choose").addEventListener("click", () => part("file").click());
  part("file").addEventListener("change", () => {
    if (part("file").files[0]) ask(part("file").files[0]);
    part("file").value = "";
  });
  const isOver = (over) => (event) => {
    event.preventDefault();
    drop.classList.toggle("over", over);
  };
  document.addEventListener("dragover", isOver(true));
  document.addEventListener("dragleave", isOver(false));
  document.addEventListener("drop", (event) => {
    isOver(false)(event);
    if (event.dataTransfer.files[0]) ask(event.dataTransfer.files[0]);
  });
  document.addEventListener("paste", (event) => {
    const file = [...event.clipboardData.files][0];
    if (file) ask(file);
  });
}

function listenForCamera() {
  const words = { exif: "from the file", unknown: "unknown", map: "the map's", numbers: "fx, fy, cx, cy" };
  part("numbers").addEventListener("input", () => (document.querySelector("input[value=numbers]").checked = true));
  part("camera-field").addEventListener("input", () => {
    const said = camera();
    part("camera-said").textContent = words[said] ?? (said || words.numbers);
  });
}

function listenForWebcam() {
  const live = new Live(part("video"), {
    said: (answer, track) => {
      part("answer").setAttribute("aria-live", "off"); // several a second: nobody could listen to them
      tellResult(answer);
      state.viewer?.showLive(answer, { title: "live", follow: false, quiet: true });
      state.viewer?.showTrack(track);
    },
    failed: tellFailure,
    ended: () => press("live", false),
  });
  const press = (id, on) => part(id).setAttribute("aria-pressed", String(on));
  part("webcam").addEventListener("click", async () => {
    const on = await live.toggleWebcam().catch((error) => tellFailure(error));
    for (const id of ["video", "shoot", "live"]) part(id).hidden = !on;
    press("webcam", Boolean(on));
    part("webcam").textContent = on ? "Webcam off" : "Use the webcam";
  });
  part("shoot").addEventListener("click", async () => {
    press("live", false);
    live.stop();
    ask(await live.picture());
  });
  part("live").addEventListener("click", () => {
    forgetPicture();
    press("live", live.toggle(state.map, camera()));
  });
  part("map").addEventListener("change", () => {
    live.stop();
    press("live", false);
    openMap();
  });
}

part("token-field").addEventListener("submit", (event) => {
  event.preventDefault();
  setToken(part("token").value.trim());
  start();
});
listenForPictures();
listenForCamera();
listenForWebcam();
start();
