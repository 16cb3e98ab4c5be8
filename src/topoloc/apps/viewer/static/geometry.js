// Poses and covariances as results have them, made ready for drawing. Metres; axes of the world unless a name says otherwise.
import { Matrix4, Quaternion, Vector3 } from "three";

/** A result's pose {translation, quat_wxyz} as a matrix: world_from_cam. */
export function matrixOf(pose) {
  const [w, x, y, z] = pose.quat_wxyz;
  return new Matrix4().compose(new Vector3(...pose.translation), new Quaternion(x, y, z, w).normalize(), new Vector3(1, 1, 1));
}

/** Covariance (3x3) of the camera's centre t, of that of the left perturbation (translation, rotation): J C J', J = [I, -skew(t)]. */
export function centreCovariance(covariance, [x, y, z]) {
  const jacobian = [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]];
  const product = (a, b) => a.map((row) => b[0].map((_, j) => row.reduce((sum, value, k) => sum + value * b[k][j], 0)));
  const transposed = jacobian[0].map((_, j) => jacobian.map((row) => row[j]));
  return product(product(jacobian, covariance), transposed);
}

/** The matrix that makes a unit sphere the ellipsoid in which the centre lies in 95 of 100 cases: a root of C times chi-square's. */
export function ellipsoidMatrix(c, centre) {
  const scale = Math.sqrt(7.8147);
  const root = (value) => Math.sqrt(Math.max(value, 1e-12));
  const l00 = root(c[0][0]), l10 = c[1][0] / l00, l20 = c[2][0] / l00;
  const l11 = root(c[1][1] - l10 * l10), l21 = (c[2][1] - l20 * l10) / l11;
  const l22 = root(c[2][2] - l20 * l20 - l21 * l21);
  const [a, b, d, e, f, g] = [l00, l10, l11, l20, l21, l22].map((value) => value * scale);
  return new Matrix4().set(a, 0, 0, centre[0], b, d, 0, centre[1], e, f, g, centre[2], 0, 0, 0, 1);
}

/** Corners of a camera's picture at the given depth, in the camera's axes (x right, y down, z forward). */
export function pictureCorners(camera, depth) {
  const { width, height, fx, fy, f, cx, cy } = camera ?? { width: 4, height: 3, f: 3.6, cx: 1.5, cy: 1 };
  const corner = (u, v) => [((u - cx) / (fx ?? f)) * depth, ((v - cy) / (fy ?? fx ?? f)) * depth, depth];
  const [left, top, right, bottom] = [-0.5, -0.5, width - 0.5, height - 0.5];
  return [corner(left, top), corner(right, top), corner(right, bottom), corner(left, bottom)];
}

/** Bytes of base64 as an array of numbers of `Kind`. */
export function numbersOf(base64, Kind) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new Kind(bytes.buffer);
}
