"use strict";
(() => {
  const page = document.getElementById("signals");
  const duration = Number(page.dataset.duration);
  const span = document.getElementById("span");
  const roles = { "specific force": ["--role-x", "--role-y", "--role-z"], "base rate": ["--role-x", "--role-y", "--role-z"] };
  const marks = [...document.querySelectorAll(".finding")].map((button) => Number(button.dataset.time));
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  let shown = [0, duration];
  let wanted = 0;
  let marked = null;

  const pictures = [...page.querySelectorAll("figure.signal")].map((figure) => ({
    figure,
    place: figure.querySelector(".plot"),
    keys: figure.dataset.keys,
    titles: figure.dataset.titles.split(","),
    unit: figure.dataset.unit,
    colours: roles[figure.dataset.group] || ["--role-after"],
    plot: null,
  }));

  const draw = (picture, data) => {
    if (picture.plot) {
      picture.plot.setData(data, false);
      picture.plot.setScale("x", { min: shown[0], max: shown[1] });
      return;
    }
    const series = [{ label: "s", value: (u, v) => (v === null ? "" : v.toFixed(4)) }];
    const bands = [];
    picture.titles.forEach((title, index) => {
      const stroke = () => style(picture.colours[index % picture.colours.length]);
      const value = (u, v) => (v === null ? "" : v.toPrecision(7));
      series.push({ label: `${title} least`, stroke, width: 1, value, points: { show: false } });
      series.push({ label: `${title} largest`, stroke, width: 1, value, points: { show: false } });
      bands.push({ series: [2 * index + 2, 2 * index + 1], fill: () => `color-mix(in srgb, ${stroke()} 35%, transparent)` });
    });
    const axis = { values: tickNumbers, stroke: () => style("--soft"), grid: { stroke: () => style("--grid"), width: 1 }, ticks: { stroke: () => style("--grid"), width: 1 } };
    picture.plot = new uPlot({
      width: picture.place.clientWidth, height: 190, series, bands,
      scales: { x: { time: false, auto: false, min: shown[0], max: shown[1] } },
      axes: [{ ...axis, label: "time since the first sample [s]", labelSize: 22, size: 40 }, { ...axis, label: picture.unit, labelSize: 22, size: 70 }],
      legend: { show: false },
      cursor: { sync: { key: "signals" }, drag: { x: true, y: false, setScale: false } },
      hooks: {
        setSelect: [(u) => {
          const ends = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")];
          if (u.select.width > 3) (marking() ? markSpan : show)(...ends);
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
        }],
        draw: [(u) => {
          u.ctx.save();
          u.ctx.strokeStyle = style("--bad");
          u.ctx.setLineDash([4, 4]);
          for (const time of marks) {
            if (time < shown[0] || time > shown[1]) continue;
            const x = Math.round(u.valToPos(time, "x", true));
            u.ctx.beginPath(); u.ctx.moveTo(x, u.bbox.top); u.ctx.lineTo(x, u.bbox.top + u.bbox.height); u.ctx.stroke();
          }
          if (marked && marking()) {
            const [a, b] = marked.map((time) => u.valToPos(time, "x", true));
            const left = Math.max(a, u.bbox.left);
            u.ctx.fillStyle = style("--bad");
            u.ctx.globalAlpha = 0.15;
            u.ctx.fillRect(left, u.bbox.top, Math.min(b, u.bbox.left + u.bbox.width) - left, u.bbox.height);
          }
          u.ctx.restore();
        }],
      },
    }, data, picture.place);
  };

  const load = async (picture, turn) => {
    const width = Math.max(200, Math.round(picture.place.clientWidth * devicePixelRatio));
    const answer = await fetch(`${page.dataset.source}?keys=${picture.keys}&from=${shown[0]}&to=${shown[1]}&width=${Math.min(width, 4096)}`);
    if (!answer.ok || turn !== wanted) return;
    const columns = Number(answer.headers.get("x-columns"));
    const values = new Float64Array(await answer.arrayBuffer());
    if (turn !== wanted) return;
    const data = Array.from({ length: columns }, () => []);
    for (let row = 0; row < values.length; row += columns) {
      for (let column = 0; column < columns; column += 1) {
        const value = values[row + column];
        data[column].push(Number.isNaN(value) ? null : value);
      }
    }
    draw(picture, data);
    picture.figure.dataset.points = String(values.length / columns);
  };

  const show = (first, last) => {
    const size = Math.min(Math.max(last - first, 1e-9 * duration + 1e-6), duration);
    const from = Math.min(Math.max(first, 0), duration - size);
    shown = [from, from + size];
    span.textContent = `${from.toPrecision(6)} to ${(from + size).toPrecision(6)} s`;
    wanted += 1;
    const turn = wanted;
    return Promise.all(pictures.map((picture) => load(picture, turn)));
  };

  const mark = document.getElementById("mark");
  const form = document.getElementById("leave-out");
  const marking = () => mark.getAttribute("aria-pressed") === "true";
  mark.addEventListener("click", () => {
    mark.setAttribute("aria-pressed", String(!marking()));
    if (marking()) markSpan(...shown);  // without a mouse: the span that is shown
    form.hidden = !marking();
  });
  const markSpan = (first, last) => {
    form.elements.from.value = String(first);
    form.elements.to.value = String(last);
    document.getElementById("marked").textContent = `${first.toPrecision(7)} to ${last.toPrecision(7)} s`;
    marked = [first, last];
    pictures.forEach((picture) => picture.plot && picture.plot.redraw());
  };

  const moves = {
    earlier: (a, b) => [a - (b - a) / 2, b - (b - a) / 2],
    later: (a, b) => [a + (b - a) / 2, b + (b - a) / 2],
    in: (a, b) => [a + (b - a) / 4, b - (b - a) / 4],
    out: (a, b) => [a - (b - a) / 2, b + (b - a) / 2],
    all: () => [0, duration],
  };
  document.querySelectorAll("[data-move]").forEach((button) => {
    button.addEventListener("click", () => show(...moves[button.dataset.move](...shown)));
  });
  document.querySelectorAll(".segment").forEach((button) => {
    button.addEventListener("click", () => show(Number(button.dataset.from), Number(button.dataset.to)));
  });
  document.querySelectorAll(".finding").forEach((button) => {
    const time = Number(button.dataset.time);
    button.addEventListener("click", () => show(time - duration / 200, time + duration / 200));
  });
  new ResizeObserver(() => {
    pictures.forEach((picture) => picture.plot && picture.plot.setSize({ width: picture.place.clientWidth, height: 190 }));
  }).observe(page);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => pictures.forEach((picture) => picture.plot && picture.plot.redraw()));
  show(0, duration);
})();
