// Status headline: whether the needle moves, and why not. The first matching reason is the first to resolve.

import { capital, isNumber, length, plural, seconds, speedText } from "./format.js";

export const SILENCE_TIMEOUT = 1.0; // [s] after which states of bridge and needle are stale
const MIN_SPEED = 5e-5; // [m/s]

// view: {link: "open"|"closed"|"connecting", since: s, graph, host, lease, client, canCommand, jogging}
// Returns {level, headline, reasons}.
export function motionStatus(view) {
  const { link, since, graph, host, lease } = view;
  if (link === "closed") return result("error", "Not connected: this page can neither jog nor stop the needle", ["Reconnecting. Control must be taken again."]);
  if (!graph) return result("silent", "No data from the server yet", []);
  if (since > SILENCE_TIMEOUT) return result("error", `No data from the server for ${seconds(since)}`, ["The drawing is old. The jog has ended."]);
  const bridge = graph.bridge;
  const stopped = bridge?.emergency_stopped;
  if (stopped) return result("error", "Emergency stop is pressed", ["The bridge keeps all coils at zero. To resume: Reset, then Arm.", ...others(bridge, ["emergency stop"])]);
  if (host?.busy) return result("warn", capital(host.busy), ["Please wait."]);
  if (host?.paused) return result("warn", "Paused", []);
  if (!bridge) return result("silent", "No data from the coil bridge yet", host?.mode === "replay" ? ["A bag is replayed."] : []);
  if (bridge.age + since > SILENCE_TIMEOUT) return result("error", `Coil bridge silent for ${seconds(bridge.age + since)}`, ["Check its node and the network."]);
  if (bridge.state === "fault") return result("error", `Fault: ${first(bridge.reasons, "no reason given")}`, [...bridge.reasons.slice(1), "To resume: Reset, then Arm."]);
  if (bridge.state !== "active") return result("warn", `Coil bridge is ${bridge.state}`, others(bridge, [bridge.state]));
  if (!bridge.driver_ready) return result("error", `Driver ${bridge.driver} is not ready`, others(bridge, []));
  if (!bridge.armed) return result("warn", "Disarmed: press Arm to enable commands", others(bridge, ["disarmed"]));
  const tracker = graph.tracker;
  if (tracker && tracker.state !== "tracked") return result("error", `Needle ${tracker.state}${tracker.reason ? `: ${tracker.reason}` : ""}`, others(bridge, []));
  if (graph.needle && graph.needle.age + since > SILENCE_TIMEOUT) return result("error", `No needle pose for ${seconds(graph.needle.age + since)}`, others(bridge, []));
  const filter = graph.filter && graph.filter.age + since < SILENCE_TIMEOUT ? graph.filter : null;
  const filtered = length(bridge.filtered) ?? 0;
  const applied = length(bridge.applied) ?? 0;
  if (filtered > MIN_SPEED) return moving(applied, bridge, filter, graph);
  if (filter && (length(filter.commanded) ?? 0) > MIN_SPEED) {
    const why = filter.reason || (filter.active.length ? `stopped by ${filter.active.join(", ")}` : "");
    return result("warn", why ? `At rest: ${why}` : "At rest", others(bridge, [filter.reason]));
  }
  if (view.jogging) return result("warn", "Jogging, but no command has arrived", others(bridge, []));
  if (lease && lease.holder === view.client) return result("rest", "Ready to jog", ["Hold an arrow key, or drag from the needle."]);
  const holder = lease?.holder === null ? "no page" : `page ${lease?.holder}`;
  return result("rest", `At rest: ${holder} has control`, [view.canCommand ? "Take control to move the needle." : "This page only watches: it was opened without the token."]);
}

function moving(applied, bridge, filter, graph) {
  const notes = [];
  const friction = graph.margins?.valid ? graph.margins.friction : null;
  const slowdown = filter?.slowdown ?? 1;
  if (isNumber(slowdown) && slowdown < 0.999) {
    const count = friction?.nodes.length ?? 0;
    notes.push(`Slowed to ${(100 * slowdown).toFixed(0)} % by friction${count ? ` at ${plural(count, "node")}` : ""}.`);
  }
  const limits = (filter?.active ?? []).filter((name) => name !== "friction");
  if (limits.length) notes.push(`Limited by ${limits.join(", ")}.`);
  if (filter?.overridden) notes.push(`Commands of the input ${filter.overridden} are overridden.`);
  if (bridge.saturated) notes.push("The coils are at their limit.");
  return result(notes.length ? "warn" : "ok", `Moving at ${speedText(applied)}`, notes);
}

const first = (list, otherwise) => list?.[0] ?? otherwise;
const result = (level, headline, reasons) => ({ level, headline, reasons });

// Reasons of the bridge that are not shown yet.
function others(bridge, shown) {
  const left = (bridge?.reasons ?? []).filter((reason) => !shown.includes(reason));
  return left.length ? [`Coil bridge: ${left.join("; ")}.`] : [];
}
