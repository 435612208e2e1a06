// What the colours mean. Each stands beside a word or a shape that says the same.

export const FREE = "#12a150";
export const STUCK = "#2f6bff";
export const GREY = "#7d8790";
export const MEASURED = "rgba(47, 123, 255, 0.40)";
export const ESTIMATED = "#00a3a8";
export const MODEL = "#99107f"; // the prediction by the model alone, beside an estimate
export const AHEAD = "#6d28d9"; // the forecast thread
export const VELOCITY = "#7a3fc0";
export const NEAR = "#d1122f";
export const MIDDLING = "#f08c00";
export const COILS = ["#0f6fc6", "#c2570c", "#7b3fb5", "#0b8a7c"];

// The same on dark ground.
const ON_DARK = {
  [FREE]: "#3fcf7d", [STUCK]: "#82a8ff", [VELOCITY]: "#b992f5", [AHEAD]: "#a78bfa", [MIDDLING]: "#ffab3d",
  "#0f6fc6": "#5db1f7", "#c2570c": "#ff9d5c", "#7b3fb5": "#c79bf2", "#0b8a7c": "#4fc7b8",
};
export const onGround = (colour, dark) => (dark ? ON_DARK[colour] ?? colour : colour);

const LIGHTEST = [255, 164, 27];
const DEEPEST = [185, 58, 6];
const DEEPEST_AT = 8; // nodes in friction

// Orange, deeper with the number of nodes in friction.
export function sliding(count) {
  const share = Math.min(1, Math.max(0, count - 1) / (DEEPEST_AT - 1));
  const mixed = LIGHTEST.map((entry, at) => Math.round(entry + share * (DEEPEST[at] - entry)));
  return `#${mixed.map((entry) => entry.toString(16).padStart(2, "0")).join("")}`;
}

export const OLD = 0.5; // [s] a thread that is older is drawn as not valid
export const UNMEASURED = 0.3; // [s] an estimate that was not measured for longer is shown as a prediction only

// The thread that the margins are of: the estimated one where there is one, else the predicted one.
export const threadOf = (graph) => (graph?.margins?.of === "estimate" && graph.estimated ? graph.estimated : graph?.predicted);

// none, measured, or prediction: what the estimate is now.
export function estimateState({ estimated } = {}, since) {
  if (!estimated || estimated.age + since > OLD) return "none";
  return estimated.prediction_only && estimated.unmeasured_for + since > UNMEASURED ? "prediction" : "measured";
}

// The forecast from the present estimate; null where there is none.
export const forecastOf = ({ forecast } = {}, since) => (forecast && forecast.age + since <= OLD ? forecast : null);

// State and colour of the thread: free, sliding, stuck, unknown, invalid or old.
export function threadLook(thread, margins, since) {
  if (!thread) return { state: "none", colour: GREY };
  if (thread.age + since > OLD) return { state: "old", colour: GREY };
  if (!margins || !margins.valid) return { state: "invalid", colour: GREY };
  const { state, nodes } = margins.friction;
  const colour = { free: FREE, sliding: sliding(nodes.length), stuck: STUCK }[state];
  return colour ? { state, colour } : { state: "unknown", colour: GREY };
}

// Tension of a segment [N] against the peak of the thread: from pale to deep violet; blue where it is compressed.
const SLACK = [206, 196, 232];
const TAUT = [94, 8, 150];
export function tensionColour(tension, peak) {
  if (tension < 0) return STUCK;
  const share = peak > 0 ? Math.min(1, tension / peak) : 0;
  return `rgb(${SLACK.map((entry, at) => Math.round(entry + share * (TAUT[at] - entry))).join(",")})`;
}

// A node by its clearance [m]: red below 0.3 mm, orange below 1 mm, green beyond; larger the nearer.
export function nodeLook(clearance, valid) {
  if (!valid) return { colour: GREY, radius: 2 };
  if (clearance === null || clearance === undefined || clearance >= 1e-3) return { colour: FREE, radius: 2 };
  return clearance < 3e-4 ? { colour: NEAR, radius: 3.4 } : { colour: MIDDLING, radius: 2.8 };
}
