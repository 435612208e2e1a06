"use strict";
(async () => {
  const MAX_ROWS = 300;
  const byId = (id) => document.getElementById(id);
  const { columns, rows } = await (await fetch("/bags.json")).json();
  const at = Object.fromEntries(columns.map((name, index) => [name, index]));
  const numeric = columns.filter((name, index) => rows.some((row) => typeof row[index] === "number"));
  const shown = ["bag", "setup", "duration_s", "frames", "predicted", "error_truth_mean_percent", "error_seen_mean_percent",
    "least_obstacle_m", "tension_max_n", "damage", "problem"];
  const texts = ["bag", "path", "setup", "scene", "material", "problem", "damage"];
  let sorted = { name: "bag", down: false };

  const show = (value) => (value === null ? "" : typeof value === "number" ? String(Number(value.toPrecision(4))) : value);
  const open = (row) => window.open(`/report/${rows.indexOf(row)}`, "_blank", "noopener");
  const make = (kind, text, where) => {
    const element = document.createElement(kind);
    element.textContent = text;
    where.append(element);
    return element;
  };

  function chosen() {
    const wanted = byId("filter").value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = rows.filter((row) => {
      const text = texts.map((name) => row[at[name]] ?? "").join(" ").toLowerCase();
      return wanted.every((word) => text.includes(word));
    });
    const index = at[sorted.name];
    const order = (a, b) => (a[index] === null) - (b[index] === null) || (a[index] > b[index]) - (a[index] < b[index]);
    return found.sort((a, b) => (sorted.down ? order(b, a) : order(a, b)));
  }

  function plot(found) {
    const svg = byId("plot");
    svg.replaceChildren();
    const names = [byId("x").value, byId("y").value];
    const points = found.filter((row) => names.every((name) => typeof row[at[name]] === "number"));
    const ends = names.map((name) => {
      const values = points.map((row) => row[at[name]]);
      const low = values.reduce((a, b) => Math.min(a, b), Infinity), high = values.reduce((a, b) => Math.max(a, b), -Infinity);
      return [low, high > low ? high : low + 1];
    });
    const place = (value, axis) => (value - ends[axis][0]) / (ends[axis][1] - ends[axis][0]);
    const add = (kind, attributes, text = "") => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
      for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
      element.textContent = text;
      svg.append(element);
      return element;
    };
    for (const row of points) {
      const [x, y] = names.map((name, axis) => place(row[at[name]], axis));
      const kind = row[at.simulated] ? "simulated" : "";
      const point = add("circle", { cx: 70 + 1110 * x, cy: 300 - 280 * y, r: 4, class: kind, "fill-opacity": 0.6 });
      point.addEventListener("click", () => open(row));
    }
    if (!points.length) { add("text", { x: 600, y: 160 }, "no bag has both"); return; }
    add("text", { x: 70, y: 325 }, show(ends[0][0]));
    add("text", { x: 1180, y: 325, "text-anchor": "end" }, `${show(ends[0][1])}  ${names[0]}`);
    add("text", { x: 62, y: 300, "text-anchor": "end" }, show(ends[1][0]));
    add("text", { x: 62, y: 24, "text-anchor": "end" }, show(ends[1][1]));
    add("text", { x: 70, y: 12 }, names[1]);
  }

  function draw() {
    const found = chosen();
    const more = found.length > MAX_ROWS ? `, the first ${MAX_ROWS} below` : "";
    byId("count").textContent = `${found.length} of ${rows.length} bags${more}`;
    plot(found);
    byId("rows").replaceChildren();
    for (const row of found.slice(0, MAX_ROWS)) {
      const line = make("tr", "", byId("rows"));
      for (const name of shown) {
        const cell = make("td", "", line);
        if (name === "bag") {
          const link = make("a", row[at.bag], cell);
          link.href = `/report/${rows.indexOf(row)}`;
          link.target = "_blank";
          link.title = row[at.path];
        } else cell.textContent = show(row[at[name]]);
        if (name === "problem") cell.className = "words bad";
      }
    }
  }

  for (const name of shown) {
    make("th", name.replaceAll("_", " "), byId("head")).addEventListener("click", () => {
      sorted = { name, down: sorted.name === name && !sorted.down };
      draw();
    });
  }
  for (const [id, first] of [["x", "duration_s"], ["y", "error_truth_mean_percent"]]) {
    for (const name of numeric) make("option", name, byId(id)).selected = name === first;
    byId(id).addEventListener("change", draw);
  }
  byId("filter").addEventListener("input", draw);
  draw();
})();
