// The dish on the canvas. Dish frame: x right, y up, origin in the middle [m]; canvas: right and down [px].

export class Placement {
  constructor(width, height, diameter) {
    this.centre = [width / 2, height / 2];
    this.scale = Math.min(width, height) / (diameter * 1.06); // [px/m]
  }

  at([x, y]) {
    return [this.centre[0] + this.scale * x, this.centre[1] - this.scale * y];
  }

  back([u, v]) {
    return [(u - this.centre[0]) / this.scale, (this.centre[1] - v) / this.scale];
  }

  // The canvas transform that puts a camera image's pixels where they belong in the dish.
  image({ centre, scale, rotation }) {
    const a = this.scale * scale * Math.cos(rotation);
    const b = this.scale * scale * Math.sin(rotation);
    const [u, v] = centre;
    return [a, b, -b, a, this.centre[0] - a * u + b * v, this.centre[1] - b * u - a * v];
  }

  // The pixel of a camera image that is shown at a point of the canvas.
  pixel(view, [x, y]) {
    const [a, b, , , left, top] = this.image(view);
    const [right, down] = [(x - left) / (a * a + b * b), (y - top) / (a * a + b * b)];
    return [a * right + b * down, a * down - b * right];
  }
}

// Points along a needle's arc from tail to tip, and the tip's place.
export function needleArc(needle, length, curvature, parts = 16) {
  const points = [];
  for (let part = 0; part <= parts; part += 1) {
    const s = (length * part) / parts;
    const half = (curvature * s) / 2;
    const chord = Math.abs(half) < 1e-9 ? s : (s * Math.sin(half)) / half;
    const angle = needle.heading + half;
    points.push([needle.tail[0] + chord * Math.cos(angle), needle.tail[1] + chord * Math.sin(angle)]);
  }
  return points;
}
