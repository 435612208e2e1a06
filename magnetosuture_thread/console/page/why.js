// Why the needle does not move: the most important text on the page. First what has to be mended first.

import { capital, isNumber, length, plural, seconds, speedText } from "./format.js";

export const SILENT = 1.0; // [s] a bridge or a needle that is silent for longer is not to be trusted
const MOVES = 5e-5; // [m/s]

// view: {link: "open"|"closed"|"connecting", since: s, graph, host, lease, me, commands, held}
// Returns {level, headline, reasons}.
export function whyAtRest(view) {
  const { link, since, graph, host, lease } = view;
  if (link === "closed") return verdict("error", "Not connected: this page steers and stops nothing", ["Connecting again. Steering has to be taken anew."]);
  if (!graph) return verdict("silent", "Nothing heard from the server yet", []);
  if (since > SILENT) return verdict("error", `Nothing heard from the server for ${seconds(since)}`, ["What is drawn is old. What was held has been let go."]);
  const bridge = graph.bridge;
  const stopped = bridge?.emergency_stopped;
  if (stopped) return verdict("error", "Emergency stop is pressed", ["The bridge holds all coils at zero. To go on: Reset, then Arm.", ...others(bridge, ["emergency stop"])]);
  if (host?.busy) return verdict("warn", capital(host.busy), ["Please wait."]);
  if (host?.paused) return verdict("warn", "Paused: time stands still", []);
  if (!bridge) return verdict("silent", "Nothing heard from the coil bridge yet", host?.mode === "replay" ? ["A bag is replayed."] : []);
  if (bridge.age + since > SILENT) return verdict("error", `Coil bridge silent for ${seconds(bridge.age + since)}`, ["Where its node runs, and the network, need a look."]);
  if (bridge.state === "fault") return verdict("error", `Fault: ${first(bridge.reasons, "the coil bridge does not say why")}`, [...bridge.reasons.slice(1), "To go on: Reset, then Arm."]);
  if (bridge.state !== "active") return verdict("warn", `Coil bridge is ${bridge.state}`, others(bridge, [bridge.state]));
  if (!bridge.driver_ready) return verdict("error", `Driver ${bridge.driver} is not ready`, others(bridge, []));
  if (!bridge.armed) return verdict("warn", "Disarmed: press Arm to let commands pass", others(bridge, ["disarmed"]));
  const tracker = graph.tracker;
  if (tracker && tracker.state !== "tracked") return verdict("error", `Needle ${tracker.state}${tracker.reason ? `: ${tracker.reason}` : ""}`, others(bridge, []));
  if (graph.needle && graph.needle.age + since > SILENT) return verdict("error", `No needle pose for ${seconds(graph.needle.age + since)}`, others(bridge, []));
  const filter = graph.filter && graph.filter.age + since < SILENT ? graph.filter : null;
  const filtered = length(bridge.filtered) ?? 0;
  const applied = length(bridge.applied) ?? 0;
  if (filtered > MOVES) return moving(applied, bridge, filter, graph);
  if (filter && (length(filter.commanded) ?? 0) > MOVES) {
    const why = filter.reason || (filter.active.length ? `held by ${filter.active.join(", ")}` : "");
    return verdict("warn", why ? `The needle rests: ${why}` : "The needle rests", others(bridge, [filter.reason]));
  }
  if (view.held) return verdict("warn", "A key is held, but nothing has come of it", others(bridge, []));
  if (lease && lease.holder === view.me) return verdict("rest", "Ready: nothing is held", ["Hold an arrow key, or drag from the needle."]);
  const who = lease?.holder === null ? "Nobody steers" : `Page ${lease?.holder} steers`;
  return verdict("rest", `The needle rests: ${who.toLowerCase()}`, [view.commands ? "Take steering to move it." : "This page only watches: it was opened without the token."]);
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
  return verdict(notes.length ? "warn" : "ok", `Moving at ${speedText(applied)}`, notes);
}

const first = (list, otherwise) => list?.[0] ?? otherwise;
const verdict = (level, headline, reasons) => ({ level, headline, reasons });

// The bridge's own reasons that are not said yet.
function others(bridge, said) {
  const left = (bridge?.reasons ?? []).filter((reason) => !said.includes(reason));
  return left.length ? [`The bridge says: ${left.join("; ")}.`] : [];
}
