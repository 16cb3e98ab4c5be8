// The camera of this device, and how the device turns.
import { numbersOf } from "topoloc/geometry";
import { product } from "topoloc/page/projection";

const MAX_SIDE = 640;
const JPEG_QUALITY = 0.85;
const MAX_WAIT_MS = 5000; // for the next image of a camera
const POLL_MS = 30;
const REFUSALS = {
  NotFoundError: "This device has no camera.",
  NotReadableError: "Another program uses the camera. Close it, and try again.",
  NotAllowedError: "The browser does not allow this page to use the camera. Allow it in the settings of the page, and try again.",
};

export class Webcam {
  constructor(video) {
    this.video = video;
    document.addEventListener("visibilitychange", () => this.keepAwake());
  }

  get isOn() {
    return this.video.srcObject !== null;
  }

  async open() {
    if (!navigator.mediaDevices) {
      throw new Error("A browser lends its camera to pages of this machine, or over HTTPS, alone. Start the service with --lan.");
    }
    try {
      const wanted = { facingMode: "environment", width: { ideal: 1280 } };
      this.video.srcObject = await navigator.mediaDevices.getUserMedia({ video: wanted });
      await this.video.play();
      this.last = null;
    } catch (error) {
      this.close();
      throw new Error(REFUSALS[error.name] ?? `The camera does not start: ${error.message}`);
    }
    this.keepAwake();
  }

  close() {
    this.video.srcObject?.getTracks().forEach((track) => track.stop());
    this.video.srcObject = null;
    this.lock?.release().catch(() => {});
    this.lock = null;
  }

  /** Keep the screen on; a browser drops its lock when the page is hidden. */
  async keepAwake() {
    if (!this.isOn || document.hidden) return;
    this.video.play().catch(() => {}); // iOS stops it with the page
    this.lock = await navigator.wakeLock?.request("screen").catch(() => null);
    if (!this.isOn) this.lock?.release();
  }

  /** The next picture that differs from the last one. A service takes equal pictures for those of a camera that hangs. */
  async next() {
    const end = performance.now() + MAX_WAIT_MS;
    let picture = this.picture();
    while (picture.url === this.last) {
      if (performance.now() > end) throw new Error("The camera gives the same image again and again.");
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      picture = this.picture();
    }
    this.last = picture.url;
    return picture;
  }

  /** What the camera sees now: {canvas, file, url, time}, the time in ms since 1970. */
  picture() {
    const { videoWidth, videoHeight } = this.video;
    if (!videoWidth || !this.video.srcObject?.active) throw new Error("The camera gives no images.");
    const scale = Math.min(1, MAX_SIDE / Math.max(videoWidth, videoHeight));
    const [width, height] = [videoWidth, videoHeight].map((side) => Math.round(side * scale));
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const time = performance.timeOrigin + performance.now();
    canvas.getContext("2d", { willReadFrequently: true }).drawImage(this.video, 0, 0, width, height);
    const type = "image/jpeg";
    const url = canvas.toDataURL(type, JPEG_QUALITY); // toBlob waits for an idle moment, 90 ms
    const bytes = numbersOf(url.split(",")[1], Uint8Array);
    const file = new File([bytes], "webcam.jpg", { type });
    return { canvas, file, url, time };
  }
}

/** The motion sensor. iOS asks the user, after a tap; Android and others send events at once, if there is a sensor. */
export class Motion {
  constructor() {
    this.angles = null;
    this.hear = ({ alpha, beta, gamma }) => (this.angles = beta === null ? null : [alpha ?? 0, beta, gamma]);
  }

  /** Whether it may be used. To be called from a tap. */
  async start() {
    const Sensor = globalThis.DeviceOrientationEvent;
    if (Sensor?.requestPermission) {
      const said = await Sensor.requestPermission().catch(() => "denied");
      if (said !== "granted") return false;
    }
    if (Sensor) addEventListener("deviceorientation", this.hear);
    return true;
  }

  stop() {
    removeEventListener("deviceorientation", this.hear);
    this.angles = null;
  }

  /** The rotation from the camera behind the screen (x right, y down, z forward) to the earth, as rows; null without a sensor. */
  now() {
    if (!this.angles) return null;
    const [alpha, beta, gamma] = this.angles.map((degrees) => (degrees * Math.PI) / 180);
    const turned = ((screen.orientation?.angle ?? globalThis.orientation ?? 0) * Math.PI) / 180;
    const about = { z: (a) => [Math.cos(a), -Math.sin(a), 0, Math.sin(a), Math.cos(a), 0, 0, 0, 1] };
    about.x = (a) => [1, 0, 0, 0, Math.cos(a), -Math.sin(a), 0, Math.sin(a), Math.cos(a)];
    about.y = (a) => [Math.cos(a), 0, Math.sin(a), 0, 1, 0, -Math.sin(a), 0, Math.cos(a)];
    return [about.z(alpha), about.x(beta), about.y(gamma), about.z(-turned), [1, 0, 0, 0, -1, 0, 0, 0, -1]].reduce(product);
  }
}
