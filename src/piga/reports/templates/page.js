"use strict";
(() => {
  const figures = [...document.querySelectorAll("figure.figure")];
  if (!window.Plotly || !("IntersectionObserver" in window)) return;
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)");
  const config = {
    displaylogo: false,
    responsive: true,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "sendChartToCloud"],
    plotlyServerURL: "",
    doubleClick: "reset",
  };

  // A figure comes as plain data (`figure_document` in figure.py): its panels with their axes and series.
  const DAY = 86.4e6;  // plotly.js counts dates in milliseconds since 1970-01-01
  const AXIS = {
    tickfont: { size: 11 }, showline: true, ticks: "outside", ticklen: 4, zeroline: false, automargin: true,
    exponentformat: "power", minexponent: 5,
  };
  const MODES = { points: "markers", "line+points": "lines+markers" };
  const suffix = (index) => (index ? String(index + 1) : "");
  const days = (values, axis) => (axis.dates ? values.map((value) => value === null ? null : value * DAY) : values);

  const hover = ({ name, text }, { x, y }) => {
    const value = (axis, letter) => {
      if (axis.dates) return `${axis.quantity} %{${letter}|%Y-%m-%d %H:%M} UTC`;
      return `${axis.quantity} %{${letter}:.5~g}${["", "1"].includes(axis.unit) ? "" : ` ${axis.unit}`}`;
    };
    const named = x.names.length > 0;
    const lines = [...(name ? [`<b>${name}</b>`] : []), ...(text || named ? ["%{text}"] : []), ...(named ? [] : [value(x, "x")])];
    return `${[...lines, value(y, "y")].join("<br>")}<extra></extra>`;
  };

  const look = ({ mark, role, dashed, x }, colour) => {
    if (mark === "bars") {
      const places = [...new Set(x)].sort((one, other) => one - other);
      const steps = places.slice(1).map((place, k) => place - places[k]);
      return { type: "bar", marker: { color: colour }, textposition: "none", width: 0.8 * (steps.length ? Math.min(...steps) : 1) };
    }
    const line = { color: colour, width: mark === "band" ? 0 : role === "muted" ? 1 : 1.5, dash: dashed ? "dash" : "solid" };
    if (mark === "steps") line.shape = "hvh";
    if (mark === "band") return { type: "scatter", mode: "lines", line, fill: "tonexty", fillcolor: `${colour}2e` };
    return { type: "scatter", mode: MODES[mark] || "lines", line, marker: { color: colour, size: 5 } };
  };

  const tracesOf = ({ key, panels }, style) => {
    const traces = [], shown = new Set();
    panels.forEach((panel, index) => panel.series.forEach((series, order) => {
      const { name, role, mark, text, segments, error } = series;
      const colour = style.getPropertyValue(`--${role}`).trim();
      const trace = {
        x: days(series.x, panel.x), y: series.upper || series.y, xaxis: `x${suffix(index)}`, yaxis: `y${suffix(index)}`,
        name, legendgroup: name, showlegend: name !== "" && !shown.has(name), uid: `${key}-p${index}-s${order}`,
        meta: segments, text: text || (panel.x.names.length ? series.x.map((place) => panel.x.names[Math.round(place) - 1]) : undefined),
        ...(role === "muted" && !name ? { hoverinfo: "skip" } : { hovertemplate: hover(series, panel) }),
        ...(error ? { error_y: { array: error, color: colour, thickness: 1, width: 2 } } : {}),
        ...look(series, colour),
      };
      shown.add(name);
      if (mark === "band") {
        traces.push({ ...trace, y: series.y, fill: "none", showlegend: false, uid: `${trace.uid}-lower`, hoverinfo: "skip", hovertemplate: "" });
      }
      traces.push(trace);
    }));
    return traces;
  };

  const axisOf = (axis, series, letter, title, style) => {
    const colours = { gridcolor: style.getPropertyValue("--grid").trim(), linecolor: style.getPropertyValue("--soft").trim() };
    const made = { ...AXIS, ...colours, tickcolor: colours.linecolor, title: { text: title ? axis.label : "", standoff: 6, font: { size: 12 } } };
    if (axis.log) {  // 1, 2, 5 in each decade; of many decades the whole ones
      const values = series.flatMap((one) => one[letter]).filter((value) => value > 0);
      const [least, most] = values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, 0]);
      Object.assign(made, { type: "log", dtick: values.length && most < 300 * least ? "D2" : 1 });
    }
    if (axis.dates) Object.assign(made, { type: "date", nticks: 7 });
    if (axis.names.length) Object.assign(made, { tickvals: axis.names.map((_, k) => k + 1), ticktext: axis.names });
    if (axis.limits) made.range = axis.limits.map((end) => (axis.log ? Math.log10(end) : end));
    return made;
  };

  // On a narrow page the panels stand below each other, in smaller letters.
  const sizeOf = ({ panels, rows, height }, narrow) => {
    if (!narrow) return Math.round(height * rows * 96 + 40);
    return Math.round((panels.some((panel) => panel.equal) ? 3.3 : 2.9) * panels.length * 96 + 60);
  };
  const layoutOf = (figure, narrow, style) => {
    const { panels, shared } = figure;
    const [rows, columns] = narrow ? [panels.length, 1] : [figure.rows, figure.columns];
    const titled = panels.some((panel) => panel.title);
    const height = sizeOf(figure, narrow);
    const words = 46 * !shared + 34 * titled;  // pixels of a row for the x axis below its panels and the titles above
    const layout = {
      height,
      margin: { l: narrow ? 50 : 64, r: narrow ? 6 : 12, t: titled ? 70 : 44, b: 48 },
      font: { family: "system-ui, sans-serif", size: narrow ? 11 : 13, color: style.getPropertyValue("--ink").trim() },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      hovermode: "closest",
      separators: ".\u202f",
      legend: { orientation: "h", x: 0, xanchor: "left", yanchor: "bottom", y: 1 + (titled ? 24 : 6) / (height - 110) },
      grid: { rows, columns, pattern: "independent", xgap: 0.2, ygap: rows > 1 ? Math.max(0.16, words / (figure.height * 96)) : 0 },
      annotations: panels.flatMap(({ title }, index) => (title ? [{
        text: `<b>${title}</b>`, x: 0, y: 1, xref: `x${suffix(index)} domain`, yref: `y${suffix(index)} domain`,
        showarrow: false, xanchor: "left", yanchor: "bottom", font: { size: 13 },
      }] : [])),
    };
    const last = suffix(panels.length - 1);
    panels.forEach((panel, index) => {
      const inside = shared && index < panels.length - 1;
      const x = { ...axisOf(panel.x, panel.series, "x", !inside, style), anchor: `y${suffix(index)}` };
      const y = { ...axisOf(panel.y, panel.series, "y", true, style), anchor: `x${suffix(index)}` };
      if (inside) Object.assign(x, { matches: `x${last}`, showticklabels: false });
      if (panel.equal) {
        Object.assign(y, { scaleanchor: `x${suffix(index)}`, constrain: "domain" });
        Object.assign(x, { constrain: "domain", nticks: 6 });
      }
      Object.assign(layout, { [`xaxis${suffix(index)}`]: x, [`yaxis${suffix(index)}`]: y });
    });
    return layout;
  };

  // A selected segment is marked in every figure and table: its points are ringed or drawn heavily, the others fade.
  const picker = document.getElementById("chosen");
  const names = picker ? [...picker.options].slice(1).map((option) => option.text) : [];
  let selected = null;
  const marked = (traces, ink) => {
    const extra = [];
    const name = `segment ${names[selected]}`.replace(/&/g, "&amp;").replace(/</g, "&lt;");
    const add = (trace) => extra.push({
      ...trace, meta: null, text: null, hoverinfo: "skip", hovertemplate: "", name,
      legendgroup: "selected", showlegend: !extra.length, uid: `${trace.uid}-selected`,
    });
    const data = traces.map((trace) => {
      if (!Array.isArray(trace.meta) || !trace.meta.includes(selected)) return trace;
      const y = trace.y.map((value, k) => (trace.meta[k] === selected ? value : null));
      if (trace.mode === "markers") add({ ...trace, y, marker: { color: ink, size: 13, symbol: "circle-open", line: { width: 2.5 } } });
      else add({ ...trace, y, line: { color: ink, width: 2 } });
      return { ...trace, opacity: 0.35 };
    });
    return data.concat(extra);
  };

  const specs = new Map(figures.map((figure) => [figure, JSON.parse(figure.querySelector("script.spec").textContent)]));
  // Paper: a figure has the colours of white paper, and is as wide as the text of an A4 page.
  const PAPER_WIDTH = 680;
  let printing = false;
  const isNarrow = (figure) => !printing && figure.clientWidth < 560;
  // A figure has its height before it is drawn. Else the page moves under a reader who is just clicking.
  const reserve = (figure) => {
    const height = sizeOf(specs.get(figure), isNarrow(figure));
    figure.querySelector(".live").style.minHeight = `${height}px`;
  };
  const draw = (figure) => {
    const spec = specs.get(figure);
    const style = getComputedStyle(document.body);
    const narrow = isNarrow(figure);
    const layout = layoutOf(spec, narrow, style);
    figure.dataset.narrow = narrow;
    if (printing) layout.width = PAPER_WIDTH;
    layout.hoverlabel = { bgcolor: style.getPropertyValue("--paper").trim(), font: { color: layout.font.color } };
    layout.modebar = { bgcolor: "rgba(0,0,0,0)", color: style.getPropertyValue("--soft").trim() };
    if (touch.matches) {
      // A finger scrolls the page; it does not zoom the figure by accident.
      layout.dragmode = false;
      Object.keys(layout).filter((key) => /^[xy]axis/.test(key)).forEach((key) => { layout[key].fixedrange = true; });
    }
    layout.uirevision = "kept";  // what the reader zoomed stays
    const traces = tracesOf(spec, style);
    const data = selected === null ? traces : marked(traces, layout.font.color);
    const live = figure.querySelector(".live");
    live.dataset.plain = live.dataset.plain || live.getAttribute("aria-label");
    live.setAttribute("aria-label", live.dataset.plain + (data.length > traces.length ? ` Segment ${names[selected]} is marked.` : ""));
    reserve(figure);
    figure.classList.add("upgraded");
    // In a narrow figure the buttons would cover the legend; dragging and a double click zoom there, too.
    const own = touch.matches || narrow || printing ? { ...config, displayModeBar: false } : config;
    Plotly.react(live, data, layout, own)
      .then(() => {
        live.removeAllListeners("plotly_click");
        live.on("plotly_click", ({ points: [point] }) => {
          if (Array.isArray(point.data.meta)) toggle(point.data.meta[point.pointNumber]);
        });
      })
      .catch(() => figure.classList.remove("upgraded"));
  };

  const observer = new IntersectionObserver((entries) => {
    entries.filter((entry) => entry.isIntersecting).forEach((entry) => {
      observer.unobserve(entry.target);
      draw(entry.target);
    });
  }, { rootMargin: "400px" });
  figures.forEach((figure) => {
    reserve(figure);
    observer.observe(figure);
  });
  const print = (now) => {
    printing = now;
    document.body.classList.toggle("paper", now);
    if (now) figures.forEach(draw);
    else figures.filter((figure) => figure.classList.contains("upgraded")).forEach(draw);
  };
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));

  const rows = [...document.querySelectorAll("tr[data-segment]")].filter((row) => names[Number(row.dataset.segment)] !== undefined);
  const select = (segment) => {
    selected = segment;
    picker.value = segment === null ? "" : String(segment);
    rows.forEach((row) => {
      const own = Number(row.dataset.segment) === segment;
      row.classList.toggle("selected", own);
      row.querySelector("button").setAttribute("aria-pressed", String(own));
    });
    redraw((figure) => specs.get(figure).panels.some((panel) => panel.series.some((series) => series.segments)));
  };
  const toggle = (segment) => {
    if (names[segment] !== undefined) select(segment === selected ? null : segment);
  };
  if (picker) {
    picker.closest(".chosen").hidden = false;
    picker.addEventListener("change", () => select(picker.value === "" ? null : Number(picker.value)));
    document.addEventListener("keydown", (event) => { if (event.key === "Escape" && selected !== null) select(null); });
    rows.forEach((row) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...row.cells[0].childNodes);
      button.setAttribute("aria-pressed", "false");
      row.cells[0].append(button);
      row.addEventListener("click", () => toggle(Number(row.dataset.segment)));
    });
  }

  const redraw = (test) => figures.filter((f) => f.classList.contains("upgraded") && test(f)).forEach(draw);
  dark.addEventListener("change", () => redraw(() => true));
  let pending = 0;
  window.addEventListener("resize", () => {
    clearTimeout(pending);
    pending = setTimeout(() => {
      figures.forEach(reserve);
      redraw((f) => f.dataset.narrow !== String(isNarrow(f)));
    }, 150);
  });
})();
