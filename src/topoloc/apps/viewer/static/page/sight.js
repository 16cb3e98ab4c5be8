// The camera's image with the map over it, in perspective: points, nodes and notes where the last answer has them.
import { lensOf, placeAt, product, projected, transposed, unprojected, viewOf } from "topoloc/page/projection";

const COLOURS = { point: "#2ee6c8", node: "#9db8ff", note: "#ffd43b", ground: "#11161d" };
const MARGIN = 0.3; // of the image: kept around it for the next turn of the camera
const MIN_STEP_PX = 7; // between two points, on the screen
const NEIGHBOURS = 24; // cells across the image, in which a point far behind others is hidden
const HIDDEN = 1.5; // times as deep
const MAX_NODES = 40;
const MAX_CROP = 1.4; // more is not cut off to fill the screen
const TAP_PX = 20;

export class Sight {
  constructor(canvas, webcam, motion) {
    Object.assign(this, { canvas, webcam, motion, points: new Float32Array(), nodes: [], notes: [], labels: [], showsPoints: true });
    canvas.sight = this;
    this.forget();
    new ResizeObserver(() => (this.isStale = true)).observe(canvas);
  }

  /** Forget the last answer. */
  forget() {
    Object.assign(this, { seen: null, chosen: [], isStale: true });
  }

  setMap(points, nodes) {
    Object.assign(this, { points, nodes });
    this.forget();
  }

  start() {
    const frame = () => {
      if (!this.webcam.isOn) return (this.asked = 0);
      if (this.isStale || !this.seen || this.isPredicted) this.draw();
      this.asked = requestAnimationFrame(frame);
    };
    this.asked ||= requestAnimationFrame(frame);
  }

  /** Show an answer over its picture {canvas, turn}. */
  see(answer, picture) {
    const pose = answer.localized ? answer.world_from_cam : answer.smoothed;
    if (!pose || !answer.camera) return this.forget();
    const [view, lens] = [viewOf(pose), lensOf(answer.camera)];
    Object.assign(this, { seen: { view, lens, picture, isMeasured: answer.localized }, isStale: true });
    this.chosen = this.visible(view, lens);
  }

  /** Whether the motion sensor turns the last pose to now; else the picture of the last answer stays under it. */
  get isPredicted() {
    return Boolean(this.seen?.picture.turn && this.motion.angles);
  }

  /** The last pose, turned as the device has turned since its picture. */
  view() {
    const { view, picture } = this.seen;
    if (!this.isPredicted) return view;
    const since = product(transposed(picture.turn), this.motion.now());
    return { rotation: product(view.rotation, since), translation: view.translation };
  }

  /** The points that are seen from there: the nearest of each small cell, without those that a surface before them hides. */
  visible(view, lens) {
    const { points } = this;
    const side = Math.max(lens.width, lens.height);
    const step = Math.max(1, MIN_STEP_PX / this.fitted(lens.width, lens.height).scale);
    const [nearest, front] = [new Map(), new Map()];
    for (let i = 0; i < points.length; i += 3) {
      const at = projected(view, lens, [points[i], points[i + 1], points[i + 2]]);
      if (!at || at[0] < -MARGIN * side || at[1] < -MARGIN * side || at[0] > lens.width + MARGIN * side || at[1] > lens.height + MARGIN * side) continue;
      const [cell, area] = [step, side / NEIGHBOURS].map((size) => Math.floor(at[0] / size) * 65536 + Math.floor(at[1] / size));
      if (!(nearest.get(cell)?.depth <= at[2])) nearest.set(cell, { i, area, depth: at[2] });
      if (!(front.get(area) <= at[2])) front.set(area, at[2]);
    }
    return [...nearest.values()].filter(({ area, depth }) => depth <= HIDDEN * front.get(area)).map(({ i }) => points.subarray(i, i + 3));
  }

  /** How an image of this size lies on the canvas: {scale, left, top} in pixels of the page. It fills it where little is cut off. */
  fitted(width, height) {
    const { clientWidth, clientHeight } = this.canvas;
    const [least, most] = [clientWidth / width, clientHeight / height].sort((a, b) => a - b);
    const scale = most < MAX_CROP * least ? most : least;
    return { scale, left: (clientWidth - scale * width) / 2, top: (clientHeight - scale * height) / 2 };
  }

  draw() {
    const { canvas, seen, isPredicted } = this;
    const ratio = Math.min(devicePixelRatio, 2);
    const size = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(side * ratio));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const context = canvas.getContext("2d", { willReadFrequently: true }); // thousands of small marks are drawn faster without the GPU
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    this.isStale = false;
    [this.drawn, this.labels] = [[], []];
    const { video } = this.webcam;
    const image = seen ? seen.picture.canvas : video;
    const [width, height] = [image.videoWidth ?? image.width, image.videoHeight ?? image.height];
    if (!width) return;
    const { scale, left, top } = this.fitted(width, height);
    const box = { left, top, width: scale * width, height: scale * height };
    for (const [side, length] of Object.entries(box)) video.style[side] = `${length}px`;
    if (seen && !isPredicted) context.drawImage(image, left, top, box.width, box.height);
    if (!seen) return;
    context.save();
    context.beginPath();
    context.rect(left, top, box.width, box.height);
    context.clip();
    this.drawMap(context, this.view(), seen.lens);
    context.restore();
  }

  /** Where a point of the world is on the canvas: [x, y, depth] in pixels of the page, null out of sight. */
  placed(view, lens, point) {
    const at = projected(view, lens, point);
    if (!at) return null;
    const { scale, left, top } = this.fitted(lens.width, lens.height);
    return [left + scale * (at[0] + 0.5), top + scale * (at[1] + 0.5), at[2]];
  }

  drawMap(context, view, lens) {
    context.globalAlpha = this.seen.isMeasured ? 1 : 0.5;
    const places = this.showsPoints ? this.chosen.map((point) => [point, this.placed(view, lens, point)]).filter(([, at]) => at) : [];
    for (const [colour, size] of [[COLOURS.ground, 4], [COLOURS.point, 2.4]]) {
      context.fillStyle = colour;
      for (const [, [x, y]] of places) context.fillRect(x - size / 2, y - size / 2, size, size);
    }
    this.drawn = places;
    if (this.showsPoints) this.drawNodes(context, view, lens);
    context.globalAlpha = 1;
    for (const note of this.notes) this.drawNote(context, note, this.placed(view, lens, note.position));
  }

  /** Nodes as frustums, the nearest ones. */
  drawNodes(context, view, lens) {
    const ahead = this.nodes.map((node) => ({ node, at: this.placed(view, lens, node.centre) })).filter(({ at }) => at && at[2] > 0.3);
    context.strokeStyle = COLOURS.node;
    context.lineWidth = 1.2;
    context.beginPath();
    for (const { node, at } of ahead.sort((a, b) => a.at[2] - b.at[2]).slice(0, MAX_NODES)) {
      const corners = node.corners.map((corner) => this.placed(view, lens, corner));
      if (corners.includes(null)) continue;
      corners.forEach((corner, i) => {
        for (const end of [at, corners[(i + 1) % 4]]) {
          context.moveTo(corner[0], corner[1]);
          context.lineTo(end[0], end[1]);
        }
      });
    }
    context.stroke();
  }

  drawNote(context, note, at) {
    if (!at || at[0] < 0 || at[0] > this.canvas.clientWidth) return;
    const [x, y] = at;
    const text = note.text.length > 36 ? `${note.text.slice(0, 35)}…` : note.text;
    context.font = "600 14px system-ui, sans-serif";
    const width = context.measureText(text).width + 16;
    context.fillStyle = context.strokeStyle = COLOURS.note;
    context.lineWidth = 2;
    context.beginPath();
    context.arc(x, y, 4, 0, 2 * Math.PI);
    context.fill();
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x, y - 18);
    context.stroke();
    const left = Math.max(4, Math.min(x - 12, this.canvas.clientWidth - width - 4));
    context.fillRect(left, y - 42, width, 24);
    context.fillStyle = COLOURS.ground;
    context.fillText(text, left + 8, y - 25);
    this.labels.push({ note, depth: at[2], left, right: left + width, top: y - 42, bottom: y + TAP_PX });
  }

  /** The note at these pixels of the canvas, undefined without one. */
  noteAt(x, y) {
    const hit = this.labels.filter(({ left, right, top, bottom }) => x > left && x < right && y > top && y < bottom);
    return hit.sort((a, b) => a.depth - b.depth)[0]?.note;
  }

  /** The place of the map at these pixels of the canvas. Throws where there is none. */
  placeAt(x, y) {
    if (!this.seen) throw new Error("A note needs a pose. Look at a place of the map first.");
    const { lens } = this.seen;
    const { scale, left, top } = this.fitted(lens.width, lens.height);
    const [u, v] = [(x - left) / scale - 0.5, (y - top) / scale - 0.5];
    const isInside = u >= 0 && v >= 0 && u < lens.width && v < lens.height;
    const place = isInside ? placeAt(this.view(), lens, this.points, [u, v]) : null;
    if (!place) throw new Error("The map has no points there. Tap where points are drawn.");
    return place;
  }
}

/** A node of the scene as it is drawn here. */
export function nodeOf({ world_from_cam: pose, camera }, depth) {
  const [view, lens] = [viewOf(pose), lensOf(camera)];
  const [right, bottom] = [lens.width - 0.5, lens.height - 0.5];
  const corners = [[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]].map((pixel) => unprojected(view, lens, pixel, depth));
  return { centre: pose.translation, corners };
}
