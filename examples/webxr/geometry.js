// Matrices are column-major, as those of WebXR: 16 numbers.

/** fx, fy, cx, cy in pixels of an image of this size, y from its top (COLMAP's PINHOLE). */
export const intrinsics = (projection, width, height) => [
  (projection[0] * width) / 2,
  (projection[5] * height) / 2,
  ((1 - projection[8]) * width) / 2,
  ((1 + projection[9]) * height) / 2,
];

export function multiply(a, b) {
  const product = new Array(16).fill(0);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
    }
  }
  return product;
}

/** Rotation and translation as a matrix. */
export function poseMatrix({ x, y, z, w }, [tx, ty, tz]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
    tx, ty, tz, 1,
  ];
}

// Of the body of a GeoPose (x forward, y left, z up) in the camera of WebXR (x right, y up, z back).
const CAMERA_FROM_BODY = [0, 0, -1, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1];

/** East-north-up at the camera, in the space of the session. */
export function sessionFromEnu(sessionFromCamera, { x, y, z, w }) {
  const bodyFromEnu = poseMatrix({ x: -x, y: -y, z: -z, w }, [0, 0, 0]);
  return multiply(multiply(sessionFromCamera, CAMERA_FROM_BODY), bodyFromEnu);
}

const SEMI_MAJOR = 6378137;
const ECCENTRICITY_SQUARED = 0.00669437999014;

function ecef({ lat, lon, h }) {
  const [phi, lambda] = [(lat * Math.PI) / 180, (lon * Math.PI) / 180];
  const normal = SEMI_MAJOR / Math.sqrt(1 - ECCENTRICITY_SQUARED * Math.sin(phi) ** 2);
  const across = (normal + h) * Math.cos(phi);
  return [across * Math.cos(lambda), across * Math.sin(lambda), (normal * (1 - ECCENTRICITY_SQUARED) + h) * Math.sin(phi)];
}

/** Metres east, north and up from one place (WGS-84 degrees, height above the ellipsoid) to another. */
export function enuFromPlaces(from, to) {
  const [phi, lambda] = [(from.lat * Math.PI) / 180, (from.lon * Math.PI) / 180];
  const start = ecef(from);
  const [x, y, z] = ecef(to).map((value, k) => value - start[k]);
  const outward = Math.cos(lambda) * x + Math.sin(lambda) * y;
  return [
    Math.cos(lambda) * y - Math.sin(lambda) * x,
    Math.cos(phi) * z - Math.sin(phi) * outward,
    Math.cos(phi) * outward + Math.sin(phi) * z,
  ];
}
