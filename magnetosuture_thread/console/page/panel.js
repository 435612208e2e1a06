// Text beside the dish: states, figures, control. Text is written only where it changed.

import { capital, isNumber, leastClearance, micronewtons, millimetres, plural, seconds } from "./format.js";
import { estimateState, forecastOf, threadOf } from "./colours.js";
import { SILENCE_TIMEOUT } from "./connection.js";
import { motionStatus, slowness } from "./status.js";

const NODE_TIMEOUT = 3.0; // [s]
const KINDS = { connectivity: "Connectivity", compression: "Compression", obstacle: "Obstacle", wall: "Wall" };
const LEVELS = { ok: "ok", warn: "warning", error: "error", silent: "silent" };

const find = (id) => document.getElementById(id);

function write(id, text, level) {
  const element = find(id);
  if (element.textContent !== text) element.textContent = text;
  if (level !== undefined && element.dataset.level !== level) element.dataset.level = level;
}

export function showPanel(view) {
  const { graph, host, lease } = view;
  showStatus(view);
  showLink(view);
  showHost(view);
  showCoils(view);
  showControl(view);
  showVision(view);
  showForecast(view);
  if (graph) {
    showThread(view);
    showNodes(view);
  }
  if (lease) write("pages", `${plural(lease.pages, "page")} watching`);
  find("plan-legend").hidden = !Number(find("dish").dataset.plan ?? 0);
  find("simulated").hidden = !host?.simulated;
  const slow = slowness(view);
  find("slow").hidden = !slow;
  find("slow").title = slow;
}

function showStatus(view) {
  const { level, headline, reasons } = motionStatus(view);
  const status = find("status");
  if (status.dataset.level !== level) status.dataset.level = level;
  write("headline", headline);
  const figures = /[\d.]+/g; // a changing figure is not announced again
  const announcement = find("announcement");
  if (announcement.dataset.text !== headline.replace(figures, "")) {
    announcement.dataset.text = headline.replace(figures, "");
    announcement.textContent = headline;
  }
  write("reasons", reasons.join(" "));
  find("reasons").title = reasons.join(" ");
}

function showLink({ link, since, fps, client, problem }) {
  // Not in the live region, which would be read out at every change.
  write("fps", link === "open" && since <= SILENCE_TIMEOUT ? `${fps} frames/s` : "");
  if (link !== "open") {
    write("link", link === "closed" ? `Disconnected${problem ? `: ${problem}` : ""}` : "Connecting …", link === "closed" ? "error" : "warn");
  } else if (since > SILENCE_TIMEOUT) write("link", `No data for ${seconds(since)}`, "error");
  else write("link", `Connected as page ${client ?? "…"}`, "ok");
}

function showHost({ host, hasControl, open, setups }) {
  const names = host?.setups ?? [];
  const allowed = Boolean(open && hasControl && host && !host.busy);
  setups.show(names, host?.setup ?? "", allowed && names.length > 1, displayName);
  find("again").disabled = !(allowed && names.includes(host.setup));
  const pause = find("pause");
  pause.disabled = !(allowed && host.can_pause);
  pause.setAttribute("aria-pressed", String(Boolean(host?.paused)));
  write("pause", host?.paused ? "Resume" : "Pause");
  const record = find("record");
  record.disabled = !(allowed && host.can_record);
  record.setAttribute("aria-pressed", String(Boolean(host?.recording)));
  write("record", host?.recording ? "End recording" : "Record");
  write("recording", host?.busy ? capital(host.busy) : host?.recording ? `Recording to ${host.recording}` : "");
}

// Display name of a setup, also of one that is a path.
const displayName = (name) => name.split("/").pop().replace(/\.yaml$/, "").replaceAll("_", " ");

function showCoils({ graph, host, since, canCommand, hasControl, open }) {
  const bridge = graph?.bridge;
  const fresh = bridge && bridge.age + since <= SILENCE_TIMEOUT;
  const armed = Boolean(bridge?.armed);
  const latched = Boolean(bridge?.emergency_stopped || bridge?.state === "fault");
  if (!bridge) write("coils", "no data", "silent");
  else if (!fresh) write("coils", `silent for ${seconds(bridge.age + since)}`, "silent");
  else if (bridge.emergency_stopped) write("coils", "emergency stop", "error");
  else if (bridge.state === "fault") write("coils", "fault", "error");
  else if (bridge.state !== "active") write("coils", bridge.state, "silent");
  else write("coils", armed ? "armed" : "disarmed", armed ? "ok" : "rest");
  find("stop").disabled = open && !canCommand;
  find("arm").disabled = !(open && hasControl && !host?.busy && bridge && !armed && !latched && bridge.driver_ready && bridge.state === "active");
  find("disarm").disabled = !(open && canCommand && armed);
  find("reset").disabled = !(open && hasControl && !host?.busy && latched);
  const warnings = bridge?.driver_warnings ?? [];
  const driver = bridge ? [`Driver ${bridge.driver}: ${bridge.driver_ready ? "ready" : "not ready"}`, ...warnings].join(" · ") : "Driver: no data";
  const why = graph?.nodes?.coil_bridge?.values?.["last refusal"] ?? "none";
  const refused = bridge?.refused ? `commands and poses refused: ${bridge.refused}${why === "none" ? "" : `, the last: ${why}`}` : "";
  write("driver", refused ? `${driver} · ${refused}` : driver);
  find("driver").title = refused;
}

function showControl({ lease, client, hasControl, canCommand, open, maxSpeed, speed }) {
  const holder = lease?.holder ?? null;
  if (!open || !lease) write("holder", "unknown", "silent");
  else if (hasControl) write("holder", "you have control", "ok");
  else if (holder === null) write("holder", "no page has control", "silent");
  else write("holder", `page ${holder} has control${lease.available ? ", but is away" : ""}`, "warn");
  const control = find("control");
  control.disabled = !(open && canCommand && lease && (hasControl || lease.available));
  write("control", hasControl ? "Release control" : "Take control");
  for (const button of find("directions").children) button.disabled = !(open && hasControl);
  const slider = find("speed");
  const limit = (maxSpeed * 1e3).toFixed(1);
  if (slider.max !== limit) slider.max = limit;
  const speedNow = `${(speed * 1e3).toFixed(1)} mm/s`;
  write("speed-now", speedNow);
  if (slider.getAttribute("aria-valuetext") !== speedNow) slider.setAttribute("aria-valuetext", speedNow);
  write("hint", open && client !== null && !canCommand
    ? "This page only watches: it was opened without the token"
    : "Arrows, WASD, gamepad, or drag from the needle");
}

function showVision({ graph, since, hasImage }) {
  const tracker = graph?.tracker;
  const lines = [];
  if (!graph) lines.push("No data yet");
  else {
    if (!hasImage) lines.push("No camera image yet");
    else if (!tracker?.view) lines.push("Dish not found in the image: plain dish drawn");
    if (!graph.needle) lines.push("no needle yet");
    else if (graph.needle.age + since > 0.5) lines.push(`needle pose is ${seconds(graph.needle.age + since)} old`);
    if (tracker && tracker.state !== "tracked") lines.push(`needle ${tracker.state}`);
    if (estimateState(graph, since) === "prediction") lines.push(`thread not measured for ${seconds(graph.estimated.unmeasured_for)}: prediction only`);
  }
  write("vision", capital(lines.join(", ")));
}

// What happens ahead along the plan, or if the present command is held.
function showForecast({ graph, since }) {
  const forecast = graph ? forecastOf(graph, since) : null;
  find("forecast-legend").hidden = !forecast;
  if (forecast) write("forecast-horizon", `forecast for ${seconds(forecast.horizon)}, fainter the later`);
  const events = forecast?.events ?? [];
  find("forecast").hidden = !events.length;
  write("forecast", capital(events.join(", ")));
}

function showThread({ graph, since }) {
  const { margins, predicted, estimated } = graph;
  const thread = threadOf(graph);
  const estimate = estimateState(graph, since);
  const old = thread && thread.age + since > 0.5;
  const rows = [];
  if (!margins || !thread) write("friction", "no prediction yet", "silent");
  else if (old) write("friction", `${seconds(thread.age + since)} old`, "silent");
  else if (!margins.valid) write("friction", "margins not valid", "error");
  else {
    const { state, nodes, slowdown } = margins.friction;
    const count = plural(nodes.length, "node");
    const words = {
      free: ["free", "ok"], sliding: [`sliding: ${count}, × ${slowdown.toFixed(2)}`, "warn"],
      stuck: [`stuck: ${count}`, "rest"],
    }[state] ?? ["friction unknown", "silent"];
    write("friction", ...words);
  }
  if (margins && !margins.valid && margins.reason) rows.push([margins.reason, null, "error"]);
  if (estimate !== "none") for (const { text } of estimated.disturbances) rows.push([capital(text), null, "error"]);
  if (estimate === "prediction") rows.push([`Prediction only for ${seconds(estimated.unmeasured_for)}`, null, "error"]);
  rows.push(["Clearance", margins?.valid ? clearanceText(margins) : "–"]);
  if (margins?.valid && isNumber(margins.bound)) rows.push(["99 % bound", millimetres(margins.bound)]);
  if (estimate === "measured") {
    rows.push(["Measured", `${Math.round(100 * (1 - estimated.hidden))} %`]);
    rows.push(["Deviation", `± ${millimetres(Math.max(...estimated.deviation, 0), 3)}`]);
  }
  for (const [kind, value] of Object.entries(margins?.valid ? margins.least : {})) {
    rows.push([KINDS[kind] ?? capital(kind.replaceAll("_", " ")), millimetres(value, 3)]);
  }
  if (margins?.valid) rows.push(["In contact", plural(margins.contact.length, "node")]);
  if (predicted?.tension?.length) {
    rows.push(["Peak tension", micronewtons(Math.max(...predicted.tension))]);
    rows.push(["Needle pull", micronewtons(Math.hypot(...predicted.needle_force))]);
  }
  if (predicted) rows.push(["Step", isNumber(predicted.step_time) ? `${(predicted.step_time * 1e3).toFixed(2)} ms` : "–"]);
  const list = find("margins");
  list.classList.toggle("stale", Boolean(old));
  fill(list, rows, ([name, value, level]) => {
    const row = document.createElement("div");
    const [term, figure] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    figure.textContent = value ?? "";
    row.append(term, figure);
    if (value === null) row.className = `words ${level ?? ""}`;
    return row;
  });
}

const clearanceText = (margins) => {
  const least = leastClearance(margins);
  return least === null ? "none near" : millimetres(least);
};

function showNodes({ graph, since, host }) {
  const rows = Object.entries(graph.nodes ?? {}).map(([name, { level, message, age }]) => {
    const total = isNumber(age) ? age + since : null;
    const stale = level === "silent" || total === null || total > NODE_TIMEOUT;
    const lastSeen = stale ? `no data for ${seconds(total)}` : total < 1 ? "now" : `${Math.floor(total)} s ago`;
    const starting = host?.busy && level === "warn";
    return [name, stale || starting ? "silent" : level, lastSeen, message ?? "", starting && !stale];
  });
  if (!rows.length) rows.push(["no node yet", "", "", "", false]);
  fill(find("nodes"), rows, ([name, level, age, message, starting]) => {
    const item = document.createElement("li");
    const title = document.createElement("b");
    title.dataset.level = level || "silent";
    title.textContent = name.replaceAll("_", " ") + (level ? `: ${starting ? "starting" : LEVELS[level] ?? level}` : "");
    const when = document.createElement("span");
    when.className = "age";
    when.textContent = age;
    item.append(title, when);
    if (message && message !== "ok") {
      const text = document.createElement("span");
      text.className = "text";
      text.textContent = text.title = message;
      item.append(text);
    }
    item.classList.toggle("stale", level === "silent" && !starting);
    return item;
  });
}

// Rebuild a list's entries where their content has changed.
function fill(list, rows, make) {
  const content = JSON.stringify(rows);
  if (list.dataset.content === content) return;
  list.dataset.content = content;
  list.replaceChildren(...rows.map(make));
}
