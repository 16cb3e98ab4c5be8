// Cameras and poses as results have them: from the world to pixels and back. The centre of the top-left pixel is (0, 0).

/** The camera {model, width, height, fx or f, ...} made ready. `reach` is the radius, at depth 1, up to which its distortion holds. */
export function lensOf(camera) {
  const { width, height, f = 0, fx = f, fy = fx, cx, cy, k1 = 0, k2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0, p1 = 0, p2 = 0 } = camera;
  const isFisheye = camera.model?.includes("FISHEYE") ?? false;
  const lens = { width, height, fx, fy, cx, cy, reach: Infinity, distort: null };
  if (isFisheye) {
    lens.distort = (x, y) => {
      const radius = Math.hypot(x, y) || 1e-12;
      const angle = Math.atan(radius), s = angle * angle;
      const factor = (angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))) / radius;
      return [factor * x, factor * y];
    };
  } else if ([k1, k2, k3, k4, k5, k6, p1, p2].some((value) => value !== 0)) {
    lens.distort = (x, y) => {
      const s = x * x + y * y;
      const factor = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)));
      return [factor * x + 2 * p1 * x * y + p2 * (s + 2 * x * x), factor * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y];
    };
  }
  if (!lens.distort) return lens;
  const radii = Array.from({ length: 400 }, (_, i) => 0.01 * (i + 1)); // beyond, it folds back
  lens.reach = radii.find((radius) => lens.distort(radius + 0.01, 0)[0] <= lens.distort(radius, 0)[0]) ?? 4;
  return lens;
}

/** The rotation of a quaternion as rows [a, b, c, d, e, f, g, h, i]. */
export function rotationOf([w, x, y, z]) {
  const n = 2 / (w * w + x * x + y * y + z * z);
  const [xx, yy, zz, xy, xz, yz, wx, wy, wz] = [x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z].map((value) => value * n);
  return [1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy];
}

export const product = (a, b) => a.map((_, i) => [0, 1, 2].reduce((sum, k) => sum + a[i - (i % 3) + k] * b[3 * k + (i % 3)], 0));
export const transposed = ([a, b, c, d, e, f, g, h, i]) => [a, d, g, b, e, h, c, f, i];

/** A pose {translation, quat_wxyz} (world_from_cam) as {rotation, translation}. */
export const viewOf = (pose) => ({ rotation: rotationOf(pose.quat_wxyz), translation: pose.translation });

/** [u, v, depth] of a point of the world; null behind the camera, or where its distortion does not hold. */
export function projected({ rotation: r, translation: t }, lens, [px, py, pz]) {
  const [dx, dy, dz] = [px - t[0], py - t[1], pz - t[2]];
  const depth = r[2] * dx + r[5] * dy + r[8] * dz;
  if (depth <= 0.05) return null;
  let x = (r[0] * dx + r[3] * dy + r[6] * dz) / depth;
  let y = (r[1] * dx + r[4] * dy + r[7] * dz) / depth;
  if (lens.distort) {
    if (x * x + y * y > lens.reach * lens.reach) return null;
    [x, y] = lens.distort(x, y);
  }
  return [lens.fx * x + lens.cx, lens.fy * y + lens.cy, depth];
}

/** The point of the world that is seen at a pixel in this depth, metres. */
export function unprojected({ rotation: r, translation: t }, lens, [u, v], depth) {
  const [a, b] = [(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy];
  let [x, y] = [a, b];
  for (let i = 0; lens.distort && i < 200; i++) {
    const [c, d] = lens.distort(x, y);
    [x, y] = [x + a - c, y + b - d];
  }
  return [0, 1, 2].map((k) => t[k] + depth * (r[3 * k] * x + r[3 * k + 1] * y + r[3 * k + 2]));
}

const TAP_PX = [0.02, 0.04]; // of the longer side: at the tap, else near it, as a finger is not precise
const MIN_SUPPORT = 3; // points that agree
const SAME_DEPTH = 1.08; // points of one surface near a pixel, by the ratio of their depths

/** The place of the map at a pixel: the ray in the depth of the nearest surface of points around it; null without one. */
export function placeAt(view, lens, points, [u, v]) {
  const seen = [];
  const most = TAP_PX.at(-1) * Math.max(lens.width, lens.height);
  for (let i = 0; i < points.length; i += 3) {
    const at = projected(view, lens, [points[i], points[i + 1], points[i + 2]]);
    const px = at ? Math.hypot(at[0] - u, at[1] - v) : Infinity;
    if (px <= most) seen.push({ px, depth: at[2] });
  }
  for (const share of TAP_PX) {
    const depths = seen.filter(({ px }) => px <= share * Math.max(lens.width, lens.height)).map(({ depth }) => depth).sort((a, b) => a - b);
    for (let i = 0; i + MIN_SUPPORT <= depths.length; i++) {
      const surface = depths.filter((depth) => depth >= depths[i] && depth <= depths[i] * SAME_DEPTH);
      if (surface.length >= MIN_SUPPORT) return unprojected(view, lens, [u, v], surface[surface.length >> 1]);
    }
  }
  return null;
}
