// The card of measurements: the needle is taught by a click on each of its ends, and a rig commissions itself.

const LEVELS = { running: "rest", done: "ok", failed: "error" };
const ENDS = ["tail", "tip"];
const COMMISSION = "Coils, needle and delay, by pulses: a needle without a thread in an empty dish";
const find = (id) => document.getElementById(id);

export class MeasurementCard {
  // send(message, at) sends to the server; place(point) returns where a point of the canvas is in the dish [m] and in the
  // camera's image [px], null while no image is shown; changed() is called when there is something else to draw.
  constructor(canvas, { send, place, changed }) {
    this.marks = null; // while ends are marked, those that are: as of place()
    const mark = (marks) => {
      this.marks = marks;
      changed();
      canvas.focus({ preventScroll: true });
    };
    const request = (id, action) => find(id).addEventListener("click", ({ timeStamp }) => {
      mark(null);
      send({ type: "measure", action, marks: [] }, timeStamp);
    });
    request("commission", "commission");
    request("cancel-measurement", "cancel");
    find("teach").addEventListener("click", () => mark(this.marks ? null : []));
    addEventListener("keydown", ({ code }) => code === "Escape" && this.marks && mark(null));
    canvas.addEventListener("click", (event) => {
      const { offsetX, offsetY, timeStamp } = event;
      const marked = this.marks && place([offsetX, offsetY]);
      if (!marked) return;
      event.stopImmediatePropagation(); // it means nothing else
      mark([...this.marks, marked]);
      if (this.marks.length < ENDS.length) return;
      send({ type: "measure", action: "teach", marks: this.marks.flatMap(({ pixel }) => pixel) }, timeStamp);
      mark(null);
    });
  }

  show({ graph, host, open, hasControl, canCommand, hasImage }) {
    const measurement = host?.measurement;
    find("measure-card").hidden = !host?.can_measure;
    const running = measurement?.state === "running";
    const may = Boolean(open && hasControl && host && !host.busy);
    const rests = may && !running && !graph?.bridge?.armed;
    const teach = find("teach");
    teach.disabled = !(rests && hasImage && graph?.tracker?.view);
    if (teach.disabled) this.marks = null;
    teach.setAttribute("aria-pressed", String(this.marks !== null));
    const commissions = graph?.nodes?.coil_bridge?.values?.commissioning === "True";
    find("commission").disabled = !rests || !commissions || this.marks !== null;
    find("commission").title = commissions ? COMMISSION : "Where the bridge is started with commissioning: true";
    find("cancel-measurement").disabled = !(open && canCommand && running);
    write("marking", this.marks ? `Click on the needle's ${ENDS[this.marks.length]}; Escape ends this` : "");
    const chip = find("measurement");
    chip.dataset.level = LEVELS[measurement?.state] ?? "silent";
    write("measurement", measurement ? `${measurement.name}: ${measurement.state}` : "nothing measured");
    const lines = find("measured");
    const text = measurement?.lines.join("\n") ?? "";
    const over = Boolean(graph?.bridge?.armed) && !running; // whoever steers needs the room
    lines.hidden = !text || over;
    if (write("measured", text)) lines.scrollTop = lines.scrollHeight;
    const picture = measurement?.picture ? `measurement.png?${measurement.picture}` : "";
    const image = find("learnt").firstElementChild;
    if (picture && image.getAttribute("src") !== picture) image.src = picture;
    find("learnt").hidden = !picture || over;
  }
}

function write(id, text) {
  const element = find(id);
  if (element.textContent === text) return false;
  element.textContent = text;
  return true;
}
