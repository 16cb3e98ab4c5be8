/** Camera (x right, y down, z forward) to world: metres, unit quaternion. */
export interface Pose {
  translation: [number, number, number];
  quat_wxyz: [number, number, number, number];
}

/** OGC GeoPose 1.0, Basic-Quaternion: a body (x forward, y left, z up) in east-north-up. */
export interface GeoPose {
  position: { lat: number; lon: number; h: number };
  quaternion: { x: number; y: number; z: number; w: number };
}

/** COLMAP's model name, size and parameters; the centre of the top-left pixel is (0, 0). */
export interface Camera {
  model: string;
  width: number;
  height: number;
  [parameter: string]: number | string;
}

export type Reason = "too_few_matches" | "too_few_inliers" | "imprecise" | "ambiguous" | "not_in_map" | "jump" | "unreadable";

/** What every result has. `t_ns` is exact to 256 ns, as numbers of JavaScript are. */
export interface Query {
  query: string;
  map: string;
  version: number;
  tile?: string;
  joint_world?: string;
  joint_from_cam?: Pose;
  atlas_from_cam?: Pose;
  t_ns: number | null;
  camera: Camera | null;
  features: string;
  candidates: [node: number, score: number][];
  num_matches: number;
  num_inliers: number;
  times_ms: Record<string, number>;
  /** The map has no scale: lengths are in its units. */
  scale?: "none";
  /** Streams only, as the next three. */
  /** Probability that the colours in view are this floor's and not another's, if both were as likely. */
  appearance?: number;
  state?: "localized" | "tracked" | "predicted" | "ambiguous" | "lost";
  smoothed?: Pose | null;
  smoothed_covariance?: number[][] | null;
  repeated?: boolean;
}

export interface Localized extends Query {
  localized: true;
  world_from_cam: Pose;
  /** 6x6, left perturbation (translation, rotation) of world_from_cam. */
  covariance: number[][];
  position_sigma_m: number;
  /** Instead of position_sigma_m, in a map without scale. */
  position_sigma?: number;
  rotation_sigma_deg: number;
  probability: number;
  calibrated?: false;
  node: number;
  focal_length_px?: number;
  frame_rotation_deg?: number;
  noise_share?: number;
  evidence?: Record<string, number | null>;
  calibration_doubt?: Record<string, unknown>;
  /** Maps with a place on earth only. */
  geopose?: GeoPose;
}

export interface NotLocalized extends Query {
  localized: false;
  reason: Reason;
  detail: string;
  alternatives: { world_from_cam: Pose; probability: number; node: number; tile?: string; geopose?: GeoPose }[];
}

/** `result.localized` tells which of the two it is. */
export type Result = Localized | NotLocalized;

export interface ResultOfMaps {
  query: string;
  localized: boolean;
  /** The only map with a pose, else null. */
  map: string | null;
  answers: { map: string; result: Result }[];
  /** Maps that cannot be read. */
  failed: { map: string; error: string }[];
}

/** The bytes of an image file: JPEG, PNG, WebP ... */
export type Image = Blob | ArrayBuffer | ArrayBufferView;

/** A text at a place of a map. `geopose` only if the map has a place on earth. */
export interface Note {
  id: string;
  text: string;
  created: string;
  /** Metres, axes of the map's world. */
  position: [number, number, number];
  geopose?: GeoPose;
}

export interface Cancel {
  signal?: AbortSignal;
}

export interface Fields extends Cancel {
  /** `exif` (default), `unknown`, `map`, `fx,fy,cx,cy` in pixels, or an object as camera.json. */
  camera?: string | object;
  /** Approximate pose. */
  prior?: Pose;
  /** Tiles of atlases farther away are skipped. */
  near?: { latitude: number; longitude: number; radiusM: number };
  /** After so many milliseconds no further pose is tried. */
  maxMs?: number;
  /** Name of the image in the result. */
  name?: string;
}

export interface NextOptions {
  /** Time of the image, nanoseconds; default now. */
  tNs?: number | bigint;
  camera?: string | object;
}

/** Successive images, one at a time. Each result supports the next one. */
export interface Stream {
  /** Rejects with TopolocError for a bad image; the stream goes on. */
  next(image: Image, options?: NextOptions): Promise<Result>;
  close(): Promise<void>;
}

export interface GeoPoseFacts {
  /** COLMAP's model and parameters, in COLMAP's convention. */
  camera?: { model: string; modelParams: number[] };
  /** Width and height, pixels. */
  size?: [number, number];
  /** The `coords` of a browser's GeolocationPosition. */
  geolocation?: { latitude: number; longitude: number; accuracy: number; altitude?: number | null };
  id?: string;
  /** Milliseconds since 1970. */
  timestamp?: number;
}

export interface GeoPoseFound {
  localized: true;
  id: string;
  timestamp: number;
  type: "geopose";
  /** Standard deviations: metres, degrees. */
  accuracy: { position: number; orientation: number };
  geopose: GeoPose;
}

export interface GeoPoseRefused {
  localized: false;
  reason: Reason;
  detail: string;
  requestId: string;
}

/** A refused request, or no response (status 0). An aborted call rejects with the signal's reason. */
export class TopolocError extends Error {
  readonly status: number;
  readonly requestId: string | null;
}

export interface ClientOptions {
  /** Content of the service's `--token-file`. */
  token?: string | null;
  /** Time limit of a response, milliseconds; default 60000. */
  timeoutMs?: number;
  /** For a Node without WebSocket, before version 22. */
  WebSocket?: unknown;
}

/** Asks a service. Where too many requests wait, it repeats the request after the named delay. */
export class TopolocClient {
  constructor(url: string | URL, options?: ClientOptions);
  /** Names of all maps. */
  maps(options?: Cancel): Promise<string[]>;
  /** Facts of a map, with its nodes. */
  map(name: string, options?: Cancel): Promise<Record<string, unknown>>;
  localize(map: string, image: Image, fields?: Fields): Promise<Result>;
  localizeEverywhere(image: Image, fields?: Fields): Promise<ResultOfMaps>;
  /** Why an image has this result. */
  explain(map: string, image: Image, fields?: Fields): Promise<Record<string, unknown>>;
  /** A map for display: points, nodes and paths, as docs/viewer.md describes. */
  scene(map: string, options?: Cancel): Promise<Record<string, unknown>>;
  /** The oldest first. */
  notes(map: string, options?: Cancel): Promise<Note[]>;
  /** The id of the note. `position` in metres, axes of the map's world. */
  addNote(map: string, text: string, position: ArrayLike<number> & Iterable<number>, options?: Cancel): Promise<string>;
  removeNote(map: string, id: string, options?: Cancel): Promise<void>;
  /** Localize on earth by the OSCP GeoPose Protocol. */
  geopose(image: Image, facts?: GeoPoseFacts & Cancel & { map?: string }): Promise<GeoPoseFound | GeoPoseRefused>;
  stream(map: string, options?: Cancel & { camera?: string | object; transport?: "websocket" | "http" }): Promise<Stream>;
}

/** The body of a request of the GeoPose Protocol 2.0, for other services too. */
export function geoposeRequest(image: Image, facts?: GeoPoseFacts): Promise<object>;
