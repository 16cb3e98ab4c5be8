// The answers of this page: a list, files to save, and links that hold a pose themselves.
import { isLocalized, lengthText } from "topoloc/words";

const TUM_HEADER = "# answers of a topoloc map, no ground truth\n# t tx ty tz qx qy qz qw (s, m; world_from_cam)\n";

/** Answers of the selected map, newest first. An entry is {map, name, picture, result}. */
export class AnswerList {
  /** `section` holds the list and its buttons; `onChoose(entry)` is told of clicks. */
  constructor(section, onChoose) {
    [this.section, this.list, this.onChoose, this.entries, this.map] = [section, section.querySelector("ol"), onChoose, [], ""];
    const [json, tum] = (this.buttons = section.querySelectorAll("button.plain"));
    json.addEventListener("click", () => this.save("jsonl", this.shown().map((one) => `${JSON.stringify(one.result)}\n`).join("")));
    tum.addEventListener("click", () => this.save("tum", TUM_HEADER + this.shown().map(tumLine).join("")));
  }

  shown() {
    return this.entries.filter((entry) => entry.map === this.map);
  }

  add(entry) {
    this.entries.push(entry);
    if (entry.map === this.map) this.show(this.map);
  }

  /** List the answers of this map. */
  show(map) {
    this.map = map;
    const entries = this.shown();
    this.section.hidden = !entries.length;
    this.buttons[1].disabled = !entries.some((entry) => isLocalized(entry.result));
    this.list.replaceChildren(...entries.map((entry) => this.row(entry)).reverse());
  }

  /** Mark the answer that is shown, null for none. */
  mark(entry) {
    const rows = [...this.list.children].reverse();
    this.shown().forEach((one, i) => rows[i].firstChild.setAttribute("aria-current", String(one === entry)));
  }

  row(entry) {
    const { result, name } = entry;
    const [item, button] = ["li", "button"].map((kind) => document.createElement(kind));
    const sigmas = () => `σ ${lengthText(result.position_sigma_m)}, ${result.rotation_sigma_deg.toFixed(2)}°`;
    const outcome = isLocalized(result) ? `localized, p ${result.probability.toFixed(2)}, ${sigmas()}` : result.reason.replaceAll("_", " ");
    button.append(...[name, outcome].map((textContent) => Object.assign(document.createElement("span"), { textContent })));
    button.type = "button";
    button.classList.add(isLocalized(result) ? "good" : "bad");
    button.addEventListener("click", () => this.onChoose(entry));
    item.append(button);
    return item;
  }

  save(ending, text) {
    saveText(`${this.map}.${ending}`, text);
  }
}

/** Give a text to the user as a file. */
export function saveText(download, text) {
  const href = URL.createObjectURL(new Blob([text], { type: "text/plain" }));
  Object.assign(document.createElement("a"), { href, download }).click();
  setTimeout(() => URL.revokeObjectURL(href), 10_000); // the browser reads it after the click
}

/** Photos have no times, so their numbers are the seconds. */
function tumLine({ result }, seconds) {
  if (!isLocalized(result)) return "";
  const { translation, quat_wxyz: [w, ...xyz] } = result.world_from_cam;
  return `${[seconds, ...translation, ...xyz, w].join(" ")}\n`;
}

/** The address of an answer. Its fragment holds what is drawn of it, so the service keeps nothing. */
export function linkTo({ map, name, result }) {
  const { world_from_cam: pose, camera, position_sigma_m, rotation_sigma_deg, probability } = result;
  const numbers = (values) => values.map((value) => Number(value.toPrecision(10))).join("_");
  const held = new URLSearchParams({ name, pose: numbers([...pose.translation, ...pose.quat_wxyz]) });
  held.set("accuracy", numbers([position_sigma_m, rotation_sigma_deg, probability]));
  if (camera) {
    const { width, height, fx = camera.f, fy = fx, cx, cy } = camera;
    held.set("camera", numbers([width, height, fx, fy, cx, cy]));
  }
  held.set("of", result.map ?? "");
  return `${location.origin}${location.pathname}?map=${encodeURIComponent(map)}#${held}`;
}

/** The answer that the page's address holds, as {name, result}; null without one. */
export function linkedAnswer() {
  const held = new URLSearchParams(location.hash.slice(1));
  if (!held.has("pose")) return null;
  const numbers = (key, count) => {
    const texts = held.get(key)?.split("_") ?? [];
    const found = texts.map((text) => (text.trim() ? Number(text) : NaN));
    if (found.length === count && found.every(Number.isFinite)) return found;
    throw new Error(`The link is damaged: "${key}" needs ${count} numbers. Copy it anew.`);
  };
  const pose = numbers("pose", 7);
  const [translation, quat_wxyz] = [pose.slice(0, 3), pose.slice(3)];
  if (Math.abs(Math.hypot(...quat_wxyz) - 1) > 1e-3) throw new Error("The link is damaged: its quaternion has not length 1. Copy it anew.");
  const [position_sigma_m, rotation_sigma_deg, probability] = numbers("accuracy", 3);
  const [width, height, fx, fy, cx, cy] = held.has("camera") ? numbers("camera", 6) : [];
  const camera = width > 0 && height > 0 && fx > 0 && fy > 0 ? { width, height, fx, fy, cx, cy } : null;
  const accuracy = { position_sigma_m, rotation_sigma_deg, probability };
  return {
    name: (held.get("name") || "image").slice(0, 200),
    result: { localized: true, world_from_cam: { translation, quat_wxyz }, camera, ...accuracy, map: held.get("of") },
  };
}
