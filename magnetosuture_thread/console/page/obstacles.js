// The drawing of obstacles: discs, and others as triangles.

export function drawObstacles(context, placement, obstacles) {
  context.fillStyle = "rgba(120, 112, 98, 0.38)";
  context.strokeStyle = "rgba(88, 78, 62, 0.95)";
  context.lineWidth = 1.5;
  for (const obstacle of obstacles) {
    context.beginPath();
    if (obstacle.disc) {
      const [x, y, r] = obstacle.disc;
      context.arc(...placement.at([x, y]), placement.scale * r, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    } else {
      drawTriangles(context, placement, obstacle.triangles ?? []);
    }
  }
}

// Triangles, three corners each: filled together, the sides that no other triangle shares drawn as the outline.
function drawTriangles(context, placement, corners) {
  const points = corners.map((corner) => placement.at(corner));
  const sides = new Map();
  for (let at = 0; at + 2 < points.length; at += 3) {
    const [a, b, c] = points.slice(at, at + 3);
    const turned = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) < 0;
    const way = turned ? [a, c, b] : [a, b, c];
    way.forEach((point, corner) => (corner ? context.lineTo(...point) : context.moveTo(...point)));
    context.closePath();
    way.forEach((from, corner) => {
      const to = way[(corner + 1) % 3];
      const key = [from, to].map((point) => point.map((entry) => entry.toFixed(2)).join()).sort().join(" ");
      sides.set(key, sides.has(key) ? null : [from, to]);
    });
  }
  context.fill("nonzero");
  context.beginPath();
  for (const side of sides.values()) {
    if (!side) continue;
    context.moveTo(...side[0]);
    context.lineTo(...side[1]);
  }
  context.stroke();
}
