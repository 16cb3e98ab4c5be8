// What a result means, in words.

const REASONS = {
  too_few_matches: "Too little of the picture was recognised in the map.",
  too_few_inliers: "What was recognised does not agree on one place.",
  ambiguous: "It may be one of several places that look alike.",
  not_in_map: "It was not taken in this map, as far as the map shows.",
  jump: "It contradicts the pictures before it.",
  unreadable: "The picture cannot be read.",
};
const STATES = {
  localized: "recognised in the map",
  tracked: "followed from the picture before",
  predicted: "expected from the motion so far",
  ambiguous: "one of several places",
  lost: "lost",
};

const MAX_ERROR = 0.5; // metres; an answer further off is a false accept

export function lengthText(metres) {
  if (metres >= 1) return `${metres.toFixed(2)} m`;
  if (metres >= 0.001) return `${(100 * metres).toFixed(metres < 0.1 ? 1 : 0)} cm`;
  return `${(1000 * metres).toFixed(1)} mm`;
}

export const pointText = (p) => `(${p.map((value) => value.toFixed(2)).join(", ")}) m`;

/** Whether a result has a pose of its own. */
export const isLocalized = (result) => result.localized === true;

/** One line: here, or why not. */
export function verdict(result) {
  if (result.state === "predicted") return "Not seen; the place is what the motion so far lets expect.";
  if (!isLocalized(result)) return `Not localized. ${REASONS[result.reason] ?? result.reason ?? ""}`;
  const doubt = errorOf(result) > MAX_ERROR ? "Wrongly placed" : result.probability < 0.9 ? "Probably here" : "Here";
  return `${doubt}, at ${pointText(result.world_from_cam.translation)}.`;
}

/** What else there is to say, a sentence an item. */
export function sentences(result) {
  const said = [];
  if (result.state) said.push(`State of the stream: ${STATES[result.state] ?? result.state}.`);
  if (isLocalized(result)) {
    const sigmas = `${lengthText(result.position_sigma_m)} and ${result.rotation_sigma_deg.toFixed(2)}°`;
    said.push(`Standard deviation ${sigmas}, probability ${result.probability.toFixed(2)}.`);
    said.push(`${result.num_inliers} of ${result.num_matches} matches agree, most with node ${result.node}.`);
    if (result.focal_length_px) said.push(`Focal length found with the pose: ${result.focal_length_px.toFixed(0)} pixels.`);
    if (result.calibration_doubt) said.push("The picture contradicts its calibration; the uncertainty has paid for it.");
    const earth = result.geopose?.position;
    if (earth) said.push(`On earth: ${earth.lat.toFixed(7)}°, ${earth.lon.toFixed(7)}°, height ${earth.h.toFixed(1)} m.`);
  } else {
    if (result.detail) said.push(`${result.detail[0].toUpperCase()}${result.detail.slice(1)}.`.replace(/\.\.$/, "."));
    for (const [i, one] of (result.alternatives ?? []).entries()) {
      const place = `${pointText(one.world_from_cam.translation)}, near node ${one.node}`;
      said.push(`Alternative ${i + 1}: ${place}, probability ${one.probability.toFixed(2)}.`);
    }
    if (result.num_matches) said.push(`${result.num_inliers} of ${result.num_matches} matches agreed on a place.`);
  }
  const error = errorOf(result);
  if (error !== null) said.push(`Off the truth by ${lengthText(error)}.`);
  else if (result.true_world_from_cam) said.push(`In truth it was taken at ${pointText(result.true_world_from_cam.translation)}.`);
  else if (result.true_world_from_cam === null) {
    said.push(`It was taken elsewhere: ${isLocalized(result) ? "this pose is false" : "rightly rejected"}.`);
  }
  const times = timesText(result.times_ms);
  if (times) said.push(times);
  return said;
}

/** Metres from the truth, null where either is not known. */
export function errorOf(result) {
  if (!isLocalized(result) || !result.true_world_from_cam) return null;
  const [a, b] = [result.world_from_cam.translation, result.true_world_from_cam.translation];
  return Math.hypot(...a.map((value, i) => value - b[i]));
}

function timesText(times) {
  if (!times?.total) return "";
  const parts = Object.entries(times).filter(([stage, ms]) => stage !== "total" && ms >= 0.5).sort((a, b) => b[1] - a[1]).slice(0, 3);
  const most = parts.map(([stage, ms]) => `${stage.replaceAll("_", " ")} ${ms.toFixed(0)}`).join(", ");
  return `It took ${times.total.toFixed(0)} ms${most ? ` (${most})` : ""}.`;
}
