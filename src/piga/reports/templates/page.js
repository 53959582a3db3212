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

  // Says how many of the rows in view are drawn, where a curve shows only the outline of its rows.
  const tell = (figure, live) => {
    const trace = live.data.find((item) => item.customdata);
    if (!trace) return;
    const axis = live._fullLayout[(trace.xaxis || "x").replace("x", "xaxis")];
    const [low, high] = axis.range.map(Number);
    const points = trace.customdata.filter((_, k) => trace.x[k] >= low && trace.x[k] <= high && trace.y[k] !== null);
    const first = points.reduce((a, b) => Math.min(a, b), Infinity);
    const last = points.reduce((a, b) => Math.max(a, b), -Infinity);
    const line = figure.querySelector("p.shown") || live.insertAdjacentElement("afterend", document.createElement("p"));
    line.className = "note shown";
    line.textContent = points.length ? `In view: ${points.length} points of ${last - first + 1} rows.` : "In view: no point.";
  };

  const draw = (figure) => {
    const spec = JSON.parse(figure.querySelector("script.spec").textContent);
    const style = getComputedStyle(document.documentElement);
    const layout = themed(spec.layout, style);
    const narrow = figure.clientWidth < 560;
    figure.dataset.narrow = narrow;
    if (narrow) Object.entries(spec.narrow).forEach(([path, value]) => change(layout, path, value));
    layout.hoverlabel = { bgcolor: style.getPropertyValue("--paper").trim(), font: { color: layout.font.color } };
    layout.modebar = { bgcolor: "rgba(0,0,0,0)", color: style.getPropertyValue("--soft").trim() };
    if (touch.matches) {
      // A finger scrolls the page; it does not zoom the figure by accident.
      layout.dragmode = false;
      Object.keys(layout).filter((key) => /^[xy]axis/.test(key)).forEach((key) => { layout[key].fixedrange = true; });
    }
    const live = figure.querySelector(".live");
    figure.classList.add("upgraded");
    // In a narrow figure the buttons would cover the legend; dragging and a double click zoom there, too.
    const own = touch.matches || narrow ? { ...config, displayModeBar: false } : config;
    Plotly.react(live, themed(spec.data, style), layout, own)
      .then(() => {
        tell(figure, live);
        live.removeAllListeners("plotly_relayout");
        live.on("plotly_relayout", () => tell(figure, live));
      })
      .catch(() => figure.classList.remove("upgraded"));
  };

  const observer = new IntersectionObserver((entries) => {
    entries.filter((entry) => entry.isIntersecting).forEach((entry) => {
      observer.unobserve(entry.target);
      draw(entry.target);
    });
  }, { rootMargin: "400px" });
  figures.forEach((figure) => observer.observe(figure));

  const redraw = (test) => figures.filter((f) => f.classList.contains("upgraded") && test(f)).forEach(draw);
  dark.addEventListener("change", () => redraw(() => true));
  let pending = 0;
  window.addEventListener("resize", () => {
    clearTimeout(pending);
    pending = setTimeout(() => redraw((f) => f.dataset.narrow !== String(f.clientWidth < 560)), 150);
  });
})();
