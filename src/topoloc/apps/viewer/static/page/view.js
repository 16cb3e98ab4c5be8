// The live camera with the map over its image: full screen on a phone, beside the scene elsewhere.
import { Live } from "topoloc/page/live";
import { nodeOf, Sight } from "topoloc/page/sight";
import { Motion, Webcam } from "topoloc/page/webcam";
import { isLocalized, lengthText, verdict } from "topoloc/words";

const RATE_MS = 3000; // over which answers are counted
const SAID_MS = 4000;
const CLICK_PX = 10;

export class LiveView {
  /** `told.said(answer, track)` gets each answer, `told.ended()` the end, `told.failed(error)` why it does not begin again; `told.wanted(file)` an image that is to be explained;
   * `told.written(position)` and `told.read(note)` what is tapped. */
  constructor(section, told) {
    Object.assign(this, { section, told, times: [], heldUntil: 0 });
    this.part = (name) => section.querySelector(`[data-part="${name}"]`);
    this.webcam = new Webcam(section.querySelector("video"));
    this.motion = new Motion();
    this.sight = new Sight(this.part("sight"), this.webcam, this.motion);
    this.live = new Live(this.webcam, {
      took: (picture) => (picture.turn = this.motion.now()),
      said: (answer, picture, track) => this.hear(answer, picture, track),
      waits: (error) => this.say(error.message, 0, "bad"),
      failed: (error) => this.fail(error),
    });
    this.listen();
  }

  listen() {
    const press = (name, on) => this.part(name).setAttribute("aria-pressed", String(on));
    this.part("close").addEventListener("click", () => this.close());
    this.part("again").addEventListener("click", () => this.open(this.map, this.camera).catch(this.told.failed));
    this.part("explain").addEventListener("click", () => {
      const { file } = this.webcam.picture();
      this.close();
      this.told.wanted(file);
    });
    this.part("points").addEventListener("click", () => {
      Object.assign(this.sight, { showsPoints: !this.sight.showsPoints, isStale: true });
      press("points", this.sight.showsPoints);
    });
    this.part("beside").addEventListener("click", () => press("beside", document.body.classList.toggle("with-map")));
    let down = null;
    this.part("sight").addEventListener("pointerdown", (event) => (down = [event.clientX, event.clientY]));
    this.part("sight").addEventListener("click", (event) => {
      const moved = down ? Math.hypot(event.clientX - down[0], event.clientY - down[1]) : 0;
      if (moved <= CLICK_PX) this.tap(event.offsetX, event.offsetY);
    });
  }

  /** To be called from a tap, as iOS lends its motion sensor to taps alone. */
  async open(map, camera) {
    this.live.stop();
    this.webcam.close();
    const sensor = this.motion.start();
    Object.assign(this, { map, camera });
    this.section.hidden = false;
    document.body.classList.add("live");
    this.say("Starting the camera ...");
    try {
      await this.webcam.open();
    } catch (error) {
      this.close();
      throw error;
    }
    this.sight.start();
    this.follow();
    if (!(await sensor)) this.say("Without the motion sensor, the image stands still between two answers.", SAID_MS);
  }

  follow() {
    this.part("again").hidden = true;
    this.times = [];
    this.sight.forget();
    this.say("Localizing ...");
    this.live.start(this.map, this.camera);
  }

  close() {
    this.live.stop();
    this.webcam.close();
    this.motion.stop();
    this.sight.forget();
    this.section.hidden = true;
    document.body.classList.remove("live");
    this.told.ended();
  }

  hear(answer, picture, track) {
    const now = performance.now();
    this.times = [...this.times.filter((time) => now - time < RATE_MS), now];
    this.sight.see(answer, picture);
    const [first] = this.times;
    const rate = this.times.length > 1 ? `, ${((1000 * (this.times.length - 1)) / (now - first)).toFixed(0)} a second` : "";
    const said = isLocalized(answer) ? `Here to ${lengthText(answer.position_sigma_m)} (σ)${rate}` : verdict(answer);
    if (now > this.heldUntil) this.say(said, 0, isLocalized(answer) ? "good" : "bad");
    this.told.said(answer, track);
  }

  fail(error) {
    this.sight.forget();
    this.say(error.message, 0, "bad");
    this.part("again").hidden = false;
  }

  /** Show a sentence, for at least `ms`. */
  say(text, ms = 0, kind = "") {
    Object.assign(this.part("seen"), { textContent: text, className: kind });
    this.heldUntil = performance.now() + ms;
  }

  tap(x, y) {
    const note = this.sight.noteAt(x, y);
    if (note) return this.told.read(note);
    try {
      this.told.written(this.sight.placeAt(x, y));
    } catch (error) {
      this.say(error.message, SAID_MS, "bad");
    }
  }

  /** The map that is drawn over the image: points [x, y, z, ...], nodes as the scene has them. */
  setMap(points, nodes, depth) {
    this.sight.setMap(points, nodes.map((node) => nodeOf(node, 0.5 * depth)));
  }

  setNotes(notes) {
    Object.assign(this.sight, { notes, isStale: true });
  }
}
