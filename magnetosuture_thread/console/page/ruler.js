// A ruler on the dish: while it is on, dragging measures a distance and jogs nothing.

import { millimetres } from "./format.js";

export class Ruler {
  // changed() is called when there is something else to draw; place() returns the canvas's `Placement`.
  constructor(canvas, changed, place) {
    this.on = false;
    this.ends = null; // in the dish [m]
    let held = false;
    const set = (event, begins) => {
      const point = place().back([event.offsetX, event.offsetY]);
      this.ends = [begins ? point : this.ends[0], point];
      changed();
    };
    canvas.addEventListener("pointerdown", (event) => {
      held = this.on && event.button === 0 && place() !== null;
      if (held) set(event, true);
    });
    canvas.addEventListener("pointermove", (event) => held && set(event, false));
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) canvas.addEventListener(end, () => (held = false));
  }

  toggle() {
    this.on = !this.on;
    this.ends = null;
  }

  // The distance in words, empty before anything is measured.
  get text() {
    if (!this.ends) return "";
    const [[x, y], [u, v]] = this.ends;
    return millimetres(Math.hypot(u - x, v - y));
  }
}
