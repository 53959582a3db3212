"use strict";
// Numbers at the ticks of an axis, with as many digits as tell two neighbours apart.
const tickNumbers = (u, splits, axis, space, step) => {
  let digits = 0;
  while (digits < 12 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits += 1;
  const short = (value) => value.toExponential(Math.max(0, Math.ceil(Math.log10(Math.abs(value) / step))));
  return splits.map((value) => (value === null ? "" : (digits > 7 && value ? short(value) : value.toFixed(Math.min(digits, 7))).replace("-", "\u2212")));
};
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
// A chart that follows its place and the colours of the system.
const chart = (place, height, labels, options, data) => {
  const axis = { values: tickNumbers, stroke: () => colour("--soft"), grid: { stroke: () => colour("--grid"), width: 1 }, ticks: { stroke: () => colour("--grid"), width: 1 }, labelSize: 22 };
  const axes = [{ ...axis, label: labels[0], size: 40 }, { ...axis, label: labels[1], size: 72 }];
  const plot = new uPlot({ width: place.clientWidth, height, axes, ...options }, data, place);
  new ResizeObserver(() => plot.setSize({ width: place.clientWidth, height })).observe(place);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plot.redraw());
  return plot;
};

// A record as a picture: envelopes from the server for any span, positions as bands, spans that are left out or move.
const startPicture = () => {
  const page = document.getElementById("figures");
  if (!page || page.dataset.ready) return;
  page.dataset.ready = "1";
  const record = JSON.parse(page.dataset.drawn);
  const duration = record.duration;
  const find = (id) => document.getElementById(id);
  let shown = [0, duration];
  let wanted = 0;
  let marked = null;
  const pictures = [...page.querySelectorAll("figure")].map((figure) => ({
    figure, place: figure.querySelector(".plot"), plot: null,
    signals: [...figure.querySelectorAll(".key")].map((name) => ({ ...name.dataset, title: name.textContent, colour: () => getComputedStyle(name).getPropertyValue("--key").trim() })),
  }));

  const readout = (u) => {
    if (u.cursor.left < 0) return;
    const time = u.posToVal(u.cursor.left, "x");
    const position = record.positions.find((one) => one.first <= time && time <= one.last);
    const values = pictures.flatMap(({ plot, signals }) => signals.map((one, index) => {
      const value = plot?.data[1 + 2 * index]?.[plot.valToIdx(time)] ?? null;
      return value === null ? "" : `${one.title} ${value.toPrecision(7).replace("-", "\u2212")} ${one.unit}`;
    }));
    find("readout").textContent = [`${time.toFixed(3)} s`, position ? `position ${position.name}` : "between positions", ...values].filter(Boolean).join(" · ");
  };

  const band = (u, one, fill, label, next) => {
    const left = Math.max(u.valToPos(one.first, "x", true), u.bbox.left);
    const right = Math.min(u.valToPos(one.last, "x", true), u.bbox.left + u.bbox.width);
    if (right < u.bbox.left || left > u.bbox.left + u.bbox.width) return;
    u.ctx.fillStyle = fill;
    u.ctx.fillRect(left, u.bbox.top, Math.max(right - left, 2), u.bbox.height);
    u.ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    const room = next ? u.valToPos(next.first, "x", true) - left : right - left; // a name may stand over the move after it
    if (u.ctx.measureText(label).width > room - 2) return;
    u.ctx.fillStyle = colour("--soft");
    u.ctx.textAlign = "center";
    u.ctx.fillText(label, (left + right) / 2, u.bbox.top + 13 * devicePixelRatio);
  };
  const bands = (u) => {
    u.ctx.save();
    record.positions.forEach((one, index) => band(u, one, index % 2 ? colour("--band") : "transparent", one.name, record.positions[index + 1] ?? { first: 2 * one.last - one.first }));
    record.left_out.forEach((one) => band(u, one, colour("--left-out"), `left out: ${one.name}`));
    record.moves.forEach((one) => band(u, one, colour("--moves"), "moves"));
    if (marked) band(u, { first: marked[0], last: marked[1] }, colour("--left-out"), "marked");
    u.ctx.strokeStyle = colour("--bad");
    u.ctx.setLineDash([4, 4]);
    for (const time of record.findings.map(([, at]) => at).filter((at) => at > 0 && at >= shown[0] && at <= shown[1])) {
      const x = Math.round(u.valToPos(time, "x", true));
      u.ctx.beginPath(); u.ctx.moveTo(x, u.bbox.top); u.ctx.lineTo(x, u.bbox.top + u.bbox.height); u.ctx.stroke();
    }
    u.ctx.restore();
  };

  const draw = (picture, data) => {
    if (picture.plot) {
      picture.plot.setData(data, false);
      picture.plot.setScale("x", { min: shown[0], max: shown[1] });
      return;
    }
    const lines = picture.signals.flatMap((one) => [0, 1].map(() => ({ stroke: one.colour, width: 1.25, points: { show: false } })));
    const between = picture.signals.map((one, index) => ({ series: [2 * index + 2, 2 * index + 1], fill: () => `color-mix(in srgb, ${one.colour()} 35%, transparent)` }));
    picture.plot = chart(picture.place, 200, ["time since the first sample [s]", picture.signals[0].unit], {
      series: [{}, ...lines], bands: between, legend: { show: false },
      scales: { x: { time: false, auto: false, min: shown[0], max: shown[1] } },
      cursor: { sync: { key: "record" }, drag: { x: true, y: false, setScale: false } },
      hooks: {
        setCursor: [readout],
        setSelect: [(u) => {
          const ends = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")];
          if (u.select.width > 3) (marking() ? mark : show)(...ends);
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
        }],
        drawAxes: [bands],
      },
    }, data);
  };

  const load = async (picture, turn) => {
    const width = Math.min(Math.max(200, Math.round(picture.place.clientWidth * devicePixelRatio)), 4096);
    const keys = picture.signals.map((one) => one.signal).join(",");
    const answer = await fetch(`${page.dataset.source}?keys=${keys}&from=${shown[0]}&to=${shown[1]}&width=${width}`).catch(() => null);
    if (!answer?.ok || turn !== wanted) return;
    if (answer.status === 204) {  // the record was changed: it is read again
      wanted += 1;
      htmx.trigger("#picture", "ended");
      return;
    }
    const columns = Number(answer.headers.get("x-columns"));
    const values = new Float64Array(await answer.arrayBuffer());
    if (turn !== wanted) return;
    const cell = (at) => (Number.isNaN(values[at]) ? null : values[at]);
    draw(picture, Array.from({ length: columns }, (_, column) => Array.from({ length: values.length / columns }, (none, row) => cell(row * columns + column))));
    picture.figure.dataset.points = String(values.length / columns);
  };

  const show = (first, last) => {
    const size = Math.min(Math.max(last - first, 1e-9 * duration + 1e-6), duration);
    const from = Math.min(Math.max(first, 0), duration - size);
    shown = [from, from + size];
    wanted += 1;
    const turn = wanted;
    return Promise.all(pictures.map((picture) => load(picture, turn)));
  };

  const form = find("leave-out");
  const marking = () => find("mark").getAttribute("aria-pressed") === "true";
  const redraw = () => pictures.forEach((picture) => picture.plot?.redraw());
  const mark = (first, last) => {
    form.elements.from.value = first.toFixed(4);
    form.elements.to.value = last.toFixed(4);
    marked = [first, last];
    redraw();
  };
  find("mark").addEventListener("click", () => {
    find("mark").setAttribute("aria-pressed", String(!marking()));
    form.hidden = !marking();
    marked = null;
    if (marking() && shown[1] - shown[0] < duration) mark(...shown);  // without a mouse: the part that is shown
    else redraw();
  });
  find("position").addEventListener("change", (event) => {
    const one = record.positions[event.target.value] || { first: 0, last: duration };
    show(one.first, one.last).then(() => { if (marking()) mark(one.first, one.last); });
  });
  const moves = {
    earlier: (a, b) => [a - (b - a) / 2, b - (b - a) / 2], later: (a, b) => [a + (b - a) / 2, b + (b - a) / 2],
    in: (a, b) => [a + (b - a) / 4, b - (b - a) / 4], out: (a, b) => [a - (b - a) / 2, b + (b - a) / 2], all: () => [0, duration],
  };
  document.querySelectorAll("[data-move]").forEach((button) => button.addEventListener("click", () => show(...moves[button.dataset.move](...shown))));
  document.querySelectorAll(".go").forEach((button) => button.addEventListener("click", () => show(Number(button.dataset.time) - duration / 100, Number(button.dataset.time) + duration / 100)));
  show(0, duration);
};
document.addEventListener("DOMContentLoaded", startPicture);
document.addEventListener("htmx:afterSettle", startPicture);
