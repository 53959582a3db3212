"use strict";
// Numbers at the ticks of an axis, with as many digits as tell two neighbours apart.
const tickNumbers = (u, splits, axis, space, step) => {
  let digits = 0;
  while (digits < 12 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits += 1;
  const short = (value) => value.toExponential(Math.max(0, Math.ceil(Math.log10(Math.abs(value) / step))));
  return splits.map((value) => (value === null ? "" : digits > 7 && value ? short(value) : value.toFixed(Math.min(digits, 7))));
};
(() => {
  // A file that is dropped on the page of records is sent as it is; the page then shows it.
  const form = document.getElementById("drop");
  if (!form) return;
  const input = document.getElementById("file");
  const state = document.getElementById("drop-state");
  const send = async (files) => {
    let name = "";
    for (const file of files) {
      state.textContent = `${file.name} is copied …`;
      const answer = await fetch(`/upload?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file, headers: { "hx-request": "true" } });
      if (!answer.ok) {
        const page = new DOMParser().parseFromString(await answer.text(), "text/html");
        state.textContent = page.body.textContent.trim() || "The file was refused.";
        return;
      }
      name = (await answer.json()).name;
    }
    if (files.length === 1 && !name.endsWith(".toml")) location.href = `/describe/${encodeURIComponent(name)}`;
    else location.reload();
  };
  input.addEventListener("change", () => send(input.files));
  document.addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("dropping"); });
  document.addEventListener("dragleave", () => document.body.classList.remove("dropping"));
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (event.dataTransfer.files.length) send(event.dataTransfer.files);
  });
})();
(() => {
  // A slider and the number beside it show one value.
  document.querySelectorAll("[data-pair]").forEach((slider) => {
    const number = document.getElementById(slider.dataset.pair);
    slider.addEventListener("input", () => { number.value = slider.value; });
    number.addEventListener("input", () => { slider.value = number.value; });
  });
})();
