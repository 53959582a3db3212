"use strict";
(() => {
  const figures = [...document.querySelectorAll("figure.figure")];
  if (!window.Plotly || !("IntersectionObserver" in window)) return;
  const palette = JSON.parse(document.getElementById("palette").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)");
  const config = {
    displaylogo: false,
    responsive: true,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "sendChartToCloud"],
    plotlyServerURL: "",
    doubleClick: "reset",
  };

  // Colours of the figure (#rrggbb, or #rrggbbaa with opacity) become those of the page's present theme.
  const colour = (text, style) => {
    const name = palette[text.slice(0, 7)];
    return name ? style.getPropertyValue(name).trim() + text.slice(7) : text;
  };
  const themed = (node, style) => {
    if (Array.isArray(node)) return typeof node[0] === "number" ? node : node.map((item) => themed(item, style));
    if (node && typeof node === "object") {
      return Object.fromEntries(Object.entries(node).map(([key, value]) => [key, themed(value, style)]));
    }
    return typeof node === "string" && /^#[0-9a-f]{6,8}$/.test(node) ? colour(node, style) : node;
  };

  const change = (layout, path, value) => {
    const steps = path.replace(/\[(\d+)\]/g, ".$1").split(".");
    const last = steps.pop();
    steps.reduce((node, step) => node[step], layout)[last] = value;
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
  // Paper: the colours of the specification are those on white, and a figure is as wide as the text of an A4 page.
  const paper = { getPropertyValue: (name) => Object.keys(palette).find((key) => palette[key] === name) || "" };
  const PAPER_WIDTH = 680;
  let printing = false;
  const isNarrow = (figure) => !printing && figure.clientWidth < 560;
  // A figure has its height before it is drawn. Else the page moves under a reader who is just clicking.
  const reserve = (figure) => {
    const { layout, narrow } = specs.get(figure);
    const height = isNarrow(figure) && narrow.height ? narrow.height : layout.height;
    figure.querySelector(".live").style.minHeight = `${height}px`;
  };
  const draw = (figure) => {
    const spec = specs.get(figure);
    const style = printing ? paper : getComputedStyle(document.documentElement);
    const layout = themed(spec.layout, style);
    const narrow = isNarrow(figure);
    figure.dataset.narrow = narrow;
    if (printing) layout.width = PAPER_WIDTH;
    if (narrow) Object.entries(spec.narrow).forEach(([path, value]) => change(layout, path, value));
    layout.hoverlabel = { bgcolor: style.getPropertyValue("--paper").trim(), font: { color: layout.font.color } };
    layout.modebar = { bgcolor: "rgba(0,0,0,0)", color: style.getPropertyValue("--soft").trim() };
    if (touch.matches) {
      // A finger scrolls the page; it does not zoom the figure by accident.
      layout.dragmode = false;
      Object.keys(layout).filter((key) => /^[xy]axis/.test(key)).forEach((key) => { layout[key].fixedrange = true; });
    }
    layout.uirevision = "kept";  // what the reader zoomed stays
    const themedData = themed(spec.data, style);
    const data = selected === null ? themedData : marked(themedData, layout.font.color);
    const live = figure.querySelector(".live");
    live.dataset.plain = live.dataset.plain || live.getAttribute("aria-label");
    live.setAttribute("aria-label", live.dataset.plain + (data.length > spec.data.length ? ` Segment ${names[selected]} is marked.` : ""));
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
    redraw((figure) => specs.get(figure).data.some((trace) => Array.isArray(trace.meta)));
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
