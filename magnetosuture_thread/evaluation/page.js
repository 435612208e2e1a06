"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const plots = []; // { element, draw }
  let range = data.range.slice();
  let moving = false;

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

  // The library is packed, to two fifths of its size.
  async function loadLibrary() {
    const packed = Uint8Array.from(atob(document.getElementById("library").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  }

  function axis(more) {
    return { color: colour("faint"), gridcolor: colour("grid"), linecolor: colour("line"), zeroline: false, exponentformat: "power", ...more };
  }

  function layout(y, more) {
    return {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true,
      font: { family: "system-ui, sans-serif", size: 13, color: colour("ink") },
      margin: { l: 76, r: 12, t: 40, b: 44 }, hovermode: "x unified", dragmode: "zoom",
      hoverlabel: { bgcolor: colour("panel"), bordercolor: colour("line"), font: { color: colour("ink") } },
      legend: { orientation: "h", x: 0, y: 1.02, xanchor: "left", yanchor: "bottom" },
      xaxis: axis({ title: { text: "time since the bag's start [s]", standoff: 6 }, range: range.slice(), hoverformat: ".3f" }),
      yaxis: axis(y),
      annotations: data.simulated ? [{
        text: "simulated", showarrow: false, xref: "paper", yref: "paper", x: 1, y: 1, xanchor: "right", yanchor: "top",
        font: { size: 12, color: colour("warm-ink") }, bgcolor: colour("warm"), borderpad: 3,
      }] : [],
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("faint"), activecolor: colour("ink") }, ...more,
    };
  }

  // Where the needle was not found, and where something acted on the thread that the model does not know.
  function bands() {
    const of = (times, name) => times.map(([from, to]) => ({
      type: "rect", xref: "x", yref: "paper", x0: from, x1: Math.max(to, from + 1e-3), y0: 0, y1: 1,
      fillcolor: colour(name), line: { width: 0 }, layer: "below",
    }));
    return [...of(data.lost, "lost"), ...of(data.disturbances, "disturbed")];
  }

  function line(series) {
    const own = { color: colour(series.role) };
    // A value without neighbours makes no line: it gets a dot.
    const values = series.values;
    const alone = values.map((value, k) => (value !== null && (values[k - 1] ?? null) === null && (values[k + 1] ?? null) === null ? 5 : 0));
    if (series.band) {
      return {
        type: "scatter", name: series.name, x: data.times[series.at], y: values, mode: "lines", line: { width: 0 },
        fill: series.band === "high" ? "tonexty" : "none", fillcolor: `${own.color}40`, showlegend: series.band === "high",
        hovertemplate: `%{y:.3g}<extra>${series.band === "high" ? "band, upper end" : "band, lower end"}</extra>`,
      };
    }
    const mode = series.dots ? "markers" : alone.some(Boolean) ? "lines+markers" : "lines";
    return {
      type: "scatter", name: series.name, x: data.times[series.at], y: values, connectgaps: false,
      mode, line: { ...own, width: 1.6, dash: series.dash || "solid" }, hovertemplate: "%{y:.4g}",
      marker: { ...own, size: series.dots ? 3.5 : alone, opacity: series.dots ? 0.7 : 1, line: { width: 0 } },
    };
  }

  function markers() {
    return {
      type: "scatter", name: "worst moments", mode: "markers+text", showlegend: false, hoverinfo: "skip", cliponaxis: false,
      x: data.moments.map((m) => m.time), y: data.moments.map((m) => m.error), text: data.moments.map((m) => `${m.number}`),
      textposition: "middle center", textfont: { color: colour("panel"), size: 12 },
      marker: { color: colour("bad"), size: 18, line: { color: colour("panel"), width: 1 } },
    };
  }

  function lines(plot) {
    const traces = plot.series.map(line);
    const shapes = bands();
    if (plot.moments && data.moments.length) traces.push(markers());
    if (plot.zero) {
      shapes.push({ type: "line", xref: "paper", x0: 0, x1: 1, y0: 0, y1: 0, line: { color: colour("bad"), width: 1.5 } });
    }
    const y = { title: { text: plot.y } };
    if (plot.log) Object.assign(y, { type: "log", dtick: 1 });
    if (plot.floor === 0) y.rangemode = "tozero";
    if (plot.top) y.range = [0, plot.top];
    if (plot.zero) y.range = aroundZero(plot.series);
    return [traces, layout(y, { shapes, showlegend: plot.series.length > 0 })];
  }

  // All values, zero among them, and some room.
  function aroundZero(series) {
    let low = 0, high = 0;
    for (const one of series) for (const value of one.values) {
      if (value !== null) { low = Math.min(low, value); high = Math.max(high, value); }
    }
    const room = Math.max(0.08 * (high - low), 1e-3); // so that rounding does not fill the plot
    return [low - room, high + room];
  }

  // Both maps have one scale of colours.
  const greatest = [data.estimate_map, data.map].filter(Boolean).flatMap((grid) => grid.errors).reduce(
    (high, row) => row.reduce((a, b) => Math.max(a, b ?? 0), high), 1e-9,
  );

  function map(grid) {
    const trace = {
      type: "heatmap", x: grid.times, y: grid.lengths, z: grid.errors, colorscale: "Viridis", hoverongaps: false,
      colorbar: { title: { text: "% of length", side: "right" }, thickness: 14, outlinewidth: 0, exponentformat: "power", tickcolor: colour("faint") },
      hovertemplate: "%{x:.3f} s, %{y:.3g} mm: %{z:.3g} %<extra></extra>", zmin: 0,
      zmax: greatest,
    };
    return [[trace], layout({ title: { text: "from the needle [mm]" } }, { hovermode: "closest", shapes: bands() })];
  }

  function show(from, to, source) {
    range = [from, to];
    moving = true;
    const change = { "xaxis.range[0]": from, "xaxis.range[1]": to };
    const others = plots.filter((plot) => plot.element !== source);
    Promise.all(others.map((plot) => Plotly.relayout(plot.element, change))).finally(() => { moving = false; });
  }

  function follow(element) {
    element.on("plotly_relayout", (change) => {
      if (moving) return;
      if (change["xaxis.autorange"]) show(data.range[0], data.range[1], null);
      else if ("xaxis.range[0]" in change) show(change["xaxis.range[0]"], change["xaxis.range[1]"], element);
      else if ("xaxis.range" in change) show(...change["xaxis.range"], element);
    });
    element.on("plotly_doubleclick", () => { show(data.range[0], data.range[1], null); });
  }

  function add(id, make) {
    const element = document.getElementById(`plot-${id}`);
    const config = {
      responsive: true, displaylogo: false, doubleClick: "autosize", showSendToCloud: false,
      modeBarButtons: [["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"], ["toImage"]], toImageButtonOptions: { format: "svg", filename: id },
    };
    const draw = () => Plotly.react(element, ...make(), config);
    plots.push({ element, draw });
    draw();
    follow(element);
  }

  function redraw() { for (const plot of plots) plot.draw(); }

  async function begin() {
    await loadLibrary();
    for (const plot of data.plots) add(plot.id, () => lines(plot));
    if (data.estimate_map) add("estimate_map", () => map(data.estimate_map));
    if (data.map) add("map", () => map(data.map));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
    matchMedia("print").addEventListener("change", redraw);
    for (const button of document.querySelectorAll("button[data-time]")) {
      button.addEventListener("click", () => {
        const time = Number(button.dataset.time);
        show(Math.max(data.range[0], time - 1), Math.min(data.range[1], time + 1), null);
        document.getElementById("error").scrollIntoView({ behavior: "smooth" });
      });
    }
    for (const empty of document.querySelectorAll(".plot:empty")) empty.remove();
    for (const picture of document.querySelectorAll(".picture")) {
      picture.addEventListener("click", () => picture.parentElement.classList.toggle("wide"));
    }
    document.documentElement.dataset.drawn = plots.length;
  }

  begin().catch((error) => {
    const place = document.getElementById("problem");
    place.textContent = `The plots cannot be drawn: ${error.message}. A browser of 2023 or later is needed.`;
    place.hidden = false;
  });
})();
