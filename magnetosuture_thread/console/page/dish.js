// The drawing of the dish. For tests and other programs the canvas says in data attributes what it shows:
// data-friction (free, sliding, stuck, unknown, invalid, old, none) and data-colour of the thread that the margins are of,
// data-tension (shown or not), data-estimate (none, measured, prediction), data-disturbances (how many), data-plan (places of the planned way), data-ghosts (instants of the forecast thread), data-image (yes or no), data-axis (of a needle whose tip is unknown), data-ruler (what it measures), data-marks (ends of the needle that were clicked on), data-scale [px/m] and data-centre [px] of the canvas's own pixels, data-tip of the needle [m].

import {
  AHEAD, ESTIMATED, GREY, MEASURED, MIDDLING, MODEL, NEAR, VELOCITY, estimateState, forecastOf, nodeLook, onGround, tensionColour, threadLook, threadOf,
} from "./colours.js";
import { Placement, needleArc } from "./geometry.js";
import { drawShapes } from "./shapes.js";
import { undirectedAxis } from "./status.js";

const DIAMETER = 0.035; // [m] of the dish that is drawn dashed while no scene is known
const STALE = 0.5; // [s] a needle that is older is drawn grey
const ARROW = 0.3; // of the dish's diameter, at the greatest speed
const SIGMAS = 2.33; // standard deviations on either side of the shaded band, which holds the thread with 98 %
const PUSH = 34; // [px] length of the arrow of a force that was found
const PLANNED = ["ready", "running", "paused"]; // states of a procedure whose plan is drawn
const STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05];

export class Dish {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.ground = document.createElement("canvas"); // image and scene, which change less often than the rest
    this.under = []; // what the ground was drawn of
    this.image = null;
    this.placement = null; // in pixels of the page
    this.dark = matchMedia("(prefers-color-scheme: dark)");
  }

  // The needle from tail to tip in pixels of the page, null while there is none.
  needlePoints(graph) {
    if (!graph?.needle || !this.placement) return null;
    return needleArc(graph.needle, graph.needle_length, graph.needle_curvature).map((point) => this.placement.at(point));
  }

  draw(graph, { since, drag, maxSpeed, showTension, ruler, marks }) {
    const { canvas, context } = this;
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
    this.diameter = graph?.scene?.dish_diameter ?? DIAMETER;
    this.placement = new Placement(width, height, this.diameter);
    this.ratio = ratio;
    const shown = Boolean(this.image && graph?.tracker?.view);
    const bright = shown || !this.dark.matches;
    this.paper = this.dark.matches ? "#12181d" : "#dfe5ea";
    this.ink = bright ? "#1d2833" : "#e6ecf1";
    this.velocity = onGround(VELOCITY, !bright);
    this.halo = bright ? "rgba(255,255,255,0.9)" : "rgba(10,15,20,0.9)";
    this.#drawGround(graph, shown ? graph.tracker.view : null, width, height);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.ground, 0, 0);
    plain(context, ratio);
    const thread = threadOf(graph);
    const axis = undirectedAxis(graph, since);
    const look = threadLook(thread, graph?.margins, since);
    const estimate = graph ? estimateState(graph, since) : "none";
    const tip = graph?.needle ? needleArc(graph.needle, graph.needle_length, graph.needle_curvature).pop().join(",") : "";
    const tension = showTension && look.colour !== GREY && graph.predicted?.tension?.length ? graph.predicted.tension : null;
    const plan = PLANNED.includes(graph?.procedure?.state) ? graph.plan : [];
    const ghosts = (graph && forecastOf(graph, since)?.ghosts) ?? [];
    if (graph) {
      this.#line(graph.measured ?? [], 12, MEASURED);
      this.#drawPlan(plan);
      this.#drawGhosts(ghosts, !bright);
      if (estimate !== "none") this.#drawBand(graph.estimated);
      if (thread !== graph.predicted) this.#drawModel(graph, since);
      this.#drawThread(thread, graph.margins, look, thread === graph.estimated ? estimate : "none", tension);
      if (estimate !== "none") graph.estimated.disturbances.forEach((found) => this.#drawDisturbance(found, width));
      if (axis) this.#line(needleArc(axis, graph.needle_length, graph.needle_curvature), 4.5, this.velocity);
      this.#drawNeedle(graph, since);
      this.#drawVelocities(graph, since, maxSpeed);
    }
    if (drag) this.#drawDrag(drag);
    this.#drawScaleBar(width, height);
    if (ruler.ends) this.#drawRuler(ruler);
    this.#drawMarks(marks);
    Object.assign(canvas.dataset, {
      friction: look.state, colour: look.colour, estimate, tension: tension ? "shown" : "not",
      disturbances: String(estimate === "none" ? 0 : graph.estimated.disturbances.length), image: shown ? "yes" : "no", tip,
      plan: String(plan.length), ruler: ruler.text, marks: String(marks.length), axis: axis ? "yes" : "no", ghosts: String(ghosts.length),
      scale: String(this.placement.scale * ratio), centre: this.placement.centre.map((entry) => entry * ratio).join(","),
    });
  }

  // Draw the ground anew where anything of it has changed.
  #drawGround(graph, view, width, height) {
    const scene = graph?.scene;
    const under = [
      view && this.image, this.canvas.width, this.canvas.height, this.ratio, this.dark.matches, scene?.version,
      JSON.stringify(view),
    ];
    if (under.every((entry, at) => entry === this.under[at])) return;
    this.under = under;
    const { ground, placement, ratio } = this;
    [ground.width, ground.height] = [this.canvas.width, this.canvas.height];
    const context = ground.getContext("2d", { alpha: false });
    plain(context, ratio);
    context.fillStyle = this.paper;
    context.fillRect(0, 0, width, height);
    if (view) {
      context.setTransform(...placement.image(view).map((entry) => entry * ratio));
      context.drawImage(this.image, -0.5, -0.5); // a pixel's place is its middle
      plain(context, ratio);
      context.fillStyle = this.dark.matches ? "rgba(10, 15, 20, 0.22)" : "transparent";
      context.fillRect(0, 0, width, height);
    } else {
      context.beginPath();
      context.arc(...placement.centre, (placement.scale * this.diameter) / 2, 0, 2 * Math.PI);
      context.fillStyle = this.dark.matches ? "#232d36" : "#f7fafc";
      context.fill();
      context.strokeStyle = this.dark.matches ? "#5b6b78" : "#8fa2b2";
      context.lineWidth = 2;
      if (!scene) context.setLineDash([6, 8]);
      context.stroke();
      context.setLineDash([]);
    }
    drawShapes(context, placement, scene?.shapes ?? [], this);
  }

  #trace(points) {
    this.context.beginPath();
    points.forEach((point, at) => {
      const [x, y] = this.placement.at(point);
      if (at) this.context.lineTo(x, y);
      else this.context.moveTo(x, y);
    });
  }

  #line(points, width, colour) {
    if (points.length < 2) return;
    this.#trace(points);
    this.context.lineWidth = width;
    this.context.strokeStyle = colour;
    this.context.stroke();
  }

  // Where the estimated thread lies with a probability of 98 %, across it.
  #drawBand({ vertices, deviation }) {
    if (vertices.length < 2) return;
    const points = vertices.map((vertex) => this.placement.at(vertex));
    const sides = [[], []];
    points.forEach(([x, y], at) => {
      const [from, to] = [points[Math.max(at - 1, 0)], points[Math.min(at + 1, points.length - 1)]];
      const size = Math.hypot(to[0] - from[0], to[1] - from[1]) || 1;
      const off = (SIGMAS * deviation[at] * this.placement.scale) / size;
      const across = [(from[1] - to[1]) * off, (to[0] - from[0]) * off];
      sides[0].push([x + across[0], y + across[1]]);
      sides[1].push([x - across[0], y - across[1]]);
    });
    const { context } = this;
    context.beginPath();
    for (const [x, y] of [...sides[0], ...sides[1].reverse()]) context.lineTo(x, y);
    context.closePath();
    context.globalAlpha = 0.3;
    context.fillStyle = ESTIMATED;
    context.fill();
    context.globalAlpha = 1;
  }

  // The ends of the needle that were clicked on.
  #drawMarks(marks) {
    for (const { at } of marks) {
      const [x, y] = this.placement.at(at);
      for (const [width, colour] of [[5, this.halo], [2, this.velocity]]) {
        this.context.beginPath();
        for (const [right, down] of [[9, 0], [0, 9]]) {
          this.context.moveTo(x - right, y - down);
          this.context.lineTo(x + right, y + down);
        }
        this.context.lineWidth = width;
        this.context.strokeStyle = colour;
        this.context.stroke();
      }
    }
  }

  // Where the middle of the needle is to go.
  #drawPlan(plan) {
    this.#line(plan, 5, this.halo);
    this.context.setLineDash([2, 6]);
    this.#line(plan, 3, this.velocity);
    this.context.setLineDash([]);
  }

  // Where the thread will be along the plan, or while the present command is held, fainter the later.
  #drawGhosts(ghosts, dark) {
    ghosts.forEach(({ vertices }, at) => {
      this.context.globalAlpha = 0.55 - 0.13 * at;
      this.#line(vertices, 4, onGround(AHEAD, dark));
    });
    this.context.globalAlpha = 1;
  }

  // What the model alone says, beside the estimate.
  #drawModel({ predicted }, since) {
    if (!predicted || predicted.age + since > STALE) return;
    const { context } = this;
    context.setLineDash([3, 5]);
    this.#line(predicted.vertices, 2.2, MODEL);
    context.setLineDash([]);
  }

  // A force that the model does not know: an arrow to where it acts, and what it is.
  #drawDisturbance({ position, direction, text }, width) {
    const { context } = this;
    const [x, y] = this.placement.at(position);
    const [right, down] = [direction[0], -direction[1]];
    const from = [x - PUSH * right, y - PUSH * down];
    for (const [wide, colour] of [[6, this.halo], [3, NEAR]]) {
      context.beginPath();
      context.moveTo(...from);
      context.lineTo(x - 8 * right, y - 8 * down);
      context.lineWidth = wide;
      context.strokeStyle = colour;
      context.stroke();
    }
    this.#head([x - 5 * right, y - 5 * down], Math.atan2(down, right), 12, NEAR);
    context.font = '600 13px system-ui, "DejaVu Sans", sans-serif';
    const lines = text.split(/(?<=:) /);
    const size = Math.max(...lines.map((line) => context.measureText(line).width));
    const left = Math.min(Math.max(from[0] - 9 * right - (right > 0 ? size : 0), 8), width - size - 8);
    const base = from[1] - 14 * down + 4 - (down > 0 ? 17 * (lines.length - 1) : 0);
    context.fillStyle = this.halo;
    context.fillRect(left - 5, base - 14, size + 10, 3 + 17 * lines.length);
    context.fillStyle = NEAR;
    context.textAlign = "left";
    lines.forEach((line, at) => context.fillText(line, left, base + 17 * at));
  }

  // The thread that the margins are of, in the colour of its friction; an estimated one with an edge of its own colour,
  // which is broken where nothing is measured any more. On request, in that of each segment's tension.
  #drawThread(thread, margins, look, estimate, tension) {
    const vertices = thread?.vertices ?? [];
    const { context } = this;
    const valid = look.colour !== GREY;
    this.#line(vertices, 4.6, this.halo);
    if (estimate !== "none") {
      if (estimate === "prediction") context.setLineDash([9, 11]);
      this.#line(vertices, 7.4, ESTIMATED);
      context.setLineDash([]);
    }
    if (!valid) context.setLineDash([7, 6]);
    this.#line(vertices, 2.6, look.colour);
    context.setLineDash([]);
    if (tension) {
      const peak = Math.max(...tension);
      tension.forEach((value, at) => this.#line(vertices.slice(at, at + 2), 4.6, tensionColour(value, peak)));
    }
    const friction = new Set(valid ? margins?.friction.nodes : []);
    vertices.forEach((vertex, node) => {
      const { colour, radius } = nodeLook(margins?.clearance?.[node], valid);
      const [x, y] = this.placement.at(vertex);
      context.beginPath();
      context.arc(x, y, radius, 0, 2 * Math.PI);
      context.fillStyle = colour;
      context.fill();
      if (!friction.has(node)) return;
      context.beginPath(); // a ring around a node in friction
      context.arc(x, y, radius + 2.6, 0, 2 * Math.PI);
      context.strokeStyle = this.ink;
      context.lineWidth = 1.3;
      context.stroke();
    });
  }

  #drawNeedle(graph, since) {
    if (!graph.needle) return;
    const { context } = this;
    const arc = needleArc(graph.needle, graph.needle_length, graph.needle_curvature);
    const old = graph.needle.age + since > STALE;
    const colour = old ? GREY : this.ink;
    this.#line(arc, 8, this.halo);
    if (old) context.setLineDash([4, 7]);
    this.#line(arc, 4.5, colour);
    context.setLineDash([]);
    const [tip, before] = [this.placement.at(arc[arc.length - 1]), this.placement.at(arc[arc.length - 2])];
    this.#head(tip, Math.atan2(tip[1] - before[1], tip[0] - before[0]), 11, colour);
    context.beginPath();
    context.arc(...this.placement.at(arc[0]), 4, 0, 2 * Math.PI);
    context.fillStyle = this.halo;
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = colour;
    context.stroke();
  }

  // A triangle whose point lies ahead of a place.
  #head([x, y], angle, size, colour) {
    const { context } = this;
    const [cos, sin] = [Math.cos(angle) * size, Math.sin(angle) * size];
    context.beginPath();
    context.moveTo(x + 0.6 * cos, y + 0.6 * sin);
    context.lineTo(x - 0.4 * cos - 0.5 * sin, y - 0.4 * sin + 0.5 * cos);
    context.lineTo(x - 0.4 * cos + 0.5 * sin, y - 0.4 * sin - 0.5 * cos);
    context.closePath();
    context.fillStyle = colour;
    context.fill();
  }

  #drawVelocities(graph, since, maxSpeed) {
    const { filter } = graph;
    const points = this.needlePoints(graph);
    if (!points || !filter || filter.age + since > STALE) return;
    const tip = points[points.length - 1];
    const scale = (ARROW * this.diameter * this.placement.scale) / maxSpeed;
    this.#arrow(tip, filter.commanded, scale, 2, [6, 4]);
    this.#arrow(tip, filter.filtered, scale, 4.5, []);
  }

  #arrow(from, velocity, scale, width, dash) {
    const [right, down] = [velocity[0] * scale, -velocity[1] * scale];
    const size = Math.hypot(right, down);
    if (size < 3) return;
    const { context } = this;
    const to = [from[0] + right, from[1] + down];
    for (const [wide, colour] of [[width + 3, this.halo], [width, this.velocity]]) {
      context.setLineDash(colour === this.velocity ? dash : []);
      context.beginPath();
      context.moveTo(...from);
      context.lineTo(...to);
      context.lineWidth = wide;
      context.strokeStyle = colour;
      context.stroke();
    }
    context.setLineDash([]);
    this.#head(to, Math.atan2(down, right), 8 + width, this.velocity);
  }

  #drawDrag({ from, to }) {
    const { context } = this;
    context.setLineDash([2, 5]);
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.lineWidth = 3;
    context.strokeStyle = MIDDLING;
    context.stroke();
    context.setLineDash([]);
    context.beginPath();
    context.arc(...to, 9, 0, 2 * Math.PI);
    context.stroke();
  }

  #drawRuler({ ends, text }) {
    const { context } = this;
    const [from, to] = ends.map((end) => this.placement.at(end));
    const size = Math.hypot(to[0] - from[0], to[1] - from[1]) || 1;
    const [u, v] = [(-6 * (to[1] - from[1])) / size, (6 * (to[0] - from[0])) / size]; // across it
    for (const [wide, colour] of [[5, this.halo], [2, this.ink]]) {
      context.beginPath();
      for (const [a, b] of [[from, to], ...[from, to].map(([x, y]) => [[x - u, y - v], [x + u, y + v]])]) {
        context.moveTo(...a);
        context.lineTo(...b);
      }
      context.lineWidth = wide;
      context.strokeStyle = colour;
      context.stroke();
    }
    context.font = '600 13px system-ui, "DejaVu Sans", sans-serif';
    context.textAlign = "center";
    context.lineWidth = 4;
    context.strokeStyle = this.halo;
    context.strokeText(text, to[0], to[1] - 14);
    context.fillStyle = this.ink;
    context.fillText(text, to[0], to[1] - 14);
  }

  #drawScaleBar(width, height) {
    const { context, placement } = this;
    const step = STEPS.findLast((entry) => entry * placement.scale <= 130) ?? STEPS[0];
    const size = step * placement.scale;
    const [x, y] = [width - 18 - size, height - 16];
    context.fillStyle = this.paper;
    context.globalAlpha = 0.86;
    context.fillRect(x - 9, y - 24, size + 18, 33);
    context.globalAlpha = 1;
    const ink = this.dark.matches ? "#e6ecf1" : "#1d2833";
    context.strokeStyle = context.fillStyle = ink;
    context.lineWidth = 2;
    context.beginPath();
    for (const [u, v] of [[x, y - 5], [x, y], [x + size, y], [x + size, y - 5]]) context.lineTo(u, v);
    context.stroke();
    context.font = '12px system-ui, "DejaVu Sans", sans-serif';
    context.textAlign = "center";
    context.fillText(`${step * 1e3} mm`, x + size / 2, y - 8);
  }
}

function plain(context, ratio) {
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.globalAlpha = 1;
  context.setLineDash([]);
  context.lineJoin = context.lineCap = "round";
}
