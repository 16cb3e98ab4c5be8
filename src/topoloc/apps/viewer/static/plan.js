// A map seen straight from above, where a browser shows no 3-D.
const MAX_POINTS = 30000;
const COLOURS = { point: "#8a96a3", node: "#5f86bd", answer: "#ff3d81", note: "#d9a400" };

export class Plan {
  /** `points` are positions [x, y, z, x, ...]. */
  constructor(canvas, { up, nodes }, points) {
    const axis = up.map((value) => Math.abs(value)).indexOf(Math.min(...up.map((value) => Math.abs(value))));
    const across = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const north = across(up, [0, 1, 2].map((k) => (k === axis ? 1 : 0)));
    const length = Math.hypot(...north);
    this.axes = [north.map((value) => value / length), across(up, north).map((value) => value / length)];
    const step = 3 * Math.max(1, Math.ceil(points.length / 3 / MAX_POINTS));
    const chosen = Array.from({ length: Math.floor(points.length / step) }, (_, i) => [...points.subarray(i * step, i * step + 3)]);
    const [spots, centres] = [chosen, nodes.map((node) => node.world_from_cam.translation)].map((all) => all.map((one) => this.flat(one)));
    const sorted = [0, 1].map((k) => spots.map((spot) => spot[k]).sort((a, b) => a - b));
    const bounds = sorted.map((values, k) => {
      const known = [...centres.map((centre) => centre[k]), ...[0.03, 0.97].map((share) => values[Math.floor(share * values.length)] ?? 0)];
      return [Math.min(...known), Math.max(...known)];
    });
    Object.assign(this, { canvas, spots, centres, bounds, answer: null, track: [], notes: [] });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  flat(point) {
    return this.axes.map((axis) => axis.reduce((sum, value, k) => sum + value * point[k], 0));
  }

  /** Draw anew, with another answer, track or notes. */
  show(changed) {
    Object.assign(this, changed);
    this.draw();
  }

  draw() {
    const { canvas, bounds } = this;
    const [width, height] = [(canvas.width = canvas.clientWidth), (canvas.height = canvas.clientHeight)];
    const scale = 0.9 * Math.min(width / (bounds[0][1] - bounds[0][0] || 1), height / (bounds[1][1] - bounds[1][0] || 1));
    const middle = bounds.map(([low, high]) => (low + high) / 2);
    const placed = (spot) => [width / 2 + scale * (spot[0] - middle[0]), height / 2 - scale * (spot[1] - middle[1])];
    const context = canvas.getContext("2d");
    const dots = (all, colour, size) => {
      context.fillStyle = colour;
      for (const spot of all) {
        const [x, y] = placed(spot);
        context.fillRect(x - size / 2, y - size / 2, size, size);
      }
    };
    dots(this.spots, COLOURS.point, 1);
    dots(this.centres, COLOURS.node, 4);
    dots(this.track.flat().map((point) => this.flat(point)), COLOURS.answer, 2);
    dots(this.notes.map((note) => this.flat(note.position)), COLOURS.note, 8);
    const pose = this.answer && ((this.answer.localized && this.answer.world_from_cam) || this.answer.smoothed);
    if (!pose) return;
    dots([this.flat(pose.translation)], COLOURS.answer, 9);
    const [w, x, y, z] = pose.quat_wxyz;
    const ahead = this.flat([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]); // the camera's z axis
    const start = placed(this.flat(pose.translation));
    context.strokeStyle = COLOURS.answer;
    context.lineWidth = 3;
    context.beginPath();
    context.moveTo(...start);
    context.lineTo(start[0] + 22 * ahead[0], start[1] - 22 * ahead[1]);
    context.stroke();
  }
}
