// The operator's page: ties the connection, what is held, the drawing and the panel together.

import { Connection } from "./connection.js";
import { Dish } from "./dish.js";
import { Input } from "./input.js";
import { showPanel } from "./panel.js";
import { Plots } from "./plots.js";
import { SILENT } from "./why.js";

const BEAT = 30; // [ms] between two words while something is held
const PANEL = 100; // [ms] between two looks at the panel
const PLOTS = 250; // [ms] between two drawings of the plots
const BETWEEN = 0.06; // [s] after a state; without the next, a camera frame is drawn by itself
const NOTICE = 7000; // [ms]

const stats = { fps: 0, drawn: 0, states: 0, frames: 0, errors: 0 };
window.console_stats = stats;
addEventListener("error", () => (stats.errors += 1));
addEventListener("unhandledrejection", () => (stats.errors += 1));

const find = (id) => document.getElementById(id);
const clock = () => performance.now() / 1000;

const state = {
  link: "connecting", problem: "", graph: null, host: null, lease: null, heard: 0, me: null, commands: false,
  speed: 0.003, maxSpeed: 0.01, adjusted: false, sending: false, stopped: false,
};
const dish = new Dish(find("dish"));
const plots = new Plots(document);
const input = new Input(find("dish"), {
  changed: () => beat(), stop: () => emergencyStop(), needle: () => dish.needlePoints(state.graph),
});
const connection = new Connection({ opened, closed, said, frame });

const since = () => (state.graph ? clock() - state.heard : 0);
const mine = () => state.link === "open" && state.commands && state.me !== null && state.lease?.holder === state.me;

function opened() {
  Object.assign(state, { link: "open", problem: "", me: null });
  drawSoon();
  connection.send({ type: "visible", seen: !document.hidden });
}

function closed(reason) {
  Object.assign(state, { link: "closed", problem: reason, lease: null, me: null, sending: false });
  drawSoon();
  input.drop();
}

function said(message) {
  if (message.type === "state") return newState(message);
  if (message.type === "welcome") {
    Object.assign(state, { me: message.you, commands: message.commands, maxSpeed: message.max_speed });
    if (!state.adjusted) setSpeed(message.speed);
    if (message.refusal) notice(message.refusal);
  } else if (message.type === "error") notice(message.text);
  else if (message.type === "done" && message.refusal) notice(`${message.what}: ${message.refusal}`);
}

function newState(message) {
  connection.send({ type: "got", what: "state" });
  stats.states += 1;
  Object.assign(state, { graph: message.graph, host: message.host, lease: message.lease, heard: clock() });
  drawSoon();
  plots.add(message.graph, state.heard);
  const stopped = Boolean(message.graph.bridge?.emergency_stopped);
  if (stopped && !state.stopped) input.drop();
  state.stopped = stopped;
}

async function frame(buffer) {
  try {
    const image = await createImageBitmap(new Blob([new Uint8Array(buffer, 8)]));
    dish.image?.close();
    dish.image = image;
    stats.frames += 1;
    if (since() > BETWEEN) drawSoon(); // else the next state draws it
  } catch {
    stats.errors += 1;
    notice("A camera frame could not be read");
  }
  connection.send({ type: "got", what: "frame" });
}

// Say what is held; once, when nothing is held any more.
function beat() {
  const [x, y] = mine() && since() <= SILENT ? input.direction() : [0, 0];
  if (x || y) {
    state.sending = connection.send({ type: "hold", direction: [x, y], speed: state.speed, sent: clock() });
  } else if (state.sending) {
    state.sending = false;
    connection.send({ type: "release" });
  }
}

function emergencyStop() {
  input.drop();
  if (!connection.send({ type: "act", action: "stop" })) notice("Not connected: the emergency stop did not go out. Use the one on the rig.");
}

let noticeTimer = 0;
function notice(text) {
  const element = find("notice");
  if (element.textContent !== text) element.textContent = text;
  element.hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => (element.hidden = true), NOTICE);
}

function setSpeed(speed) {
  state.speed = Math.min(speed, state.maxSpeed);
  find("speed").max = String(state.maxSpeed * 1e3);
  find("speed").value = String(state.speed * 1e3);
}

const ask = (id, message) => find(id).addEventListener("click", () => connection.send(message()));
find("stop").addEventListener("click", emergencyStop);
for (const action of ["arm", "disarm", "reset"]) ask(action, () => ({ type: "act", action }));
ask("take", () => {
  input.drop();
  return { type: mine() ? "hand_back" : "take" };
});
ask("pause", () => ({ type: "pause", still: !state.host.paused }));
ask("record", () => ({ type: "record", on: !state.host.recording }));
find("scenario").addEventListener("change", ({ target }) => {
  connection.send({ type: "choose", scenario: target.value });
  target.blur(); // arrow keys steer again
});
find("speed").addEventListener("input", ({ target }) => {
  state.adjusted = true;
  state.speed = Number(target.value) / 1e3;
});
find("speed").addEventListener("pointerup", ({ target }) => target.blur());
document.addEventListener("visibilitychange", () => connection.send({ type: "visible", seen: !document.hidden }));
addEventListener("resize", drawSoon);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  drawSoon();
  plots.draw();
});

let asked = false;
function drawSoon() {
  if (!asked) requestAnimationFrame(draw);
  asked = true;
}

function draw() {
  asked = false;
  stats.drawn += 1;
  dish.draw(state.graph, { since: since(), leash: mine() ? input.leash() : null, maxSpeed: state.maxSpeed });
}

let counted = { at: clock(), drawn: 0 };
function look() {
  const now = clock();
  if (now - counted.at >= 1) {
    stats.fps = Math.round((stats.drawn - counted.drawn) / (now - counted.at));
    counted = { at: now, drawn: stats.drawn };
  }
  if (state.graph && since() > SILENT) {
    input.drop(); // nobody steers blind
    drawSoon();
  }
  document.body.dataset.link = state.link;
  showPanel({
    link: state.link, open: state.link === "open", problem: state.problem, since: since(), graph: state.graph, host: state.host,
    lease: state.lease, me: state.me, mine: mine(), commands: state.commands, held: state.sending, hasImage: dish.image !== null,
    fps: stats.fps, speed: state.speed, maxSpeed: state.maxSpeed,
  });
}

setInterval(() => {
  input.poll();
  beat();
  if (input.pointer) drawSoon();
}, BEAT);
setInterval(look, PANEL);
setInterval(() => plots.draw(), PLOTS);
connection.open();
look();
drawSoon();
