// The webcam, and a stream of its pictures that the service follows: one on the way at a time, so that no line forms.
import { streamAddress, subprotocols } from "topoloc/page/asking";

const MAX_WIDTH = 640;
const MAX_TRACK = 6000; // positions that are drawn
const JPEG_QUALITY = 0.85;

export class Live {
  /** `told.said(answer, track)` gets each answer, and the way so far in lines; `told.failed(error)`, `told.ended()`. */
  constructor(video, told) {
    [this.video, this.told, this.run, this.track] = [video, told, null, [[]]];
  }

  /** Whether the webcam is on now. */
  async toggleWebcam() {
    if (this.video.srcObject) {
      this.stop();
      this.video.srcObject.getTracks().forEach((track) => track.stop());
      this.video.srcObject = null;
      return false;
    }
    if (!navigator.mediaDevices) throw new Error("A browser lends its webcam to pages of this machine, or over HTTPS, alone.");
    try {
      const wanted = { facingMode: "environment", width: { ideal: 1280 } };
      this.video.srcObject = await navigator.mediaDevices.getUserMedia({ video: wanted });
    } catch (error) {
      const isMissing = error.name === "NotFoundError";
      throw new Error(isMissing ? "This machine has no webcam." : "The browser does not allow this page to use the webcam.");
    }
    await this.video.play();
    return true;
  }

  /** What the webcam sees now, as a JPEG file. */
  picture() {
    const { videoWidth, videoHeight } = this.video;
    const scale = Math.min(1, MAX_WIDTH / videoWidth);
    const [width, height] = [videoWidth, videoHeight].map((side) => Math.round(side * scale));
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    canvas.getContext("2d").drawImage(this.video, 0, 0, width, height);
    const type = "image/jpeg";
    return new Promise((resolve) => canvas.toBlob((blob) => resolve(new File([blob], "webcam.jpg", { type })), type, JPEG_QUALITY));
  }

  /** Begin to follow, or end it. Whether it follows now. */
  toggle(map, camera) {
    if (this.run) {
      this.stop();
      return false;
    }
    this.track = [[]];
    const run = (this.run = {});
    this.begin(run, map, camera).catch((error) => this.end(run, error));
    return true;
  }

  stop() {
    const run = this.run;
    this.run = null;
    run?.socket?.close(1000);
  }

  end(run, error) {
    if (this.run !== run) return;
    this.stop();
    this.told.failed(error);
    this.told.ended();
  }

  async begin(run, map, camera) {
    const socket = (run.socket = new WebSocket(streamAddress(map), subprotocols()));
    socket.onopen = () => {
      socket.send(JSON.stringify({ camera }));
      this.next(run);
    };
    socket.onmessage = (event) => this.hear(run, JSON.parse(event.data));
    socket.onclose = (event) => this.end(run, new Error(event.reason || "The stream has ended."));
  }

  async next(run) {
    const file = await this.picture();
    if (this.run === run && run.socket.readyState === WebSocket.OPEN) run.socket.send(file);
  }

  hear(run, answer) {
    if (this.run !== run) return;
    if (answer.error) return this.end(run, new Error(answer.error));
    if (answer.smoothed) this.track.at(-1).push(answer.smoothed.translation);
    else if (this.track.at(-1).length) this.track.push([]);
    if (this.track.at(-1).length > MAX_TRACK) this.track = [this.track.at(-1).slice(-MAX_TRACK / 2)];
    this.told.said(answer, this.track);
    this.next(run);
  }
}
