// What lies over a scene: a bar of so many metres, and the directions of the world's axes.
import { Vector3 } from "three";
import { AXIS_COLOURS } from "topoloc/objects";
import { roundLengthText } from "topoloc/words";

const MAX_BAR_PX = 120;
const ARM_PX = 24;

/** Keep `bar` (an element) and `axes` (an svg) right as the stage is drawn. */
export function showScale(stage, bar, axes) {
  const arms = AXIS_COLOURS.map((colour, k) => {
    const arm = document.createElementNS(axes.namespaceURI, "g");
    arm.innerHTML = `<line stroke="${colour}" stroke-width="2.5" stroke-linecap="round"/><text dy="4">${"xyz"[k]}</text>`;
    return arm;
  });
  stage.onDraw = () => {
    const metresPerPixel = stage.metresPerPixel();
    const most = metresPerPixel * MAX_BAR_PX;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = power * ([5, 2].find((one) => one * power <= most) ?? 1);
    bar.style.width = `${length / metresPerPixel}px`;
    bar.textContent = roundLengthText(length);
    const ends = arms.map((_, k) => new Vector3().setFromMatrixColumn(stage.camera.matrixWorldInverse, k));
    arms.forEach((arm, k) => {
      const [line, text] = arm.children;
      line.setAttribute("x2", ARM_PX * ends[k].x);
      line.setAttribute("y2", -ARM_PX * ends[k].y);
      text.setAttribute("x", (ARM_PX + 9) * ends[k].x);
      text.setAttribute("y", -(ARM_PX + 9) * ends[k].y);
    });
    axes.replaceChildren(...[...arms].sort((a, b) => ends[arms.indexOf(a)].z - ends[arms.indexOf(b)].z)); // the nearest in front
  };
  stage.draw();
}
