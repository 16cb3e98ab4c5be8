// A picture beside a node of the map, with lines between what was matched.

const GAP = 6;
const MAX_LINES = 60;

/** Draw both, of which the addresses are given; `compared` is one of explain's poses with its matches. */
export async function drawMatches(canvas, pictureAddress, pictureSize, nodeAddress, compared) {
  const [left, right] = await Promise.all([loaded(pictureAddress), loaded(nodeAddress)]);
  const height = 300;
  const widths = [pictureSize, compared.node_size].map(([w, h]) => Math.round((w * height) / h));
  canvas.width = widths[0] + GAP + widths[1];
  canvas.height = height;
  const context = canvas.getContext("2d");
  if (left) context.drawImage(left, 0, 0, widths[0], height);
  if (right) context.drawImage(right, widths[0] + GAP, 0, widths[1], height);
  const isAnswer = compared.verdict === "the answer";
  context.strokeStyle = context.fillStyle = isAnswer ? "#26d0b4" : "#ff6b86";
  context.lineWidth = 1.2;
  const step = Math.max(1, compared.matches.length / MAX_LINES);
  for (let i = 0; i < compared.matches.length; i += step) {
    const [u, v, x, y] = compared.matches[Math.floor(i)];
    const start = [((u + 0.5) / pictureSize[0]) * widths[0], ((v + 0.5) / pictureSize[1]) * height];
    const end = [widths[0] + GAP + ((x + 0.5) / compared.node_size[0]) * widths[1], ((y + 0.5) / compared.node_size[1]) * height];
    context.globalAlpha = 0.55;
    context.beginPath();
    context.moveTo(...start);
    context.lineTo(...end);
    context.stroke();
    context.globalAlpha = 1;
    for (const [a, b] of [start, end]) context.fillRect(a - 1.5, b - 1.5, 3, 3);
  }
}

/** The picture, or null where this browser cannot show it. */
function loaded(address) {
  return new Promise((resolve) => {
    if (!address) return resolve(null);
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => resolve(null);
    image.src = address;
  });
}
