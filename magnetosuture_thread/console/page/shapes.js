// The drawing of the scene's shapes: discs, and others by outline and holes, each with its name.

const LINE = 14; // [px] height of a name

const KINDS = {
  tissue: ["rgba(196, 116, 104, 0.36)", "rgba(150, 72, 62, 0.95)"],
  instrument: ["rgba(96, 112, 128, 0.40)", "rgba(58, 74, 90, 0.95)"],
  wall: ["rgba(92, 82, 66, 0.50)", "rgba(60, 52, 40, 0.95)"],
};

export function drawShapes(context, placement, shapes, { ink, halo, ratio }) {
  for (const shape of shapes) {
    [context.fillStyle, context.strokeStyle] = KINDS[shape.kind] ?? KINDS.wall;
    context.lineWidth = 1.5;
    context.beginPath();
    if (shape.disc) {
      const [x, y, r] = shape.disc;
      context.arc(...placement.at([x, y]), placement.scale * r, 0, 2 * Math.PI);
    } else {
      for (const ring of [shape.outline, ...shape.holes]) trace(context, placement, ring);
    }
    context.fill("evenodd");
    context.stroke();
  }
  context.font = '11px system-ui, "DejaVu Sans", sans-serif';
  context.textAlign = "center";
  context.textBaseline = "middle";
  const widths = shapes.map(({ name }) => context.measureText(name).width);
  const places = placeLabels(shapes.map(({ label }) => placement.at(label)), widths, context.canvas.width / ratio);
  for (const [at, { name }] of shapes.entries()) {
    const [x, y] = places[at];
    context.lineWidth = 3;
    context.strokeStyle = halo;
    context.strokeText(name, x, y);
    context.fillStyle = ink;
    context.fillText(name, x, y);
  }
  context.textBaseline = "alphabetic";
}

// Middles of labels that neither overlap nor leave a canvas sideways: each moves up or down, by as few lines as it takes.
export function placeLabels(wanted, widths, wide) {
  const placed = [];
  wanted.forEach(([u, v], at) => {
    const half = widths[at] / 2 + 2;
    const x = Math.max(half, Math.min(u, wide - half));
    const isFree = (y) => placed.every(([a, b, other]) => Math.abs(a - x) >= half + other || Math.abs(b - y) >= LINE);
    let lines = 0;
    while (!isFree(v + lines * LINE)) lines = lines > 0 ? -lines : 1 - lines;
    placed.push([x, v + lines * LINE, half]);
  });
  return placed;
}

function trace(context, placement, ring) {
  ring.forEach((point, at) => (at ? context.lineTo(...placement.at(point)) : context.moveTo(...placement.at(point))));
  context.closePath();
}
