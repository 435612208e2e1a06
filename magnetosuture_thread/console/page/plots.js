// Running plots of the last 30 s, drawn a few times a second.

import { COILS, FREE, MIDDLING, STUCK, VELOCITY, onGround } from "./colours.js";
import { fixed, isNumber, leastClearance, length, plural } from "./format.js";

const SPAN = 30; // [s]
const EDGE = { left: 27, right: 4, top: 7, bottom: 4 };

export class Plots {
  constructor(root) {
    this.samples = [];
    const plot = (name, series, least, last) => ({
      canvas: root.querySelector(`#plot-${name}`), now: root.querySelector(`#plot-${name}-now`), series, least, last,
    });
    this.plots = [
      plot("clearance", [{ of: (s) => s.clearance, colour: FREE }], 1, (s) => figure(s.clearance, 2, "mm")),
      plot("friction", [
        { of: (s) => s.count, colour: MIDDLING, label: "nodes", steps: true },
        { of: (s) => s.slowdown, colour: STUCK, label: "speed factor", dash: [4, 3] },
      ], 2, (s) => (isNumber(s.count) ? `${plural(s.count, "node")}, × ${s.slowdown.toFixed(2)}` : "no data")),
      plot("speed", [
        { of: (s) => s.commanded, colour: VELOCITY, label: "commanded", dash: [5, 3] },
        { of: (s) => s.filtered, colour: VELOCITY, label: "filtered" },
        { of: (s) => s.applied, colour: FREE, label: "applied", dash: [1.5, 3] },
      ], 2, (s) => figure(s.applied, 1, "mm/s")),
      plot("currents", COILS.map((colour, coil) => ({ of: (s) => s.currents[coil], colour, label: `coil ${coil + 1}` })), 1,
        (s) => (s.currents.length ? `up to ${figure(Math.max(...s.currents.map(Math.abs)), 2, "A")}` : "no data")),
    ];
    this.dark = matchMedia("(prefers-color-scheme: dark)");
  }

  add(graph, clock) {
    const time = isNumber(graph.time) ? graph.time : clock;
    const last = this.samples[this.samples.length - 1];
    if (last && (time < last.time || time > last.time + SPAN)) this.samples = [];
    if (last && time === last.time) return;
    const { margins, filter, bridge } = graph;
    const least = leastClearance(margins);
    const milli = (value) => (isNumber(value) ? 1e3 * value : null);
    this.samples.push({
      time,
      clearance: milli(least),
      count: margins?.valid ? margins.friction.nodes.length : null,
      slowdown: margins?.valid ? margins.friction.slowdown : null,
      commanded: milli(length(filter?.commanded)), filtered: milli(length(filter?.filtered)), applied: milli(length(filter?.applied)),
      currents: bridge?.measured_current?.length ? bridge.measured_current : bridge?.current ?? [],
    });
    let old = 0;
    while (old < this.samples.length && this.samples[old].time < time - SPAN) old += 1;
    if (old) this.samples.splice(0, old);
  }

  draw() {
    for (const plot of this.plots) this.#draw(plot);
  }

  #draw({ canvas, now, series, least, last }) {
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const { samples } = this;
    const values = samples.flatMap((sample) => series.map(({ of }) => of(sample))).filter(isNumber);
    const high0 = niceCeiling(values.reduce((most, value) => Math.max(most, value), least));
    const lowest = values.reduce((most, value) => Math.min(most, value), 0);
    const low0 = lowest < -0.02 * high0 ? -niceCeiling(-lowest) : 0;
    const end = samples.length ? samples[samples.length - 1].time : 0;
    const x = (time) => EDGE.left + ((time - end + SPAN) / SPAN) * (width - EDGE.left - EDGE.right);
    const y = (value) => EDGE.top + ((high0 - value) / (high0 - low0)) * (height - EDGE.top - EDGE.bottom);
    this.#axes(context, width, low0, high0, y);
    for (const entry of series) this.#curve(context, entry, x, y);
    now.textContent = samples.length ? last(samples[samples.length - 1]) : "no data";
    this.#key(context, series, width);
  }

  #axes(context, width, low, high, y) {
    context.font = '11px system-ui, "DejaVu Sans", sans-serif';
    context.textAlign = "right";
    context.textBaseline = "middle";
    context.lineWidth = 1;
    for (const value of new Set([low, 0, high])) {
      context.strokeStyle = this.dark.matches ? "#303b45" : "#dde4ea";
      context.beginPath();
      context.moveTo(EDGE.left, y(value));
      context.lineTo(width - EDGE.right, y(value));
      context.stroke();
      context.fillStyle = this.dark.matches ? "#a3b0bc" : "#56636f";
      if (value || y(low) - y(0) > 12 || !low) context.fillText(String(value), EDGE.left - 4, y(value));
    }
  }

  // What each line is, beside a piece of it.
  #key(context, series, width) {
    const named = series.filter(({ label }) => label);
    context.font = '10.5px system-ui, "DejaVu Sans", sans-serif';
    context.textAlign = "left";
    const brief = named.length > 3 || width < 190;
    let [x, y] = [EDGE.left + 4, EDGE.top + 2];
    for (const { label, colour, dash } of named) {
      const text = brief ? label.split(" ").pop() : label;
      const size = Math.ceil(context.measureText(text).width);
      if (x + 17 + size > width) [x, y] = [EDGE.left + 4, y + 14];
      context.fillStyle = this.dark.matches ? "#192027d0" : "#ffffffd0";
      context.fillRect(x - 2, y, size + 22, 13);
      context.strokeStyle = onGround(colour, this.dark.matches);
      context.lineWidth = 2;
      context.setLineDash(dash ?? []);
      context.beginPath();
      context.moveTo(x, y + 7);
      context.lineTo(x + 14, y + 7);
      context.stroke();
      context.setLineDash([]);
      context.fillStyle = this.dark.matches ? "#a3b0bc" : "#56636f";
      context.fillText(text, x + 17, y + 7);
      x += size + (brief ? 22 : 26);
    }
  }

  #curve(context, { of, colour, dash, steps }, x, y) {
    context.strokeStyle = onGround(colour, this.dark.matches);
    context.lineWidth = 1.6;
    context.setLineDash(dash ?? []);
    context.beginPath();
    let before = null;
    for (const sample of this.samples) {
      const value = of(sample);
      if (!isNumber(value)) {
        before = null;
        continue;
      }
      if (before === null) context.moveTo(x(sample.time), y(value));
      else {
        if (steps) context.lineTo(x(sample.time), y(before));
        context.lineTo(x(sample.time), y(value));
      }
      before = value;
    }
    context.stroke();
    context.setLineDash([]);
  }
}

// The least of 1, 2, 5 times a power of ten that is not below a value.
function niceCeiling(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  const factor = [1, 2, 5, 10].find((entry) => entry * power >= value * 0.9999);
  return Number((factor * power).toPrecision(3));
}

const figure = (value, digits, unit) => (isNumber(value) ? `${fixed(value, digits)} ${unit}` : "no data");
