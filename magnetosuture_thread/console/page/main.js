// Operator page: connects the WebSocket, the jog input, the drawing and the panel.

import { Connection, SILENCE_TIMEOUT } from "./connection.js";
import { Dish } from "./dish.js";
import { Input } from "./input.js";
import { MeasurementCard } from "./measurement.js";
import { showPanel } from "./panel.js";
import { Plots } from "./plots.js";
import { ProcedureBar } from "./procedure.js";
import { Ruler } from "./ruler.js";
import { SetupPicker } from "./setup_picker.js";
import { undirectedAxis } from "./status.js";

const JOG_PERIOD = 30; // [ms] between two jog messages
const PANEL_PERIOD = 100; // [ms]
const PLOT_PERIOD = 250; // [ms]
const FRAME_DELAY = 0.06; // [s] after a state, after which a camera frame is drawn without waiting for the next
const LATE_TIME = 1; // [s] for which a late jog message is shown
const NOTICE_TIME = 7000; // [ms]

const stats = { fps: 0, drawn: 0, states: 0, frames: 0, errors: 0 };
window.console_stats = stats;
addEventListener("error", () => (stats.errors += 1));
addEventListener("unhandledrejection", () => (stats.errors += 1));

const find = (id) => document.getElementById(id);
const clock = () => performance.now() / 1000;

const state = {
  link: "connecting", problem: "", graph: null, host: null, lease: null, received: 0, client: null, canCommand: false,
  speed: 0.003, maxSpeed: 0.01, adjusted: false, jogging: false, stopped: false, showTension: false,
  late: { delay: 0, at: 0 }, stopSent: null, stopDoubted: false,
};
const dish = new Dish(find("dish"));
const plots = new Plots(document);
const input = new Input(find("dish"), find("directions"), {
  changed: () => sendJog(), stop: () => emergencyStop(), needle: () => (ruler.on || measurement.marks ? null : dish.needlePoints(state.graph)),
});
const ruler = new Ruler(find("dish"), drawSoon, () => dish.placement);
const connection = new Connection({ opened, closed, received, frame });

const measurement = new MeasurementCard(find("dish"), {
  send: (message, at) => connection.send(message, at), changed: drawSoon,
  place: (point) => {
    const view = dish.image && state.graph?.tracker?.view;
    return view ? { at: dish.placement.back(point), pixel: dish.placement.pixel(view, point) } : null;
  },
});
const procedure = new ProcedureBar((message, at) => connection.send(message, at));

const since = () => (state.graph ? clock() - state.received : 0);
const hasControl = () => state.link === "open" && state.canCommand && state.client !== null && state.lease?.holder === state.client;

function opened() {
  Object.assign(state, { link: "open", problem: "", client: null, stopSent: null, stopDoubted: false });
  drawSoon();
  connection.send({ type: "visibility", visible: !document.hidden });
}

function closed(reason) {
  Object.assign(state, { link: "closed", problem: reason, lease: null, client: null, jogging: false });
  drawSoon();
  input.clear();
  procedure.release();
}

function received(message) {
  if (message.type === "state") return newState(message);
  if (message.type === "welcome") {
    Object.assign(state, { client: message.client, canCommand: message.can_command, maxSpeed: message.max_speed });
    if (!state.adjusted) setSpeed(message.speed);
    if (message.refusal) notice(message.refusal);
  } else if (message.type === "error" && message.delay) state.late = { delay: message.delay, at: clock() };
  else if (message.type === "error") notice(message.text);
  else if (message.type === "result") {
    if (message.request === "stop") stopAnswered();
    if (message.refusal) notice(`${message.request}: ${message.refusal}`);
  }
}

function newState(message) {
  connection.send({ type: "acknowledge", kind: "state" });
  stats.states += 1;
  Object.assign(state, { graph: message.graph, host: message.host, lease: message.lease, received: clock() });
  drawSoon();
  plots.add(message.graph, state.received);
  const stopped = Boolean(message.graph.bridge?.emergency_stopped);
  if (stopped) stopAnswered();
  if (stopped && !state.stopped) input.clear();
  state.stopped = stopped;
}

async function frame(buffer) {
  try {
    const image = await createImageBitmap(new Blob([new Uint8Array(buffer, 8)]));
    dish.image?.close();
    dish.image = image;
    stats.frames += 1;
    if (since() > FRAME_DELAY) drawSoon(); // else the next state draws it
  } catch {
    stats.errors += 1;
    notice("A camera frame could not be read");
  }
  connection.send({ type: "acknowledge", kind: "frame" });
}

// Send the jog that is held, and its end once.
function sendJog() {
  const [x, y] = hasControl() && since() <= SILENCE_TIMEOUT ? input.direction() : [0, 0];
  if (x || y) {
    state.jogging = connection.send({ type: "jog", direction: [x, y], speed: state.speed });
  } else if (state.jogging) {
    state.jogging = false;
    connection.send({ type: "end_jog" });
  }
}

function emergencyStop() {
  input.clear();
  procedure.release();
  state.stopSent = connection.isOpen ? clock() : null;
  if (!connection.isOpen) return notice("Not connected: the emergency stop was not sent. Use the one on the rig.");
  connection.send({ type: "bridge_action", action: "stop" });
  doubtStop();
}

// Say of an emergency stop that it may not have arrived, until something tells that it has.
function doubtStop() {
  if (state.stopSent === null || Math.max(connection.silence, clock() - state.stopSent) <= SILENCE_TIMEOUT) return;
  notice("The emergency stop may not have arrived: no answer. Use the one on the rig.");
  state.stopDoubted = true;
}

function stopAnswered() {
  if (state.stopDoubted) find("notice").hidden = true;
  Object.assign(state, { stopSent: null, stopDoubted: false });
}

let noticeTimer = 0;
function notice(text) {
  const element = find("notice");
  if (element.textContent !== text) element.textContent = text;
  element.hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => (element.hidden = true), NOTICE_TIME);
}

function setSpeed(speed) {
  state.speed = Math.min(speed, state.maxSpeed);
  find("speed").max = String(state.maxSpeed * 1e3);
  find("speed").value = String(state.speed * 1e3);
}

// A button that is disabled as it has done its work would leave the focus nowhere.
const request = (id, message) => find(id).addEventListener("click", ({ timeStamp }) => {
  connection.send(message(), timeStamp);
  find("dish").focus({ preventScroll: true });
});
find("stop").addEventListener("click", emergencyStop);
for (const action of ["arm", "disarm", "reset"]) request(action, () => ({ type: "bridge_action", action }));
request("control", () => {
  input.clear();
  return { type: hasControl() ? "release_control" : "acquire_control" };
});
request("pause", () => ({ type: "pause", paused: !state.host.paused }));
request("record", () => ({ type: "record", recording: !state.host.recording }));
const setups = new SetupPicker({
  select: (setup) => connection.send({ type: "select_setup", setup }),
  running: () => (state.host?.recording ? `the run and its recording to ${state.host.recording}` : "the run"),
});
find("again").addEventListener("click", () => setups.ask(state.host.setup));
find("tension").addEventListener("click", ({ currentTarget }) => {
  state.showTension = !state.showTension;
  currentTarget.setAttribute("aria-pressed", String(state.showTension));
  find("tension-legend").hidden = !state.showTension;
  find("dish").focus({ preventScroll: true });
  drawSoon();
});
find("ruler").addEventListener("click", ({ currentTarget }) => {
  ruler.toggle();
  input.clear();
  currentTarget.setAttribute("aria-pressed", String(ruler.on));
  find("dish").focus({ preventScroll: true });
  drawSoon();
});
// Where nothing else tells which end of the needle is its tip, a click does.
find("dish").addEventListener("click", ({ offsetX, offsetY }) => {
  if (!hasControl() || ruler.on || !undirectedAxis(state.graph, since()) || !dish.placement) return;
  connection.send({ type: "tip", position: dish.placement.back([offsetX, offsetY]) });
});
function showLegend(shown) {
  find("legend").hidden = !shown;
  find("fold").setAttribute("aria-expanded", String(shown));
}
find("fold").addEventListener("click", () => {
  showLegend(find("legend").hidden);
  find("dish").focus({ preventScroll: true });
});
showLegend(!matchMedia("(max-width: 1000px)").matches);
find("speed").addEventListener("input", ({ target }) => {
  state.adjusted = true;
  state.speed = Number(target.value) / 1e3;
});
find("speed").addEventListener("pointerup", ({ target }) => target.blur());
document.addEventListener("visibilitychange", () => connection.send({ type: "visibility", visible: !document.hidden }));
addEventListener("resize", drawSoon);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  drawSoon();
  plots.draw();
});

let scheduled = false;
function drawSoon() {
  if (!scheduled) requestAnimationFrame(draw);
  scheduled = true;
}

function draw() {
  scheduled = false;
  stats.drawn += 1;
  dish.draw(state.graph, { since: since(), drag: hasControl() ? input.drag() : null, maxSpeed: state.maxSpeed, showTension: state.showTension, ruler, marks: measurement.marks ?? [] });
}

let counted = { at: clock(), drawn: 0 };
function update() {
  const now = clock();
  if (now - counted.at >= 1) {
    stats.fps = Math.round((stats.drawn - counted.drawn) / (now - counted.at));
    counted = { at: now, drawn: stats.drawn };
  }
  if (state.graph && since() > SILENCE_TIMEOUT) {
    input.clear(); // no jogging without a current state
    drawSoon();
  }
  doubtStop();
  document.body.dataset.link = state.link;
  const view = {
    link: state.link, open: state.link === "open", problem: state.problem, since: since(), graph: state.graph, host: state.host,
    lease: state.lease, client: state.client, hasControl: hasControl(), canCommand: state.canCommand, jogging: state.jogging, hasImage: dish.image !== null,
    stale: input.stale, late: now - state.late.at < LATE_TIME ? state.late.delay : 0,
    fps: stats.fps, speed: state.speed, maxSpeed: state.maxSpeed, setups,
  };
  showPanel(view);
  procedure.show(view);
  measurement.show(view);
}

setInterval(() => {
  input.poll();
  sendJog();
  procedure.poll();
  if (input.pointer) drawSoon();
}, JOG_PERIOD);
setInterval(update, PANEL_PERIOD);
setInterval(() => plots.draw(), PLOT_PERIOD);
connection.open();
update();
drawSoon();
