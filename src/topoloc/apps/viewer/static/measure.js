// The distance of two points of a scene that are clicked.
import { Group } from "three";
import * as objects from "topoloc/objects";
import { pointText } from "topoloc/words";

const RADII_PX = [6, 22]; // as clicked, else near it: a finger is not precise

export class Measure {
  /** `cloud` are the points of the map, `places` what else can be chosen: [{centre}]; `said` is the element of the result. */
  constructor(stage, { cloud, places, button, said }) {
    Object.assign(this, { stage, cloud, places, button, said, isOn: false, ends: [], drawn: new Group() });
    stage.scene.add(this.drawn);
    button.addEventListener("click", () => this.toggle(!this.isOn));
  }

  toggle(on) {
    this.isOn = on;
    this.button.setAttribute("aria-pressed", String(on));
    this.stage.canvas.classList.toggle("measuring", on);
    this.said.hidden = !on;
    this.show([]);
  }

  click(x, y) {
    const found = this.nearest(x, y);
    if (!found) return (this.said.textContent = "There is no point of the map. Click on one.");
    this.show(this.ends.length === 1 ? [...this.ends, found] : [found]);
  }

  show(ends) {
    this.ends = ends;
    const [a, b] = ends;
    const words = ["Click on two points of the map.", `From ${a && pointText(a)}: click on the second point.`];
    this.said.textContent = b ? distanceText(a.map((value, k) => b[k] - value)) : words[ends.length];
    objects.dispose(this.drawn);
    this.drawn.clear();
    if (a) this.drawn.add(objects.ruleOf(ends));
    this.stage.draw();
  }

  /** A place at the click, else the point there that is nearest to the eye; null without one. */
  nearest(x, y) {
    for (const radius of RADII_PX) {
      const seen = this.places.map(({ centre }) => ({ centre, at: centre && this.stage.seen(centre) })).filter(({ at }) => at);
      const near = seen.map(({ centre, at }) => ({ centre, px: Math.hypot(at[0] - x, at[1] - y) })).filter(({ px }) => px <= radius);
      if (near.length) return near.reduce((one, other) => (other.px < one.px ? other : one)).centre;
      const point = this.cloud.visible && this.stage.frontPoint(this.cloud.geometry.attributes.position.array, x, y, radius);
      if (point) return point;
    }
    return null;
  }
}

/** A step in metres, [x, y, z], as its length and its parts. */
function distanceText(step) {
  const parts = step.map((value, k) => `${"xyz"[k]} ${value.toFixed(3).replace(/^-(0\.0+)$/, "$1")}`);
  return `${Math.hypot(...step).toFixed(3)} m (${parts.join(", ")})`;
}
