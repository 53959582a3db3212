"use strict";
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
  addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
});
