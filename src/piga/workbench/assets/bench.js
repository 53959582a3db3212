"use strict";
const find = (id) => document.getElementById(id);

// Files that are chosen, or dropped anywhere on the page, are copied into the folder.
const upload = () => {
  const state = find("drop-state");
  if (!state) return;
  const send = async (files) => {
    let answer = null;
    for (const file of files) {
      state.textContent = `${file.name} is copied …`;
      answer = await fetch(`/upload?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
      if (!answer.ok) {
        const page = new DOMParser().parseFromString(await answer.text(), "text/html");
        state.textContent = page.querySelector(".message")?.textContent || "The file was refused.";
        return;
      }
    }
    if (answer) location.href = (await answer.json()).address;
  };
  find("file").addEventListener("change", (event) => send(event.target.files));
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    send(event.dataTransfer.files);
  });
};

// The records are searched and sorted here; what was typed stays while the browser's tab is open.
const records = () => {
  const [list, search, sort] = ["records", "search", "sort"].map(find);
  if (!list) return;
  const apply = () => {
    const words = search.value.toLowerCase().split(/\s+/);
    const key = sort.value;
    const less = key === "day" ? (a, b) => b.dataset.day - a.dataset.day : (a, b) => a.dataset[key].localeCompare(b.dataset[key], undefined, { numeric: true });
    list.append(...[...list.children].sort(less));
    for (const item of list.children) item.hidden = !words.every((word) => item.dataset.words.toLowerCase().includes(word));
    [search, sort].forEach((one) => sessionStorage.setItem(one.id, one.value));
  };
  search.value = sessionStorage.getItem("search") || "";
  sort.value = sessionStorage.getItem("sort") || "day";
  [search, sort].forEach((one) => one.addEventListener("input", apply));
  apply();
};

// The server is asked now and then. If it is lost the page says so, and goes on when it answers again.
const watch = async () => {
  const there = await fetch("/healthz").then((answer) => answer.ok, () => false);
  if (there && !find("lost").hidden) location.reload();
  find("lost").hidden = there;
};

document.addEventListener("DOMContentLoaded", () => {
  upload();
  records();
  setInterval(watch, 3000);
  document.querySelectorAll("[data-go] select").forEach((select) => select.addEventListener("change", () => { location.href = select.value; }));
  document.querySelectorAll("[data-back]").forEach((button) => button.addEventListener("click", () => history.back()));
  addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
});
