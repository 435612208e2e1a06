// The words beside the dish: states, figures, who steers. Text is written only where it changed.

import { capital, isNumber, leastClearance, millimetres, plural, seconds } from "./format.js";
import { SILENT, whyAtRest } from "./why.js";

const NODE_SILENT = 3.0; // [s]
const KINDS = { connectivity: "Connectivity", compression: "Compression", obstacle: "Obstacle", wall: "Wall" };
const WORDS = { ok: "ok", warn: "warns", error: "error", silent: "silent" };

const find = (id) => document.getElementById(id);

function write(id, text, level) {
  const element = find(id);
  if (element.textContent !== text) element.textContent = text;
  if (level !== undefined && element.dataset.level !== level) element.dataset.level = level;
}

export function showPanel(view) {
  const { graph, host, lease } = view;
  showWhy(view);
  showLink(view);
  showHost(view);
  showCoils(view);
  showSteering(view);
  showSeeing(view);
  if (graph) {
    showThread(view);
    showNodes(view);
  }
  if (lease) write("pages", `${plural(lease.pages, "page")} watching`);
  find("simulated").hidden = !host?.simulated;
}

function showWhy(view) {
  const { level, headline, reasons } = whyAtRest(view);
  const why = find("why");
  if (why.dataset.level !== level) why.dataset.level = level;
  write("headline", headline);
  const figures = /[\d.]+/g; // a changing figure is not read out over and over
  const spoken = find("spoken");
  if (spoken.dataset.said !== headline.replace(figures, "")) {
    spoken.dataset.said = headline.replace(figures, "");
    spoken.textContent = headline;
  }
  write("reasons", reasons.join(" "));
  find("reasons").title = reasons.join(" ");
}

function showLink({ link, since, fps, me, problem }) {
  if (link !== "open") {
    write("link", link === "closed" ? `Disconnected${problem ? `: ${problem}` : ""}` : "Connecting …", link === "closed" ? "error" : "warn");
  } else if (since > SILENT) write("link", `Silent for ${seconds(since)}`, "error");
  else write("link", `Connected as page ${me ?? "…"} · ${fps} pictures/s`, "ok");
}

function showHost({ host, mine, open }) {
  const select = find("scenario");
  const names = host?.scenarios ?? [];
  if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
    select.replaceChildren(...names.map((name) => new Option(spoken(name), name)));
  }
  if (host && document.activeElement !== select && select.value !== host.scenario) select.value = host.scenario;
  const allowed = open && mine && host && !host.busy;
  select.disabled = !allowed || names.length < 2;
  const pause = find("pause");
  pause.disabled = !(allowed && host.can_pause);
  pause.setAttribute("aria-pressed", String(Boolean(host?.paused)));
  write("pause", host?.paused ? "Go on" : "Pause");
  const record = find("record");
  record.disabled = !(allowed && host.can_record);
  record.setAttribute("aria-pressed", String(Boolean(host?.recording)));
  write("record", host?.recording ? "End recording" : "Record");
  write("recording", host?.busy ? capital(host.busy) : host?.recording ? `Recording to ${host.recording}` : "");
}

// A set-up's name for a person, also of one that is a path.
const spoken = (name) => name.split("/").pop().replace(/\.yaml$/, "").replaceAll("_", " ");

function showCoils({ graph, host, since, commands, mine, open }) {
  const bridge = graph?.bridge;
  const fresh = bridge && bridge.age + since <= SILENT;
  const armed = Boolean(bridge?.armed);
  const latched = Boolean(bridge?.emergency_stopped || bridge?.state === "fault");
  if (!bridge) write("coils", "nothing heard", "silent");
  else if (!fresh) write("coils", `silent for ${seconds(bridge.age + since)}`, "silent");
  else if (bridge.emergency_stopped) write("coils", "emergency stop", "error");
  else if (bridge.state === "fault") write("coils", "fault", "error");
  else if (bridge.state !== "active") write("coils", bridge.state, "silent");
  else write("coils", armed ? "armed" : "disarmed", armed ? "ok" : "warn");
  find("stop").disabled = open && !commands;
  find("arm").disabled = !(open && mine && !host?.busy && bridge && !armed && !latched && bridge.driver_ready && bridge.state === "active");
  find("disarm").disabled = !(open && commands && armed);
  find("reset").disabled = !(open && mine && !host?.busy && latched);
  const warnings = bridge?.driver_warnings ?? [];
  const driver = bridge ? [`Driver ${bridge.driver}: ${bridge.driver_ready ? "ready" : "not ready"}`, ...warnings].join(" · ") : "Driver: nothing heard";
  write("driver", bridge?.refused ? `${driver} · ${bridge.refused} commands refused` : driver);
}

function showSteering({ lease, me, mine, commands, open, maxSpeed, speed }) {
  const holder = lease?.holder ?? null;
  if (!open || !lease) write("steers", "unknown", "silent");
  else if (mine) write("steers", "you steer", "ok");
  else if (holder === null) write("steers", "nobody steers", "silent");
  else write("steers", `page ${holder} steers${lease.available ? ", but is away" : ""}`, "warn");
  const take = find("take");
  take.disabled = !(open && commands && lease && (mine || lease.available));
  write("take", mine ? "Hand back" : "Take steering");
  const slider = find("speed");
  const most = (maxSpeed * 1e3).toFixed(1);
  if (slider.max !== most) slider.max = most;
  write("speed-now", `${(speed * 1e3).toFixed(1)} mm/s`);
  write("how", open && me !== null && !commands
    ? "This page only watches: it was opened without the token"
    : "Arrows, WASD, gamepad, or pull the needle");
}

function showSeeing({ graph, since, hasImage }) {
  const tracker = graph?.tracker;
  const lines = [];
  if (!graph) lines.push("Nothing heard yet");
  else {
    if (!hasImage) lines.push("No camera image yet");
    else if (!tracker?.view) lines.push("Dish not found in the image: plain dish drawn");
    if (!graph.needle) lines.push("no needle yet");
    else if (graph.needle.age + since > 0.5) lines.push(`needle pose is ${seconds(graph.needle.age + since)} old`);
    if (tracker && tracker.state !== "tracked") lines.push(`needle ${tracker.state}`);
  }
  write("seeing", capital(lines.join(", ")));
}

function showThread({ graph, since }) {
  const { margins, predicted } = graph;
  const old = predicted && predicted.age + since > 0.5;
  const rows = [];
  if (!margins || !predicted) write("friction", "nothing predicted yet", "silent");
  else if (old) write("friction", `${seconds(predicted.age + since)} old`, "silent");
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
  if (margins && !margins.valid && margins.reason) rows.push([margins.reason, null]);
  rows.push(["Clearance", margins?.valid ? clearanceText(margins) : "–"]);
  for (const [kind, value] of Object.entries(margins?.valid ? margins.least : {})) {
    rows.push([KINDS[kind] ?? capital(kind.replaceAll("_", " ")), millimetres(value, 3)]);
  }
  if (margins?.valid) rows.push(["Touching", plural(margins.contact.length, "node")]);
  if (predicted) rows.push(["Step", isNumber(predicted.step_time) ? `${(predicted.step_time * 1e3).toFixed(2)} ms` : "–"]);
  const list = find("margins");
  list.classList.toggle("stale", Boolean(old));
  fill(list, rows, ([name, value]) => {
    const row = document.createElement("div");
    const [term, figure] = [document.createElement("dt"), document.createElement("dd")];
    term.textContent = name;
    figure.textContent = value ?? "";
    row.append(term, figure);
    if (value === null) row.className = "words";
    return row;
  });
}

const clearanceText = (margins) => {
  const least = leastClearance(margins);
  return least === null ? "none near" : millimetres(least);
};

function showNodes({ graph, since }) {
  const rows = Object.entries(graph.nodes ?? {}).map(([name, { level, message, age }]) => {
    const total = isNumber(age) ? age + since : null;
    const stale = level === "silent" || total === null || total > NODE_SILENT;
    const heard = stale ? `nothing for ${seconds(total)}` : total < 1 ? "now" : `${Math.floor(total)} s ago`;
    return [name, stale ? "silent" : level, heard, message ?? ""];
  });
  if (!rows.length) rows.push(["no node heard yet", "", "", ""]);
  fill(find("nodes"), rows, ([name, level, age, message]) => {
    const item = document.createElement("li");
    const title = document.createElement("b");
    title.dataset.level = level || "silent";
    title.textContent = name.replaceAll("_", " ") + (level ? `: ${WORDS[level] ?? level}` : "");
    const when = document.createElement("span");
    when.className = "age";
    when.textContent = age;
    item.append(title, when);
    if (message && message !== "ok") {
      const says = document.createElement("span");
      says.className = "says";
      says.textContent = says.title = message;
      item.append(says);
    }
    item.classList.toggle("stale", level === "silent");
    return item;
  });
}

// Make a list's entries anew where what they say has changed.
function fill(list, rows, make) {
  const said = JSON.stringify(rows);
  if (list.dataset.said === said) return;
  list.dataset.said = said;
  list.replaceChildren(...rows.map(make));
}
