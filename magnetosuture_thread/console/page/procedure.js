// The bar of procedures: one is chosen, planned, and seen on the dish before it runs; goals, pause, resume, abort; and the
// button that has to be held where the needle may move only while somebody holds it.

import { capital, millimetres } from "./format.js";
import { needleArc } from "./geometry.js";

const LEVELS = { idle: "silent", ready: "rest", running: "ok", paused: "warn", done: "ok", failed: "error" };
const find = (id) => document.getElementById(id);
const kind = (goal) => capital(goal.replaceAll("_", " "));

export class ProcedureBar {
  // send(message, at) sends to the server; see Connection.
  constructor(send) {
    this.send = send;
    this.chosen = "";
    this.holdToRun = false;
    this.held = false;
    const act = (id, action) => find(id).addEventListener("click", ({ timeStamp }) => {
      this.send({ type: "procedure", action: action(), procedure: this.chosen, hold_to_run: this.holdToRun }, timeStamp);
      find("dish").focus({ preventScroll: true });
    });
    act("plan-procedure", () => "plan");
    act("run-procedure", () => "resume");
    act("pause-procedure", () => "pause");
    act("abort-procedure", () => "abort");
    find("hold-to-run").addEventListener("click", () => (this.holdToRun = !this.holdToRun));
    find("procedures").addEventListener("click", ({ target }) => target.dataset.name && (this.chosen = target.dataset.name));
    const hold = find("hold-procedure");
    hold.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || hold.disabled) return;
      hold.setPointerCapture(event.pointerId);
      this.held = true;
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) hold.addEventListener(end, () => this.release());
    for (const lost of ["blur", "pagehide", "beforeprint", "offline"]) addEventListener(lost, () => this.release());
    document.addEventListener("visibilitychange", () => document.hidden && this.release());
  }

  release() {
    this.held = false;
  }

  // Called as often as a jog would be sent.
  poll() {
    if (this.held && !document.hasFocus()) this.release(); // some of the browser's own popups take it without an event
    if (this.held) this.send({ type: "hold" });
  }

  show({ graph, open, hasControl, canCommand }) {
    const procedure = graph?.procedure;
    find("procedure").hidden = !procedure;
    if (!procedure) return this.release();
    const names = graph.procedures;
    if (!names.includes(this.chosen)) this.chosen = names[0] ?? "";
    const list = find("procedures");
    if (list.dataset.names !== names.join("\n")) {
      list.dataset.names = names.join("\n");
      list.replaceChildren(...names.map((name) => {
        const button = document.createElement("button");
        Object.assign(button, { type: "button", textContent: capital(name.replaceAll("_", " ")) });
        button.dataset.name = name;
        return button;
      }));
    }
    const { state, name, goals, goal, goals_met: met, progress, reason, resumes, hold_to_run: holds } = procedure;
    const active = state === "running" || state === "paused";
    const may = open && hasControl;
    for (const button of list.children) {
      button.disabled = !may || active;
      button.setAttribute("aria-pressed", String(button.dataset.name === this.chosen));
    }
    find("hold-to-run").disabled = !may || active;
    find("hold-to-run").setAttribute("aria-pressed", String(this.holdToRun));
    find("plan-procedure").disabled = !may || active || !this.chosen || !graph.needle; // a plan begins at the needle
    find("run-procedure").disabled = !(may && graph.bridge?.armed && (state === "ready" || (state === "paused" && !resumes)));
    write("run-procedure", state === "paused" ? "Resume" : "Run");
    find("pause-procedure").disabled = !(open && canCommand && (state === "running" || (state === "paused" && resumes)));
    find("abort-procedure").disabled = !(open && canCommand && (active || state === "ready"));
    const hold = find("hold-procedure");
    hold.hidden = !(holds && active);
    hold.disabled = !may;
    if (hold.hidden || hold.disabled) this.release();
    const text = name && state !== "idle" ? `${name.replaceAll("_", " ")}: ${state}` : "none";
    write("procedure-state", state === "running" ? `${text}, ${Math.round(100 * progress)} %` : text);
    find("procedure-state").dataset.level = LEVELS[state] ?? "silent";
    const marks = goals.map((each, at) => (at < met ? `✓ ${kind(each)}` : at === goal && active ? `▸ ${kind(each)}` : kind(each)));
    write("goals", marks.join(" · "));
    const end = active || state === "ready" ? graph.plan?.at(-1) : null;
    const tip = end && graph.needle ? needleArc(graph.needle, graph.needle_length, graph.needle_curvature).pop() : null;
    write("distance", tip ? `tip ${millimetres(Math.hypot(end[0] - tip[0], end[1] - tip[1]), 1)} from the end of the way` : "");
    write("procedure-reason", resumes ? `${reason}; it goes on by itself` : reason);
  }
}

function write(id, text) {
  const element = find(id);
  if (element.textContent === text) return;
  element.textContent = text;
  element.title = text;
}
