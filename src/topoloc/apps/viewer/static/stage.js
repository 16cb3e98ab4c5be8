// A canvas in which a scene is drawn when it changes, and turned by mouse, fingers and keys.
import { Color, Matrix4, OrbitControls, PerspectiveCamera, Scene, Vector3, WebGLRenderer } from "three";

const STEP = 0.12; // radians a key press
const FOV_DEG = 50;

export class Stage {
  /**
   * @param focus corners [low, high] of the box of the first view; `onPick(x, y)` is told of clicks, in pixels of the canvas.
   * `wheelZooms`: always, or only while the canvas has the focus, so that a page around it can be scrolled.
   */
  constructor(canvas, { up, focus, wheelZooms }, onPick) {
    this.canvas = canvas;
    this.up = new Vector3(...up).normalize();
    [this.low, this.high] = focus.map((corner) => new Vector3(...corner));
    this.renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new Scene();
    const size = this.size();
    this.camera = new PerspectiveCamera(FOV_DEG, 1, size / 2000, size * 60);
    this.camera.up.copy(this.up);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.enableZoom = wheelZooms;
    canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }), { capture: true });
    canvas.addEventListener("focus", () => (this.controls.enableZoom = true));
    canvas.addEventListener("blur", () => (this.controls.enableZoom = wheelZooms));
    this.controls.addEventListener("change", () => this.draw());
    canvas.addEventListener("keydown", (event) => this.onKey(event));
    this.listenForClicks(onPick);
    new ResizeObserver(() => this.resize()).observe(canvas);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.resize();
    this.overview();
  }

  size() {
    return Math.max(this.high.distanceTo(this.low), 0.5);
  }

  /** Look at the whole from aside and above, or straight down. */
  overview(straightDown = false) {
    const across = this.high.clone().sub(this.low);
    const flat = across.clone().addScaledVector(this.up, -across.dot(this.up));
    const isAlongX = Math.abs(this.up.x) <= 0.7 && Math.abs(flat.x) >= Math.abs(flat.y) + Math.abs(flat.z);
    const aside = isAlongX ? new Vector3(0.35, -1, 0.6) : new Vector3(1, 0.35, 0.35);
    aside.addScaledVector(this.up, -aside.dot(this.up)).normalize();
    const from = straightDown ? this.up.clone().addScaledVector(aside, 0.01) : this.up.clone().multiplyScalar(0.85).add(aside);
    const middle = this.low.clone().add(this.high).multiplyScalar(0.5);
    this.lookAt(middle, from.normalize(), 1);
    this.lookAt(middle, from, this.fitting(middle));
  }

  /** Go to a camera of the scene: behind it and a little above, at `distance` metres. */
  goTo(matrix, distance) {
    const centre = new Vector3().setFromMatrixPosition(matrix);
    const forward = new Vector3().setFromMatrixColumn(matrix, 2);
    const from = forward.multiplyScalar(-1).addScaledVector(this.up, 0.7).normalize();
    if (from.lengthSq() < 0.1) from.copy(this.up);
    this.lookAt(centre, from, distance);
  }

  /** From where the scene is seen, for `goBack`. */
  view() {
    return [this.controls.target, this.camera.position].map((one) => one.clone());
  }

  goBack([target, position]) {
    const from = position.clone().sub(target);
    this.lookAt(target, from.clone().normalize(), from.length());
  }

  lookAt(target, from, distance) {
    this.controls.target.copy(target);
    this.camera.position.copy(target).addScaledVector(from, distance);
    this.controls.update();
    this.camera.updateMatrixWorld();
    this.draw();
  }

  /** How far back all corners of the box are in view, looking as the camera does now. */
  fitting(middle) {
    const [right, above, back] = [0, 1, 2].map((k) => new Vector3().setFromMatrixColumn(this.camera.matrixWorld, k));
    const tangent = Math.tan(((FOV_DEG / 2) * Math.PI) / 180) * 0.94;
    const needed = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => {
      const corner = new Vector3(...["x", "y", "z"].map((axis, bit) => (k >> bit) & 1 ? this.high[axis] : this.low[axis])).sub(middle);
      const aside = Math.abs(corner.dot(right)) / this.camera.aspect;
      return corner.dot(back) + Math.max(aside, Math.abs(corner.dot(above))) / tangent;
    });
    return Math.max(...needed, 0.05 * this.size());
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  /** Draw once, however often it is asked for until then. */
  draw() {
    this.asked ??= requestAnimationFrame(() => {
      this.asked = undefined;
      this.scene.background = new Color(getComputedStyle(this.canvas).getPropertyValue("--scene-ground").trim() || "#11161d");
      this.renderer.render(this.scene, this.camera);
      this.onDraw?.();
    });
  }

  /** Metres that one pixel spans at the point that the eye turns about. */
  metresPerPixel() {
    const distance = this.camera.position.distanceTo(this.controls.target);
    return (2 * distance * Math.tan(((FOV_DEG / 2) * Math.PI) / 180)) / Math.max(this.canvas.clientHeight, 1);
  }

  /** Where a point of the world is on the canvas, pixels; null behind the eye. */
  seen(point) {
    const place = new Vector3(...point).project(this.camera);
    if (place.z > 1 || place.z < -1) return null;
    return [((place.x + 1) / 2) * this.canvas.clientWidth, ((1 - place.y) / 2) * this.canvas.clientHeight];
  }

  /** Of positions [x, y, z, x, ...] within `radius` pixels of (x, y), the one that is nearest to the eye; null without one. */
  frontPoint(positions, x, y, radius) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const e = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse).elements;
    let [best, nearest] = [null, Infinity];
    for (let i = 0; i < positions.length; i += 3) {
      const [a, b, c] = [positions[i], positions[i + 1], positions[i + 2]];
      const depth = e[3] * a + e[7] * b + e[11] * c + e[15];
      if (depth < this.camera.near || depth >= nearest) continue;
      const aside = (((e[0] * a + e[4] * b + e[8] * c + e[12]) / depth + 1) / 2) * width - x;
      const below = ((1 - (e[1] * a + e[5] * b + e[9] * c + e[13]) / depth) / 2) * height - y;
      if (aside * aside + below * below <= radius * radius) [best, nearest] = [[a, b, c], depth];
    }
    return best;
  }

  listenForClicks(onPick) {
    let start = null;
    this.canvas.addEventListener("pointerdown", (event) => (start = [event.clientX, event.clientY]));
    this.canvas.addEventListener("pointerup", (event) => {
      if (!start || Math.hypot(event.clientX - start[0], event.clientY - start[1]) > 5) return;
      const box = this.canvas.getBoundingClientRect();
      onPick(event.clientX - box.left, event.clientY - box.top);
    });
  }

  onKey(event) {
    const turns = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (turns[event.key] && event.shiftKey) this.shift(...turns[event.key]);
    else if (turns[event.key]) this.turn(...turns[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(0.85);
    else if (event.key === "-") this.zoom(1 / 0.85);
    else if (event.key === "Home") this.overview();
    else return;
    event.preventDefault();
  }

  /** Turn the eye about what it looks at. */
  turn(aside, upwards) {
    const offset = this.camera.position.clone().sub(this.controls.target).applyAxisAngle(this.up, aside);
    const right = this.up.clone().cross(offset).normalize();
    const angle = offset.angleTo(this.up) - upwards;
    if (angle > 0.02 && angle < Math.PI - 0.02) offset.applyAxisAngle(right, -upwards);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.draw();
  }

  shift(aside, upwards) {
    const distance = this.camera.position.distanceTo(this.controls.target);
    const way = new Vector3().setFromMatrixColumn(this.camera.matrix, 0).multiplyScalar(aside * distance);
    way.addScaledVector(new Vector3().setFromMatrixColumn(this.camera.matrix, 1), upwards * distance);
    this.camera.position.add(way);
    this.controls.target.add(way);
    this.controls.update();
    this.draw();
  }

  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.draw();
  }
}
