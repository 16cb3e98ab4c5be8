// Texts of results.

const REASONS = {
  too_few_matches: "Too few features of the image match the map.",
  too_few_inliers: "The matches do not agree on one pose.",
  imprecise: "The place is known, but not precisely enough.",
  ambiguous: "Several similar places are possible.",
  not_in_map: "The image is probably out of the map.",
  jump: "It contradicts the previous images.",
  unreadable: "The image cannot be used.",
};
const STATES = {
  localized: "localized in the map",
  tracked: "tracked from the previous image",
  predicted: "predicted from the motion",
  ambiguous: "one of several places",
  lost: "lost",
};

const MAX_ERROR = 0.5; // metres; an answer further off is a false accept

export function lengthText(metres) {
  if (metres === undefined) return "a length without scale"; // of a map without scale
  if (metres >= 1) return `${metres.toFixed(2)} m`;
  if (metres >= 0.001) return `${(100 * metres).toFixed(metres < 0.1 ? 1 : 0)} cm`;
  return `${(1000 * metres).toFixed(1)} mm`;
}

/** The text of a length that is a round number. */
export function roundLengthText(metres) {
  const [unit, size] = [["km", 1000], ["m", 1], ["cm", 0.01]].find(([, one]) => metres >= 0.999 * one) ?? ["mm", 0.001];
  return `${Number((metres / size).toPrecision(2))} ${unit}`;
}

export const pointText = (p) => `(${p.map((value) => value.toFixed(2)).join(", ")}) m`;

/** Whether a result has a pose of its own. */
export const isLocalized = (result) => result.localized === true;

/** Return the result in one line. */
export function verdict(result) {
  if (result.state === "predicted") return "Not localized; the pose is predicted from the motion.";
  if (!isLocalized(result)) return `Not localized. ${REASONS[result.reason] ?? result.reason ?? ""}`;
  const doubt = errorOf(result) > MAX_ERROR ? "Wrong pose" : result.probability < 0.9 ? "Probably here" : "Here";
  return `${doubt}, at ${pointText(result.world_from_cam.translation)}.`;
}

/** Return further facts, one sentence each. */
export function sentences(result) {
  const said = [];
  if (result.state) said.push(`State of the stream: ${STATES[result.state] ?? result.state}.`);
  if (isLocalized(result)) {
    const sigmas = `${lengthText(result.position_sigma_m)} and ${result.rotation_sigma_deg.toFixed(2)}°`;
    said.push(`Standard deviation ${sigmas}, probability ${result.probability.toFixed(2)}.`);
    if (result.num_matches) said.push(`${result.num_inliers} of ${result.num_matches} matches agree, most with node ${result.node}.`);
    if (result.focal_length_px) said.push(`Estimated focal length: ${result.focal_length_px.toFixed(0)} pixels.`);
    if (result.calibration_doubt) said.push("The image contradicts its calibration: the pose is by the camera that it shows.");
    const earth = result.geopose?.position;
    if (earth) said.push(`On earth: ${earth.lat.toFixed(7)}°, ${earth.lon.toFixed(7)}°, height ${earth.h.toFixed(1)} m.`);
  } else {
    if (result.detail) said.push(`${result.detail[0].toUpperCase()}${result.detail.slice(1)}.`.replace(/\.\.$/, "."));
    for (const [i, one] of (result.alternatives ?? []).entries()) {
      const place = `${pointText(one.world_from_cam.translation)}, near node ${one.node}`;
      said.push(`Alternative ${i + 1}: ${place}, probability ${one.probability.toFixed(2)}.`);
    }
    if (result.num_matches) said.push(`${result.num_inliers} of ${result.num_matches} matches agreed on a pose.`);
  }
  const error = errorOf(result);
  if (error !== null) said.push(`Error: ${lengthText(error)}.`);
  else if (result.true_world_from_cam) said.push(`The true position is ${pointText(result.true_world_from_cam.translation)}.`);
  else if (result.true_world_from_cam === null) {
    said.push(`The image is out of the map: ${isLocalized(result) ? "this pose is false" : "rightly rejected"}.`);
  }
  const times = timesText(result.times_ms);
  if (times) said.push(times);
  return said;
}

/** Return the error in metres, null without a pose or truth. */
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
