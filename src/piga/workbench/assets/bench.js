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

const curves = (place) => {
  const figure = JSON.parse(place.dataset.figure);
  const roles = ["--role-after", "--role-muted", "--bad", "--role-y"];
  const value = (u, shown) => shown?.toPrecision(5) ?? "";
  const series = figure.series.map((one, index) => {
    const stroke = () => colour(roles[index % 4]);
    return { label: one.name, stroke, value, width: one.point ? 0 : 2, points: { show: one.point, size: 11, fill: stroke } };
  });
  const options = { series: [{ label: figure.labels[0], value }, ...series], scales: { x: { time: false } }, legend: { live: false } };
  chart(place, 260, figure.labels, options, [figure.x, ...figure.series.map((one) => one.values)]);
  place.removeAttribute("data-figure");
};

const upload = () => {
  const input = document.getElementById("file");
  if (!input) return;
  const state = document.getElementById("drop-state");
  const send = async (files) => {
    let answer = null;
    for (const file of files) {
      state.textContent = `${file.name} is copied …`;
      const sent = await fetch(`/upload?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
      if (!sent.ok) {
        const page = new DOMParser().parseFromString(await sent.text(), "text/html");
        state.textContent = page.querySelector(".message")?.textContent || "The file was refused.";
        return;
      }
      answer = await sent.json();
    }
    if (answer) location.href = answer.address;
  };
  input.addEventListener("change", () => send(input.files));
  document.addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("dropping"); });
  document.addEventListener("dragleave", () => document.body.classList.remove("dropping"));
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (event.dataTransfer.files.length) send(event.dataTransfer.files);
  });
};

const records = () => {
  const [list, search, sort] = ["records", "search", "sort"].map((id) => document.getElementById(id));
  if (!list) return;
  const apply = () => {
    const words = search.value.toLowerCase().split(/\s+/);
    const key = sort.value;
    const less = key === "day" ? (a, b) => b.dataset.day - a.dataset.day : (a, b) => a.dataset[key].localeCompare(b.dataset[key], undefined, { numeric: true });
    list.append(...[...list.children].sort(less));
    for (const item of list.children) item.hidden = !words.every((word) => item.dataset.words.toLowerCase().includes(word));
    sessionStorage.setItem("search", search.value);
    sessionStorage.setItem("sort", key);
  };
  search.value = sessionStorage.getItem("search") || "";
  sort.value = sessionStorage.getItem("sort") || "day";
  [search, sort].forEach((one) => one.addEventListener("input", apply));
  apply();
};

// The server is asked now and then. If it is lost the page says so, and goes on when it answers again.
const watch = () => {
  const lost = document.getElementById("lost");
  const ask = async () => {
    const there = await fetch("/healthz").then((answer) => answer.ok, () => false);
    if (there && !lost.hidden) location.reload();
    lost.hidden = there;
  };
  setInterval(ask, 3000);
};

document.addEventListener("DOMContentLoaded", () => {
  upload();
  records();
  watch();
  document.querySelectorAll("[data-go] select").forEach((select) => select.addEventListener("change", () => { location.href = select.value; }));
  document.querySelectorAll("[data-back]").forEach((button) => button.addEventListener("click", () => history.back()));
  document.querySelectorAll("[data-pair]").forEach((slider) => {
    const number = document.getElementById(slider.dataset.pair);
    slider.addEventListener("input", () => { number.value = slider.value; });
    number.addEventListener("input", () => { slider.value = number.value; });
  });
  const draw = () => document.querySelectorAll("[data-figure]").forEach(curves);
  draw();
  document.addEventListener("htmx:afterSettle", draw);
  addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
});
