// The drawing of the scene's shapes: discs, and others by outline and holes, each with its name.

const KINDS = {
  tissue: ["rgba(196, 116, 104, 0.36)", "rgba(150, 72, 62, 0.95)"],
  instrument: ["rgba(96, 112, 128, 0.40)", "rgba(58, 74, 90, 0.95)"],
  wall: ["rgba(92, 82, 66, 0.50)", "rgba(60, 52, 40, 0.95)"],
};

export function drawShapes(context, placement, shapes, { ink, halo }) {
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
  for (const { name, label } of shapes) {
    const [x, y] = placement.at(label);
    context.lineWidth = 3;
    context.strokeStyle = halo;
    context.strokeText(name, x, y);
    context.fillStyle = ink;
    context.fillText(name, x, y);
  }
  context.textBaseline = "alphabetic";
}

function trace(context, placement, ring) {
  ring.forEach((point, at) => (at ? context.lineTo(...placement.at(point)) : context.moveTo(...placement.at(point))));
  context.closePath();
}
