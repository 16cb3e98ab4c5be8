// What a scene document holds, as objects of three.js.
import {
  BufferAttribute, BufferGeometry, Color, DoubleSide, Float32BufferAttribute, Group, Line, LineBasicMaterial, LineDashedMaterial,
  LineSegments, Mesh, MeshBasicMaterial, PlaneGeometry, Points, PointsMaterial, SphereGeometry, SRGBColorSpace, Texture,
} from "three";
import { centreCovariance, ellipsoidMatrix, matrixOf, numbersOf, pictureCorners } from "topoloc/geometry";
import { isLocalized } from "topoloc/words";

const SET_COLOURS = ["#12a594", "#7c6ff0", "#d9822b", "#3f8fe0", "#94ad12", "#c95fc2"];
export const COLOURS = { node: "#5f86bd", path: "#5f86bd", alternative: "#f0a202", bad: "#e5484d", error: "#f0a202", selected: "#ff3d81", note: "#d9a400", junction: "#8e4ec6" };

/** Colours of the axes x, y and z. */
export const AXIS_COLOURS = ["#d6404a", "#2f9e44", "#2f7fe0"];

/** The colour of the n-th set of results. */
export const setColour = (n) => SET_COLOURS[n % SET_COLOURS.length];

/** Points with the colours of the pictures that show them. */
export function cloudOf(positions, coloursBase64, pixels) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  const rgb = numbersOf(coloursBase64, Uint8Array);
  const linear = new Float32Array(rgb.length);
  const levels = Float32Array.from({ length: 256 }, (_, level) => new Color().setRGB(level / 255, 0, 0, SRGBColorSpace).r);
  for (let i = 0; i < rgb.length; i++) linear[i] = levels[rgb[i]];
  geometry.setAttribute("color", new BufferAttribute(linear, 3));
  return new Points(geometry, new PointsMaterial({ size: pixels, sizeAttenuation: false, vertexColors: true }));
}

/** Cameras as frustums, all in one object: [{matrix, camera}], their pictures at `depth` metres. */
export function frustumsOf(cameras, depth, colour, { opacity = 1, dashed = false } = {}) {
  const positions = [];
  for (const { matrix, camera } of cameras) {
    const corners = pictureCorners(camera, depth).map((corner) => transformed(matrix, corner));
    const centre = transformed(matrix, [0, 0, 0]);
    corners.forEach((corner, i) => positions.push(...centre, ...corner, ...corner, ...corners[(i + 1) % 4]));
  }
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(positions, 3));
  const settings = { color: colour, transparent: opacity < 1, opacity };
  if (!dashed) return new LineSegments(geometry, new LineBasicMaterial(settings));
  const lines = new LineSegments(geometry, new LineDashedMaterial({ ...settings, dashSize: depth / 8, gapSize: depth / 10 }));
  return lines.computeLineDistances();
}

/** Lines through positions: [[[x, y, z], ...], ...]. */
export function linesOf(lines, colour, opacity = 1) {
  const group = new Group();
  for (const line of lines.filter((one) => one.length > 1)) {
    const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(line.flat(), 3));
    group.add(new Line(geometry, new LineBasicMaterial({ color: colour, transparent: opacity < 1, opacity })));
  }
  return group;
}

/** Single lines, all in one object: [[from, to], ...]. */
export function segmentsOf(segments, colour) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(segments.flat(2), 3));
  return new LineSegments(geometry, new LineBasicMaterial({ color: colour }));
}

/** The axes of the world from its origin. */
export function axesOf(length) {
  const group = new Group();
  AXIS_COLOURS.forEach((colour, k) => group.add(segmentsOf([[[0, 0, 0], [0, 1, 2].map((i) => (i === k ? length : 0))]], colour)));
  return group;
}

/** Marks at positions, in front of all else. */
export function marksOf(positions, colour) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(positions.flat(), 3));
  const marks = new Points(geometry, new PointsMaterial({ color: colour, depthTest: false, size: 9, sizeAttenuation: false }));
  marks.renderOrder = 1;
  return marks;
}

/** One or two points and the line between them, in front of all else. */
export function ruleOf(ends) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(ends.flat(), 3));
  const line = new Line(geometry, new LineBasicMaterial({ color: COLOURS.selected, depthTest: false }));
  line.renderOrder = 1;
  return new Group().add(marksOf(ends, COLOURS.selected), line);
}

/** A picture (address or canvas) where the camera's frustum ends, `depth` metres before it. `drawn` is called when it is there. */
export function pictureOf(address, matrix, camera, depth, drawn) {
  const corners = pictureCorners(camera, depth);
  const [[left, top, z], , [right, bottom]] = corners;
  const geometry = new PlaneGeometry(right - left, bottom - top);
  geometry.rotateX(Math.PI).translate((left + right) / 2, (top + bottom) / 2, z);
  const texture = new Texture();
  texture.colorSpace = SRGBColorSpace;
  const image = new Image();
  image.onload = () => {
    texture.image = image;
    texture.needsUpdate = true;
    mesh.visible = true;
    drawn();
  };
  image.src = address;
  const mesh = new Mesh(geometry, new MeshBasicMaterial({ map: texture, side: DoubleSide, toneMapped: false }));
  mesh.visible = false;
  mesh.applyMatrix4(matrix);
  return mesh;
}

/** A unit circle about one of the axes. */
function circle(axis) {
  const points = Array.from({ length: 49 }, (_, i) => [Math.cos((i * Math.PI) / 24), Math.sin((i * Math.PI) / 24), 0]);
  return points.map((point) => [0, 1, 2].map((k) => point[(axis + k) % 3]));
}

/** The 95 % ellipsoid of where the camera is, in its true size. */
export function ellipsoidOf(result, colour) {
  const centre = result.world_from_cam.translation;
  const group = new Group();
  const sphere = new SphereGeometry(1, 24, 16);
  group.add(new Mesh(sphere, new MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.25, depthWrite: false })));
  group.add(linesOf([0, 1, 2].map(circle), colour, 0.7));
  group.matrixAutoUpdate = false; // it shears, which position, rotation and scale cannot
  group.matrix.copy(ellipsoidMatrix(centreCovariance(result.covariance, centre), centre));
  group.matrixWorldNeedsUpdate = true;
  return group;
}

/** All that one answer says: its camera and ellipsoid or its alternatives, the truth where it is known and the error. */
export function answerOf(result, depth, colour) {
  const group = new Group();
  const camera = result.camera;
  if (isLocalized(result)) {
    const frustum = frustumsOf([{ matrix: matrixOf(result.world_from_cam), camera }], depth, colour);
    frustum.userData = { kind: "answer", centre: result.world_from_cam.translation };
    group.add(frustum);
    if (result.covariance) group.add(ellipsoidOf(result, colour));
  }
  for (const one of result.alternatives ?? []) {
    const likely = { opacity: 0.45 + 0.55 * one.probability };
    const lines = frustumsOf([{ matrix: matrixOf(one.world_from_cam), camera }], depth, COLOURS.alternative, likely);
    lines.userData = { kind: "alternative", centre: one.world_from_cam.translation };
    group.add(lines);
  }
  const truth = result.true_world_from_cam;
  if (truth) {
    const colourOfTruth = isLocalized(result) ? COLOURS.node : COLOURS.bad;
    const dashed = frustumsOf([{ matrix: matrixOf(truth), camera }], depth, colourOfTruth, { dashed: true });
    dashed.userData = { kind: "truth", centre: truth.translation };
    group.add(dashed);
    if (isLocalized(result)) group.add(linesOf([[result.world_from_cam.translation, truth.translation]], COLOURS.error));
  }
  return group;
}

/** Where an answer is to be looked for, and in what radius (metres) all of it lies: poses, alternatives, truth; null where it has none. */
export function placeOf(result) {
  const others = (result.alternatives ?? []).map((one) => one.world_from_cam);
  const found = isLocalized(result) ? result.world_from_cam : null;
  const poses = [found, ...others, result.smoothed, result.true_world_from_cam].filter(Boolean);
  if (!poses.length) return null;
  const [{ translation: centre }] = poses;
  const away = poses.map((pose) => Math.hypot(...pose.translation.map((value, k) => value - centre[k])));
  return { matrix: matrixOf(poses[0]), centre, radius: Math.max(3 * (result.position_sigma_m ?? 0), ...away) };
}

function transformed(matrix, [x, y, z]) {
  const e = matrix.elements;
  return [e[0] * x + e[4] * y + e[8] * z + e[12], e[1] * x + e[5] * y + e[9] * z + e[13], e[2] * x + e[6] * y + e[10] * z + e[14]];
}

/** Give back what an object holds on the graphics card. */
export function dispose(object) {
  object.traverse((part) => {
    part.geometry?.dispose();
    part.material?.map?.dispose();
    part.material?.dispose();
  });
}
