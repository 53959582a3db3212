"use strict";
// A record as a picture: envelopes from the server for any span, positions as bands, spans that are left out or move.
const startPicture = () => {
  const page = find("figures");
  if (!page || page.dataset.ready) return;
  page.dataset.ready = "1";
  const record = JSON.parse(page.dataset.drawn);
  const duration = record.duration;
  const colour = (name, at = page) => getComputedStyle(at).getPropertyValue(name).trim();
  const minus = (text) => text.replace("-", "\u2212");
  let shown = [0, duration];
  let wanted = 0;
  let marked = null;
  const pictures = [...page.querySelectorAll("figure")].map((figure) => ({
    figure, place: figure.querySelector(".plot"), plot: null,
    signals: [...figure.querySelectorAll(".key")].map((name) => ({ ...name.dataset, title: name.textContent, colour: () => colour("--key", name) })),
  }));

  const readout = (u) => {
    if (u.cursor.left < 0) return;
    const time = u.posToVal(u.cursor.left, "x");
    const position = record.positions.find((one) => one.first <= time && time <= one.last);
    const values = pictures.flatMap(({ plot, signals }) => signals.map((one, index) => {
      const value = plot?.data[1 + 2 * index]?.[plot.valToIdx(time)] ?? null;
      return value === null ? "" : minus(`${one.title} ${value.toPrecision(7)} ${one.unit}`);
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
    u.ctx.fillStyle = colour("--bad");
    for (const [, time] of record.findings) {
      if (time > 0 && time >= shown[0] && time <= shown[1]) u.ctx.fillRect(u.valToPos(time, "x", true), u.bbox.top, devicePixelRatio, u.bbox.height);
    }
    u.ctx.restore();
  };

  const plotted = ({ place, signals }, data) => {
    const grid = { stroke: () => colour("--grid"), width: 1 };
    const axis = { values: (u, splits) => splits.map((value) => minus(String(value))), stroke: () => colour("--soft"), grid, ticks: grid, labelSize: 22 };
    const plot = new uPlot({
      width: place.clientWidth, height: 200, legend: { show: false },
      axes: [{ ...axis, label: "time since the first sample [s]", size: 40 }, { ...axis, label: signals[0].unit, size: 72 }],
      series: [{}, ...signals.flatMap((one) => [0, 1].map(() => ({ stroke: one.colour, width: 1.25, points: { show: false } })))],
      bands: signals.map((one, index) => ({ series: [2 * index + 2, 2 * index + 1], fill: () => `color-mix(in srgb, ${one.colour()} 35%, transparent)` })),
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
    }, data, place);
    new ResizeObserver(() => plot.setSize({ width: place.clientWidth, height: 200 })).observe(place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plot.redraw());
    return plot;
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
    const data = Array.from({ length: columns }, (_, column) => Array.from({ length: values.length / columns }, (none, row) => cell(row * columns + column)));
    picture.plot?.setData(data, false);
    picture.plot?.setScale("x", { min: shown[0], max: shown[1] });
    picture.plot ??= plotted(picture, data);
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
