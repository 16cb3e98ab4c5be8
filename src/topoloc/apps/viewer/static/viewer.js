// The viewer: a scene document in an element of a page, with its layers, its list of pictures, and what is known of the one that is chosen.
import { Group } from "three";
import { matrixOf, numbersOf } from "topoloc/geometry";
import { Measure } from "topoloc/measure";
import * as objects from "topoloc/objects";
import { showScale } from "topoloc/overlay";
import { Plan } from "topoloc/plan";
import { Stage } from "topoloc/stage";
import { isLocalized, pointText, sentences, verdict } from "topoloc/words";

const PICK_PX = 22;
const MAX_PICTURES = 400;
const NOTES = "Notes";

export class Viewer {
  /** Show a document in `element`, which is emptied. */
  constructor(element, document_) {
    this.document = document_;
    element.classList.add("topoloc-scene");
    element.innerHTML = SHELL;
    element.viewer = this;
    this.part = (name) => element.querySelector(`[data-part="${name}"]`);
    this.places = []; // what can be chosen: {key, label, group, centre, matrix, show}
    this.depth = frustumDepth(document_);
    this.points = numbersOf(document_.points.world, Float32Array);
    try {
      const wheelZooms = element.classList.contains("whole");
      this.stage = new Stage(this.part("canvas"), { ...document_, wheelZooms }, (x, y) => this.pick(x, y));
    } catch {
      element.classList.add("flat");
      this.part("details").textContent = "This browser shows no 3-D: WebGL is missing or switched off. This is the plan from above.";
      this.plan = new Plan(this.part("canvas"), document_, this.points);
      return;
    }
    this.chosen = new Group();
    this.live = new Group();
    this.notes = new Group();
    this.stage.scene.add(this.chosen, this.live, this.notes);
    this.addMap();
    document_.results.forEach((set, n) => this.addResults(set, objects.setColour(n)));
    this.layer("axes", objects.axesOf(0.1 * this.stage.size()), "axes at the origin");
    const [button, said] = [this.part("measure"), this.part("measured")];
    this.measure = new Measure(this.stage, { cloud: this.cloud, places: this.places, button, said });
    showScale(this.stage, this.part("scale"), this.part("axes"));
    this.fillList();
    this.listen();
    this.tellSummary();
  }

  addMap() {
    const { points, nodes, paths, map } = this.document;
    this.cloud = objects.cloudOf(this.points, points.rgb, 2);
    this.layer("points", this.cloud, "points");
    const cameras = nodes.map((node) => ({ matrix: matrixOf(node.world_from_cam), camera: node.camera }));
    const frustums = objects.frustumsOf(cameras, this.depth, objects.COLOURS.node, { opacity: 0.6 });
    this.layer("nodes", frustums, `${nodes.length} nodes`, objects.COLOURS.node);
    nodes.forEach((node, i) => this.places.push(this.nodePlace(node, cameras[i].matrix)));
    this.addJunctions(this.document.junctions ?? []);
    if (nodes.some((node) => node.picture)) this.layer("pictures", null, "their images");
    paths.forEach((path, n) => {
      const ofMap = path.session !== undefined;
      const colour = ofMap && paths.length === 1 ? objects.COLOURS.path : objects.setColour(n + this.document.results.length);
      const label = `${ofMap ? "trajectory of" : "trajectory"} ${path.name}`;
      this.layer(`path ${n}`, objects.linesOf(path.lines, colour), label, colour);
    });
  }

  /** Mark the places where walks branch or cross, if there are any. */
  addJunctions(junctions) {
    if (!junctions.length) return;
    const { junction } = objects.COLOURS;
    const counted = `${junctions.length} junction${junctions.length === 1 ? "" : "s"}`;
    this.layer("junctions", objects.marksOf(junctions.map((one) => one.position), junction), counted, junction);
    for (const { node, tile, position, ways } of junctions) {
      const label = `junction at node ${node}${tile === undefined ? "" : ` of ${tile}`}`;
      const show = () => this.tell(`J${label.slice(1)}`, [`At ${pointText(position)}.`, `${ways} directions lead away.`]);
      this.places.push({ key: label, label, group: "Junctions", centre: position, show });
    }
  }

  nodePlace(node, matrix) {
    const called = node.tile === undefined ? `${node.id}` : `${node.id} of ${node.tile}`;
    const show = () => {
      this.chosen.add(objects.frustumsOf([{ matrix, camera: node.camera }], this.depth, objects.COLOURS.selected));
      if (node.picture) this.addPicture(this.chosen, pictureAddress(node), matrix, node.camera);
      const session = this.document.map.sessions.find((one) => one.id === node.session);
      const said = [`At ${pointText(node.world_from_cam.translation)}.`, `${node.num_points} points.`];
      if (session) said.push(`Session ${session.name}${session.date ? `, ${session.date.slice(0, 10)}` : ""}.`);
      const picture = node.picture && { address: pictureAddress(node), words: `image of node ${called}` };
      this.tell(`Node ${called}: ${node.name}`, said, picture);
    };
    const centre = node.world_from_cam.translation;
    const group = node.tile === undefined ? "Nodes of the map" : `Nodes of ${node.tile}`;
    return { key: `node ${called}`, label: `${node.id}: ${node.name}`, group, centre, matrix, show };
  }

  addResults(set, colour) {
    const group = new Group();
    const localized = set.answers.filter(isLocalized);
    const found = localized.map((one) => ({ matrix: matrixOf(one.world_from_cam), camera: one.camera }));
    group.add(objects.frustumsOf(found, this.depth * 1.2, colour));
    const withTruth = set.answers.filter((one) => one.true_world_from_cam);
    const missed = withTruth.filter((one) => !isLocalized(one));
    const atTruth = missed.map((one) => ({ matrix: matrixOf(one.true_world_from_cam), camera: one.camera }));
    group.add(objects.frustumsOf(atTruth, this.depth * 1.2, objects.COLOURS.bad, { dashed: true }));
    const judged = withTruth.filter(isLocalized);
    const errors = judged.map((one) => [one.world_from_cam.translation, one.true_world_from_cam.translation]);
    group.add(objects.segmentsOf(errors, objects.COLOURS.error));
    group.add(objects.linesOf(trackOf(set.answers), colour));
    this.layer(`results ${set.name}`, group, `${set.name}: ${localized.length} of ${set.answers.length} localized`, colour);
    set.answers.forEach((answer, i) => {
      const place = objects.placeOf(answer);
      const show = () => this.showAnswer(answer, { title: answer.query, colour });
      const label = `${answer.query}${isLocalized(answer) ? "" : " (not localized)"}`;
      this.places.push({ key: `answer ${set.name} ${i}`, label, group: set.name, ...place, show });
    });
  }

  /** Draw one answer in full, and say it in words. `picture` is the address of the picture itself, where it is at hand. */
  showAnswer(answer, { title, colour = objects.COLOURS.selected, picture = null, quiet = false }) {
    const depth = this.depth * 1.2;
    this.chosen.add(objects.answerOf(answer, depth, colour));
    const place = objects.placeOf(answer);
    if (picture && place) this.addPicture(this.chosen, picture, place.matrix, answer.camera, depth);
    if (!quiet) this.tell(title, [verdict(answer), ...sentences(answer)]);
    this.stage.draw();
  }

  /** Show another result, such as a live one, instead of the selected one. */
  showLive(answer, options) {
    if (this.plan) return this.plan.show({ answer });
    this.clearChosen();
    this.part("list").value = "";
    this.showAnswer(answer, options);
    const place = objects.placeOf(answer);
    if (place && options.follow !== false) this.travel(place);
  }

  /** The trajectory of a live stream: positions [[x, y, z], ...] in lines. */
  showTrack(lines) {
    if (this.plan) return this.plan.show({ track: lines });
    objects.dispose(this.live);
    this.live.clear();
    this.live.add(objects.linesOf(lines, objects.COLOURS.selected));
    this.stage.draw();
  }

  /** Notes {id, text, position} at places of the map, instead of those before. */
  showNotes(notes) {
    if (this.plan) return this.plan.show({ notes });
    objects.dispose(this.notes);
    this.notes.clear();
    if (notes.length) this.notes.add(objects.marksOf(notes.map((note) => note.position), objects.COLOURS.note));
    const others = this.places.filter((place) => place.group !== NOTES);
    const places = notes.map((note) => {
      const show = () => this.tell("Note", [note.text, `At ${pointText(note.position)}.`]);
      return { key: `note ${note.id}`, label: note.text.slice(0, 60), group: NOTES, centre: note.position, show };
    });
    this.places.splice(0, this.places.length, ...others, ...places); // the measure holds the list
    this.fillList();
    this.stage.draw();
  }

  addPicture(group, address, matrix, camera, depth = this.depth) {
    group.add(objects.pictureOf(address, matrix, camera, depth, () => this.stage.draw()));
  }

  layer(key, object, label, colour = "") {
    if (object) this.stage.scene.add(object);
    const row = document.createElement("label");
    const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: object !== null, value: key });
    const mark = Object.assign(document.createElement("i"), { ariaHidden: "true" });
    if (colour) mark.style.background = colour;
    row.append(box, mark, label);
    this.part("layers").append(row);
    box.addEventListener("change", () => {
      if (key === "pictures") object ??= this.allPictures();
      object.visible = box.checked;
      this.stage.draw();
    });
  }

  allPictures() {
    const group = new Group();
    const shown = this.document.nodes.filter((node) => node.picture);
    const step = Math.ceil(shown.length / MAX_PICTURES);
    for (const node of shown.filter((_, i) => i % step === 0)) {
      this.addPicture(group, pictureAddress(node), matrixOf(node.world_from_cam), node.camera);
    }
    this.stage.scene.add(group);
    return group;
  }

  fillList() {
    const list = this.part("list");
    const { value } = list;
    list.querySelectorAll("optgroup").forEach((group) => group.remove());
    const groups = [...new Set(this.places.map((place) => place.group))].reverse();
    for (const name of groups) {
      const group = Object.assign(document.createElement("optgroup"), { label: name });
      for (const place of this.places.filter((one) => one.group === name)) group.append(new Option(place.label, place.key));
      list.append(group);
    }
    list.value = this.places.some((place) => place.key === value) ? value : "";
  }

  listen() {
    const list = this.part("list");
    list.addEventListener("change", () => this.choose(list.value, true));
    this.part("next").addEventListener("click", () => this.step(1));
    this.part("before").addEventListener("click", () => this.step(-1));
    this.part("home").addEventListener("click", () => this.stage.overview());
    this.part("above").addEventListener("click", () => this.stage.overview(true));
    this.part("nearer").addEventListener("click", () => this.stage.zoom(0.75));
    this.part("further").addEventListener("click", () => this.stage.zoom(1 / 0.75));
    this.part("canvas").addEventListener("keydown", (event) => {
      if (event.key === "n" || event.key === "p") this.step(event.key === "n" ? 1 : -1);
      if (event.key === "Escape") this.measure.toggle(false);
    });
  }

  step(by) {
    const keys = [...this.part("list").options].map((option) => option.value).filter(Boolean);
    if (!keys.length) return;
    const now = keys.indexOf(this.part("list").value);
    this.choose(keys[(now + by + keys.length + (now < 0 && by < 0 ? 1 : 0)) % keys.length], true);
  }

  choose(key, travel) {
    const place = this.places.find((one) => one.key === key);
    this.clearChosen();
    this.part("list").value = place ? key : "";
    if (!place) return this.tellSummary();
    place.show();
    if (travel && place.matrix) this.travel(place);
    this.stage.draw();
  }

  travel({ matrix, radius = 0 }) {
    this.stage.goTo(matrix, Math.max(this.depth * 12, 0.25 * this.stage.size(), 2.5 * radius));
  }

  clearChosen() {
    objects.dispose(this.chosen);
    this.chosen.clear();
    this.stage.draw();
  }

  pick(x, y) {
    if (this.measure.isOn) return this.measure.click(x, y);
    const near = this.places.map((place) => ({ place, seen: place.centre && this.stage.seen(place.centre) })).filter(({ seen }) => seen);
    const ranked = near.map(({ place, seen }) => ({ place, px: Math.hypot(seen[0] - x, seen[1] - y) })).filter(({ px }) => px < PICK_PX);
    ranked.sort((a, b) => a.px - b.px);
    this.choose(ranked[0]?.place.key ?? "", false);
  }

  tellSummary() {
    const { name, map } = this.document;
    const said = [`${map.num_nodes} nodes, ${map.num_points.toLocaleString("en")} points, ${map.length_m.toFixed(0)} ${map.scale ? "units" : "m"} mapped.`];
    if (map.certificate) {
      const outdated = map.certificate.is_outdated ? " (outdated: the map was edited since)" : "";
      said.push(`Certified: ${map.certificate.promise}${outdated}.`);
      said.push(`Threshold: ${map.certificate.threshold}.`);
      for (const promise of map.certificate.group_promises) said.push(`${promise[0].toUpperCase()}${promise.slice(1)}.`);
      const hardest = map.certificate.quarters.filter((one, row, all) => one.by !== all[row - 1]?.by);
      for (const one of hardest) said.push(`Hardest quarter by ${one.by}: ${one.num_right} of ${one.num_poses} right, ${one.num_inside} inside their 95 % ellipsoid.`);
    }
    if (map.num_points_shown < 0.99 * map.num_points) said.push(`${map.num_points_shown.toLocaleString("en")} of the points are shown.`);
    if (map.sessions.length > 1) said.push(`Sessions: ${map.sessions.map((one) => one.name).join(", ")}.`);
    this.tell(name, said);
  }

  tell(title, said, picture = null) {
    const details = this.part("details");
    const heading = Object.assign(document.createElement("h3"), { textContent: title });
    details.replaceChildren(heading, ...said.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
    if (picture) heading.after(Object.assign(new Image(), { src: picture.address, alt: picture.words }));
  }
}

/** The address of a node's picture: WebP begins with RIFF, here in base64; others are JPEG. */
export const pictureAddress = ({ picture }) => `data:image/${picture.startsWith("UklG") ? "webp" : "jpeg"};base64,${picture}`;

/** The trajectory of a stream; results without a state are no stream. */
function trackOf(answers) {
  const lines = [[]];
  for (const one of answers.filter((answer) => answer.state)) {
    if (one.smoothed) lines.at(-1).push(one.smoothed.translation);
    else lines.push([]);
  }
  return lines;
}

/** How deep a camera is drawn, metres: about half a step from node to node. */
function frustumDepth({ nodes, focus }) {
  const centres = nodes.map((node) => node.world_from_cam.translation);
  const steps = centres.slice(1).map((centre, i) => Math.hypot(...centre.map((value, k) => value - centres[i][k]))).sort((a, b) => a - b);
  const size = Math.hypot(...focus[1].map((value, k) => value - focus[0][k]));
  const step = steps.length ? steps[steps.length >> 1] : size / 20;
  return Math.min(Math.max(0.5 * step, 0.01 * size), 0.04 * size) || 0.1;
}

const SHELL = `
<div class="stage">
  <canvas data-part="canvas" tabindex="0" aria-label="The map in 3-D. Arrow keys turn, shift and arrow keys move, plus and minus zoom,
    Home shows all, n and p go through the pictures."></canvas>
  <div class="tools" role="group" aria-label="View">
    <button type="button" data-part="home" title="Show all (Home)">All</button>
    <button type="button" data-part="above" title="Seen from above">Above</button>
    <button type="button" data-part="nearer" title="Nearer (+)" aria-label="Nearer">+</button>
    <button type="button" data-part="further" title="Further (-)" aria-label="Further">&minus;</button>
    <button type="button" data-part="measure" aria-pressed="false" title="Distance of two points (Escape ends)">Measure</button>
  </div>
  <p class="measured" data-part="measured" role="status" hidden></p>
  <div class="scale" data-part="scale" title="Length in the middle of the view"></div>
  <svg class="axes" data-part="axes" viewBox="-40 -40 80 80" role="img" aria-label="Directions of the axes x, y and z"></svg>
</div>
<div class="side">
  <div class="chooser">
    <label>Go to <select data-part="list"><option value="">the whole map</option></select></label>
    <button type="button" data-part="before" aria-label="Previous">&lsaquo;</button>
    <button type="button" data-part="next" aria-label="Next">&rsaquo;</button>
  </div>
  <div class="details" data-part="details" aria-live="polite"></div>
  <fieldset data-part="layers"><legend>Shown</legend></fieldset>
</div>`;

/** Show every scene that the page holds: an element with data-scene, the id of a script element with the document. */
export function showAll() {
  for (const element of document.querySelectorAll("[data-scene]")) {
    new Viewer(element, JSON.parse(document.getElementById(element.dataset.scene).textContent));
  }
}
