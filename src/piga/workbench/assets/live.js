"use strict";
(() => {
  const place = document.getElementById("live");
  const below = document.getElementById("live-u");
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  let seconds = 60;
  const axis = () => ({ values: tickNumbers, stroke: () => style("--soft"), grid: { stroke: () => style("--grid"), width: 1 }, ticks: { stroke: () => style("--grid"), width: 1 } });
  const axes = (unit) => [{ ...axis(), label: "time [s]", labelSize: 22, size: 40 }, { ...axis(), label: unit, labelSize: 22, size: 80 }];
  const line = (role) => ({ stroke: () => style(role), width: 1, points: { show: false } });
  const band = (low, role) => ({ series: [low + 1, low], fill: () => `color-mix(in srgb, ${style(role)} 35%, transparent)` });
  const plot = (target, height, series, bands, y) => new uPlot({
    width: target.clientWidth, height, series: [{}, ...series], bands, axes: axes("g"),
    scales: { x: { time: false }, y }, legend: { show: false }, cursor: { drag: { x: false, y: false } },
  }, [[0], ...series.map(() => [null])], target);
  const force = plot(place, 300, [line("--role-before"), line("--role-before"), line("--role-after"), line("--role-after")],
    [band(1, "--role-before"), band(3, "--role-after")], {});
  const uncertainty = plot(below, 190, [line("--role-data")], [], { range: (u, least, largest) => [0, 1.1 * largest || 1] });
  const next = async () => {
    try {
      const answer = await fetch(`/live/data?seconds=${seconds}&width=${Math.max(place.clientWidth, 200)}`);
      if (answer.ok) {
        const values = new Float64Array(await answer.arrayBuffer());
        const data = Array.from({ length: 6 }, () => []);
        values.forEach((value, index) => data[index % 6].push(Number.isNaN(value) ? null : value));
        if (data[0].length) {
          force.setData(data.slice(0, 5));
          uncertainty.setData([data[0], data[5]]);
        }
      }
    } finally {
      setTimeout(next, 500);
    }
  };
  document.querySelectorAll("[data-seconds]").forEach((button) => button.addEventListener("click", () => {
    seconds = Number(button.dataset.seconds);
    document.querySelectorAll("[data-seconds]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
  }));
  new ResizeObserver(() => {
    force.setSize({ width: place.clientWidth, height: 300 });
    uncertainty.setSize({ width: below.clientWidth, height: 190 });
  }).observe(place);
  next();
})();
