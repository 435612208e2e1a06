// Status headline: whether the needle moves, and why not. The first matching reason is the first to resolve, and a command
// that yields no motion always has one.

import { SILENCE_TIMEOUT } from "./connection.js";
import { capital, isNumber, length, plural, seconds, speedText } from "./format.js";

const NODE_TIMEOUT = 3.0; // [s] after which the diagnostics of a node are
const MIN_SPEED = 1e-5; // [m/s]
const MIN_REAL_TIME_FACTOR = 0.9; // below which a machine is too slow

// view: {link: "open"|"closed"|"connecting", since: s, graph, host, lease, client, canCommand, jogging, stale, late: s}
// `stale`: a key is held that has to be released first; `late`: delay of a jog message that came too late, else 0.
// Returns {level, headline, reasons}.
export function motionStatus(view) {
  const { link, since, graph, host } = view;
  if (link === "closed") return result("error", "Not connected: this page can neither jog nor stop the needle", ["Reconnecting. Control must be taken again."]);
  if (!graph) return result("silent", "No data from the server yet", []);
  if (since > SILENCE_TIMEOUT) return result("error", `No data from the server for ${seconds(since)}`, ["The drawing is old. The jog has ended."]);
  const bridge = graph.bridge;
  const { name, state } = host?.measurement ?? {};
  // It presses the emergency stop itself, and lets the bridge stand still.
  if (name === "commission" && state === "running") return result("rest", "The rig commissions itself", ["Cancel, Disarm and the emergency stop end it."]);
  if (bridge?.emergency_stopped) return result("error", "Emergency stop is pressed", ["The bridge keeps all coils at zero. To resume: Reset, then Arm.", ...others(bridge, ["emergency stop"])]);
  if (host?.busy) return result("silent", capital(host.busy), ["Please wait."]);
  if (host?.paused) return result("rest", "Paused", []);
  const blocked = bridgeStatus(view) ?? perceptionStatus(view);
  if (blocked) return blocked;
  const { level, headline, reasons } = readiness(view) ?? (speeds(view).applied > MIN_SPEED ? moving(view) : resting(view));
  return result(level, headline, [slowness(view), ...reasons].filter(Boolean));
}

// What a machine cannot keep up with, and what to do; empty where it can, or while nodes start.
export function slowness({ graph, host }) {
  const { real_time_factor: factor = 1, skipped = 0 } = graph?.nodes?.rig_simulator?.values ?? {};
  if (host?.busy || !(Number(factor) < MIN_REAL_TIME_FACTOR)) return "";
  return `Simulated time runs at ${(100 * factor).toFixed(0)} %, with ${plural(Number(skipped), "frame")} skipped: close other programs.`;
}

function bridgeStatus({ since, graph: { bridge }, host }) {
  if (!bridge) return result("silent", "No data from the coil bridge yet", host?.mode === "replay" ? ["A bag is replayed."] : []);
  if (bridge.age + since > SILENCE_TIMEOUT) return result("error", `Coil bridge silent for ${seconds(bridge.age + since)}`, ["Check its node and the network."]);
  if (bridge.state === "fault") return result("error", `Fault: ${first(bridge.reasons, "no reason given")}`, [...bridge.reasons.slice(1), "To resume: Reset, then Arm."]);
  if (bridge.state !== "active") return result("warn", `Coil bridge is ${bridge.state}`, others(bridge, [bridge.state]));
  return null;
}

// The needle's axis where nothing tells which end is its tip, else null.
export function undirectedAxis(graph, since) {
  return graph?.axis && graph.axis.age + since <= SILENCE_TIMEOUT ? graph.axis : null;
}

function perceptionStatus({ since, graph, host }) {
  const { bridge, tracker, needle, camera } = graph;
  const age = (part) => (part?.age ?? 0) + since;
  if (undirectedAxis(graph, since)) return result("warn", "Which end of the needle is the tip?", ["Take control, then click on the tip.", ...others(bridge, [])]);
  if (tracker && tracker.state !== "tracked" && age(tracker) <= SILENCE_TIMEOUT) {
    const unfound = tracker.state === "searching" && !needle;
    return result(unfound ? "silent" : "error", `Needle ${tracker.state}${tracker.reason ? `: ${tracker.reason}` : ""}`, others(bridge, []));
  }
  const rig = graph.nodes?.rig_simulator;
  const again = host?.mode === "simulated" ? "If that does not help: Start again." : "Check its node.";
  if (rig && (rig.level === "silent" || age(rig) > NODE_TIMEOUT)) return result("error", `Simulator silent for ${seconds(age(rig))}`, [again]);
  if (rig?.level === "error") return result("error", `Simulator: ${rig.message}`, [`To resume: Disarm, then Arm. ${again}`]);
  const unseen = !needle || age(needle) > SILENCE_TIMEOUT;
  if (unseen && camera && age(camera) > SILENCE_TIMEOUT) return result("error", `Camera silent for ${seconds(age(camera))}`, ["Check its node and cable."]);
  if (needle && unseen) return result("error", `No needle pose for ${seconds(age(needle))}`, others(bridge, []));
  return null;
}

function readiness({ graph, late }) {
  const { bridge } = graph;
  if (!bridge.driver_ready) return result("error", `Driver ${bridge.driver} is not ready`, others(bridge, []));
  if (late) return result("error", `Computer or network late: key presses come ${seconds(late)} late`, ["The needle rests until they come in time.", ...others(bridge, [])]);
  if (graph.nodes?.coil_bridge?.values?.commissioning === "True") return result("rest", "The coil bridge commissions: it follows no jog", others(bridge, []));
  if (!bridge.armed) return result("rest", "Disarmed: press Arm to enable commands", others(bridge, ["disarmed"]));
  return null;
}

// Speeds [m/s] of the latest of both messages that tell them.
function speeds({ since, graph: { bridge, filter } }) {
  const both = [bridge, filter && filter.age + since < SILENCE_TIMEOUT ? filter : null];
  const speed = (name) => Math.max(...both.map((part) => length(part?.[name]) ?? 0));
  return { commanded: speed("commanded"), filtered: speed("filtered"), applied: speed("applied") };
}

function resting(view) {
  const { since, graph, host, lease, client, canCommand, jogging, stale } = view;
  const { bridge } = graph;
  const filter = graph.filter && graph.filter.age + since < SILENCE_TIMEOUT ? graph.filter : null;
  const { commanded, filtered } = speeds(view);
  if (commanded > MIN_SPEED) {
    const why = filter?.reason || bridge.reasons[0] || restingAt(filter, bridge, filtered);
    return result(host?.mode === "replay" ? "rest" : "warn", `At rest: ${why}`, others(bridge, [why]));
  }
  if (stale || (jogging && lease?.release_first)) return result("warn", "At rest: release the key and press it again", ["It was held while the needle was stopped.", ...others(bridge, [])]);
  if (jogging) return result("warn", "Jogging, but no command has arrived", others(bridge, []));
  if (lease && lease.holder === client) return result("rest", "Ready to jog", ["Hold an arrow key, or drag from the needle."]);
  const holder = lease?.holder === null ? "no page" : `page ${lease?.holder}`;
  return result("rest", `At rest: ${holder} has control`, [canCommand ? "Take control to move the needle." : "This page only watches: it was opened without the token."]);
}

// Why a command yields no motion, where neither filter nor bridge says so.
function restingAt(filter, bridge, filtered) {
  const active = filter?.active ?? [];
  if (active.length) return `stopped by ${active.join(", ")}`;
  if (isNumber(filter?.slowdown) && filter.slowdown < 0.999) return `slowed to ${(100 * filter.slowdown).toFixed(0)} % by friction`;
  if (bridge.saturated) return "the coils are at their limit";
  return filtered > MIN_SPEED ? "the coils give no motion, and the coil bridge gives no reason" : "the filter lets nothing through, and gives no reason";
}

function moving(view) {
  const { graph } = view;
  const { bridge, filter } = graph;
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
  return result(notes.length ? "warn" : "ok", `Moving at ${speedText(speeds(view).applied)}`, notes);
}

const first = (list, otherwise) => list?.[0] ?? otherwise;
const result = (level, headline, reasons) => ({ level, headline, reasons });

// Reasons of the bridge that are not shown yet.
function others(bridge, shown) {
  const left = (bridge?.reasons ?? []).filter((reason) => !shown.includes(reason));
  return left.length ? [`Coil bridge: ${left.join("; ")}.`] : [];
}
