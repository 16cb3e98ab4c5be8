// The page at `/`: a picture goes in, and where it was taken comes out, in words and in the scene.
import { AnswerList, linkTo, linkedAnswer } from "topoloc/page/answers";
import { askAbout, hasToken, mapNames, sceneOf, setToken } from "topoloc/page/asking";
import { drawMatches } from "topoloc/page/matches";
import { Notes } from "topoloc/page/notes";
import { LiveView } from "topoloc/page/view";
import { Viewer, pictureAddress } from "topoloc/apps/viewer";
import { isLocalized, sentences, verdict } from "topoloc/words";

const part = (id) => document.getElementById(id);
const state = { names: [], map: "", mapId: "", viewer: null, asked: null, shown: null };
const answers = new AnswerList(part("answers"), showEntry);
const MAX_NAMED = 20;

async function start() {
  try {
    state.names = await mapNames();
  } catch (error) {
    part("token-field").hidden = error.status !== 401;
    hint(error.status === 401 ? "The map is shown once the token is entered." : "The map is not shown.");
    if (error.status === 401 && !hasToken()) return part("token").focus();
    return tellFailure(error);
  }
  part("token-field").hidden = true;
  part("map").replaceChildren(...state.names.map((name) => new Option(name, name)));
  part("map-field").hidden = state.names.length < 2;
  await openMap();
}

/** The map that the address names, else the first one. */
const wantedMap = () => new URLSearchParams(location.search).get("map") ?? state.names[0];

const addressOfMap = (name) => `${location.pathname}?map=${encodeURIComponent(name)}`;

async function openMap() {
  const wanted = wantedMap();
  forgetPicture();
  part("answer").replaceChildren();
  state.viewer?.stage?.renderer.forceContextLoss(); // a browser lends a page few of them
  [state.viewer, state.asked] = [null, null];
  notes.follow("");
  state.map = state.names.includes(wanted) ? wanted : "";
  part("map").value = state.map;
  answers.show(state.map);
  document.title = `topoloc: ${state.map || "no map"}`;
  if (!state.map) {
    hint("No map is open.");
    return tellUnknownMap(wanted);
  }
  hint("Loading the map ...");
  try {
    const scene = await sceneOf(state.map);
    if (scene.name !== state.map) return;
    drawMap(scene);
    notes.follow(state.map);
    if (state.shown) state.viewer?.showLive(state.shown.result, drawnAs(state.shown));
    else if (!state.asked) showLinked();
  } catch (error) {
    if (state.map !== wanted) return;
    hint("The map is not shown.");
    tellFailure(error);
  }
}

function drawMap(scene) {
  state.viewer = new Viewer(part("scene"), scene);
  state.mapId = scene.map.id;
  live.setMap(state.viewer.points, scene.nodes, state.viewer.depth);
}

/** Show a map that grew or was edited, seen as before. */
async function redrawMap() {
  const { map } = state;
  const scene = await sceneOf(map).catch(() => null); // it is shown at its next change
  if (!scene || state.map !== map || !state.viewer) return;
  const view = state.viewer.stage?.view();
  state.viewer.stage?.renderer.forceContextLoss();
  drawMap(scene);
  if (view) state.viewer.stage?.goBack(view);
  state.viewer.showNotes(JSON.parse(notes.text));
  if (state.shown) state.viewer.showLive(state.shown.result, { ...drawnAs(state.shown), follow: false });
}

function hint(text) {
  part("scene").className = "";
  part("scene").replaceChildren(Object.assign(document.createElement("p"), { className: "hint", textContent: text }));
}

function tellUnknownMap(wanted) {
  const names = state.names.slice(0, MAX_NAMED);
  const links = names.flatMap((name) => [", ", Object.assign(document.createElement("a"), { href: addressOfMap(name), textContent: name })]);
  const more = state.names.length > names.length ? ` and ${state.names.length - names.length} more` : "";
  tell(names.length ? `No map "${wanted}". Maps here: ` : "This service has no maps.", [], "bad");
  part("answer").firstChild.append(...links.slice(1), more);
}

/** What was said of the picture before. */
function forgetPicture() {
  state.asked?.abort();
  state.shown = null;
  answers.mark(null);
  part("matches").hidden = part("why").hidden = true;
}

function camera() {
  const kind = document.querySelector("input[name=camera]:checked").value;
  return kind === "numbers" ? part("numbers").value.replaceAll(" ", "") : kind;
}

async function ask(file) {
  if (!state.map) return;
  endLive();
  forgetPicture();
  const { signal } = (state.asked = new AbortController());
  const { map } = state;
  part("answer").setAttribute("aria-live", "polite");
  tell("Localizing ...", []);
  part("answer").setAttribute("aria-busy", "true");
  try {
    const result = await askAbout(map, "localize", file, camera(), signal);
    const entry = { map, name: file.name || "image", picture: URL.createObjectURL(file), result };
    answers.add(entry);
    showEntry(entry);
    // Where the service is too busy for it, nothing is explained.
    entry.explained = await askAbout(map, "explain", file, camera(), signal).catch(() => null);
    if (state.shown === entry) await showExplained(entry);
  } catch (error) {
    if (error.name !== "AbortError" && !signal.aborted) tellFailure(error);
  } finally {
    if (!signal.aborted) part("answer").removeAttribute("aria-busy");
  }
}

/** How the scene shows an answer; what it says stands beside it. */
const drawnAs = ({ name, picture = null }) => ({ title: name, picture, quiet: true });

/** Show an answer of the list in words and in the scene. */
function showEntry(entry) {
  if (location.hash) history.replaceState(null, "", location.pathname + location.search);
  part("matches").hidden = part("why").hidden = true;
  state.shown = entry;
  tellResult(entry.result);
  if (isLocalized(entry.result)) offerLink(entry);
  answers.mark(entry);
  state.viewer?.showLive(entry.result, drawnAs(entry));
  if (entry.explained) showExplained(entry);
}

/** Show the answer that the address holds. */
function showLinked() {
  let linked;
  try {
    linked = linkedAnswer();
  } catch (error) {
    return tellFailure(error);
  }
  if (!linked) return;
  forgetPicture();
  const { result, name } = linked;
  const said = [verdict(result), ...sentences(result), "The link holds this pose. The service did not compute it now."];
  if (result.map !== state.mapId) said.push("The link is of another map of this name, so the pose may be wrong.");
  tell(`Linked answer: ${name}`, said, "good");
  state.shown = linked;
  state.viewer?.showLive(result, drawnAs(linked));
}

function offerLink(entry) {
  const button = Object.assign(document.createElement("button"), { type: "button", className: "plain", textContent: "Copy link" });
  button.addEventListener("click", async () => {
    history.replaceState(null, "", linkTo(entry));
    // Over plain HTTP a browser has no clipboard for pages of other machines.
    const copied = await navigator.clipboard?.writeText(location.href).then(() => true, () => false);
    button.textContent = copied ? "Link copied" : "The link is in the address bar";
  });
  part("answer").append(button);
}

/** Matches on both pictures, and what would help. */
async function showExplained(entry) {
  const { explained, picture } = entry;
  const [best] = explained?.compared ?? [];
  const node = best && state.viewer?.document.nodes.find((one) => one.id === best.node);
  if (node) {
    const nodePicture = node.picture && pictureAddress(node);
    const canvas = document.createElement("canvas");
    await drawMatches(canvas, picture, explained.picture_size, nodePicture, best);
    if (state.shown !== entry) return;
    const became = isLocalized(explained) ? "" : `, which is ${best.verdict}`;
    const caption = part("matches").querySelector("figcaption");
    caption.textContent = `Left the image, right node ${best.node}: ${best.num_inliers} matches agree on a pose${became}.`;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", caption.textContent);
    part("matches").replaceChildren(canvas, caption);
    part("matches").hidden = false;
  }
  if (!explained?.advice.length) return;
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

const live = new LiveView(part("view"), {
  said: (answer, track) => {
    part("answer").setAttribute("aria-live", "off"); // several a second: nobody could listen to them
    tellResult(answer);
    if (!part("scene").checkVisibility()) return;
    state.viewer?.showLive(answer, { title: "live", follow: false, quiet: true });
    state.viewer?.showTrack(track);
  },
  ended: () => part("live").focus(),
  failed: tellFailure,
  wanted: ask,
  written: (position) => notes.write(position),
  read: (note) => notes.read(note),
});
const notes = new Notes(part("notes"), part("note"), {
  changed: (all) => {
    live.setNotes(all);
    state.viewer?.showNotes(all);
  },
  grown: redrawMap,
  failed: (error) => (isLive() ? live.say(error.message, 4000, "bad") : tellFailure(error)),
});

const isLive = () => document.body.classList.contains("live");
const endLive = () => isLive() && live.close();

function listenForLive() {
  part("live").addEventListener("click", () => {
    if (!state.map) return;
    forgetPicture();
    live.open(state.map, camera()).catch(tellFailure);
  });
  const change = () => {
    endLive();
    openMap();
  };
  part("map").addEventListener("change", () => {
    history.pushState(null, "", addressOfMap(part("map").value));
    change();
  });
  addEventListener("popstate", () => {
    if (wantedMap() !== state.map) return change();
    showLinked();
  });
}

part("token-field").addEventListener("submit", (event) => {
  event.preventDefault();
  setToken(part("token").value.trim());
  start();
});
listenForPictures();
listenForCamera();
listenForLive();
start();
