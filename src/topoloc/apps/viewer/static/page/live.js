// A stream of the camera's pictures that the service follows: one on the way at a time, so that no line forms.
import { openRequests, openSocket } from "topoloc/page/asking";

const MAX_TRACK = 6000; // positions that are drawn
const MAX_FAULTS = 5; // one after the other
const PAUSE_MS = 400;

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const shown = () => document.hidden && new Promise((resolve) => document.addEventListener("visibilitychange", resolve, { once: true }));

export class Live {
  /** `told.took(picture)` may add to each picture that is taken; `told.said(answer, picture, track)` gets its answer, and the way so far
   * in lines; `told.waits(error)` why there is none for a moment, `told.failed(error)` for good. */
  constructor(webcam, told) {
    [this.webcam, this.told, this.run, this.track] = [webcam, told, null, [[]]];
  }

  start(map, camera) {
    this.stop();
    this.track = [[]];
    const run = (this.run = { map, camera, link: null, open: openSocket });
    this.follow(run).catch((error) => {
      if (this.run !== run) return;
      this.stop();
      this.told.failed(error);
    });
  }

  stop() {
    this.run?.link?.close();
    this.run = null;
  }

  async follow(run) {
    for (let faults = 0; this.run === run; ) {
      await shown();
      try {
        run.link ??= await this.opened(run);
        const picture = await this.webcam.next();
        if (this.run !== run) return;
        this.told.took(picture);
        const answer = await run.link.ask(picture);
        faults = 0;
        if (this.run === run) this.hear(answer, picture);
      } catch (error) {
        if (this.run !== run) return;
        if (error.isOver || error.status === 404) run.link = null;
        if (++faults >= MAX_FAULTS || [401, 403, 422].includes(error.status)) throw error;
        this.told.waits(error);
        await pause(1000 * (error.retryAfterS ?? 0) || PAUSE_MS);
      }
    }
  }

  /** A stream over a WebSocket; over requests where that fails, as with some certificates. */
  async opened(run) {
    const link = await run.open(run.map, run.camera).catch((error) => {
      if (run.open === openRequests) throw error;
      run.open = openRequests;
      return openRequests(run.map, run.camera);
    });
    if (this.run !== run) link.close();
    return link;
  }

  hear(answer, picture) {
    if (answer.smoothed) this.track.at(-1).push(answer.smoothed.translation);
    else if (this.track.at(-1).length) this.track.push([]);
    if (this.track.at(-1).length > MAX_TRACK) this.track = [this.track.at(-1).slice(-MAX_TRACK / 2)];
    this.told.said(answer, picture, this.track);
  }
}
