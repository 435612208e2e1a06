"use strict";
(async () => {
  const MAX_ROWS = 300;
  const MAX_LINES = 8;
  const byId = (id) => document.getElementById(id);
  const { columns, rows } = await (await fetch("/bags.json")).json();
  const at = Object.fromEntries(columns.map((name, index) => [name, index]));
  const numeric = columns.filter((name, index) => rows.some((row) => typeof row[index] === "number"));
  const shown = ["bag", "setup", "duration_s", "frames", "predicted", "error_truth_mean_percent", "error_seen_mean_percent",
    "least_obstacle_m", "tension_max_n", "damage", "problem"];
  const texts = ["bag", "path", "setup", "scene", "material", "problem", "damage"];
  let sorted = { name: "bag", down: false };
  const ticked = new Map(); // row of each bag that is ticked, with its seconds and its colour

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

  function emptied(id) {
    const svg = byId(id);
    svg.replaceChildren();
    return (kind, attributes, text = "") => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
      for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
      element.textContent = text;
      svg.append(element);
      return element;
    };
  }

  function range(values) {
    const low = values.reduce((a, b) => Math.min(a, b), Infinity), high = values.reduce((a, b) => Math.max(a, b), -Infinity);
    return [low, high > low ? high : low + 1];
  }

  // Draws both axes' ends and names; returns where a point is.
  function axes(add, names, points) {
    const ends = [0, 1].map((axis) => range(points.map((point) => point[axis])));
    add("text", { x: 70, y: 325 }, show(ends[0][0]));
    add("text", { x: 1180, y: 325, "text-anchor": "end" }, `${show(ends[0][1])}  ${names[0]}`);
    add("text", { x: 62, y: 300, "text-anchor": "end" }, show(ends[1][0]));
    add("text", { x: 62, y: 24, "text-anchor": "end" }, show(ends[1][1]));
    add("text", { x: 70, y: 12 }, names[1]);
    const share = (value, [low, high]) => (value - low) / (high - low);
    return ([x, y]) => [70 + 1110 * share(x, ends[0]), 300 - 280 * share(y, ends[1])];
  }

  function plot(found) {
    const add = emptied("plot");
    const names = [byId("x").value, byId("y").value];
    const value = (row) => names.map((name) => row[at[name]]);
    const with_both = found.filter((row) => value(row).every((each) => typeof each === "number"));
    if (!with_both.length) { add("text", { x: 600, y: 160 }, "no bag has both"); return; }
    const place = axes(add, names, with_both.map(value));
    for (const row of with_both) {
      const [cx, cy] = place(value(row));
      const kind = row[at.simulated] ? "simulated" : "";
      const point = add("circle", { cx, cy, r: 4, class: kind, "fill-opacity": 0.6 });
      point.addEventListener("click", () => open(row));
    }
  }

  function plotSeconds() {
    const add = emptied("lines");
    byId("legend").replaceChildren();
    const name = byId("series").value;
    // A second without a value breaks the line.
    const lines = [...ticked].map(([row, { columns: of, rows: seconds, colour }]) => {
      const [second, column] = ["second", name].map((each) => of.indexOf(each));
      const parts = [[]];
      for (const each of seconds) {
        if (typeof each[column] === "number") parts.at(-1).push([each[second], each[column]]);
        else if (parts.at(-1).length) parts.push([]);
      }
      return { row, colour, parts };
    });
    const points = lines.flatMap(({ parts }) => parts.flat());
    if (!points.length) { add("text", { x: 600, y: 160 }, ticked.size ? "no bag that is ticked has it" : "no bag is ticked"); return; }
    const place = axes(add, ["s", name], points);
    for (const { row, colour, parts } of lines) {
      for (const part of parts.filter((each) => each.length)) {
        const [first] = part;
        const drawn = part.length > 1 ? part : [first, [first[0] + 0.5, first[1]]];
        add("polyline", { points: drawn.map((point) => place(point).join(",")).join(" "), stroke: colour });
      }
      make("span", row[at.bag], byId("legend")).style.color = colour;
    }
  }

  async function tick(box, row) {
    if (box.checked) {
      const used = new Set([...ticked.values()].map((each) => each.colour));
      const colour = Array.from({ length: MAX_LINES }, (_, k) => `hsl(${(205 + 137 * k) % 360} 65% 50%)`).find((each) => !used.has(each));
      box.checked = colour !== undefined;
      if (!box.checked) return;
      ticked.set(row, { columns: [], rows: [], colour });
      const answer = await fetch(`/seconds/${rows.indexOf(row)}.json`);
      if (answer.ok && ticked.has(row)) Object.assign(ticked.get(row), await answer.json());
    } else ticked.delete(row);
    plotSeconds();
  }

  function draw() {
    const found = chosen();
    const more = found.length > MAX_ROWS ? `, the first ${MAX_ROWS} below` : "";
    byId("count").textContent = `${found.length} of ${rows.length} bags${more}`;
    plot(found);
    byId("rows").replaceChildren();
    for (const row of found.slice(0, MAX_ROWS)) {
      const line = make("tr", "", byId("rows"));
      const box = make("input", "", make("td", "", line));
      box.type = "checkbox";
      box.ariaLabel = `plot ${row[at.bag]}`;
      box.checked = ticked.has(row);
      box.addEventListener("change", () => tick(box, row));
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
  for (const name of await (await fetch("/series.json")).json()) make("option", name, byId("series"));
  byId("series").addEventListener("change", plotSeconds);
  byId("filter").addEventListener("input", draw);
  draw();
  plotSeconds();
})();
