// What the theme leaves out for screen readers and keyboards.
document.addEventListener("DOMContentLoaded", () => {
  for (const caption of document.querySelectorAll("p.caption[role=heading]")) caption.setAttribute("aria-level", "2");
  document.querySelector(".sidebar-drawer")?.setAttribute("aria-label", "Pages");
  document.querySelector(".toc-drawer")?.setAttribute("aria-label", "On this page");
  for (const code of document.querySelectorAll("td code .pre")) code.innerHTML = code.innerHTML.replace(/(\/|::|_)(?=\w)/g, "$1<wbr>"); // long names break at their joints
  for (const block of document.querySelectorAll("pre, .table-wrapper, .cell_output, div.math, article p:has(> img)")) block.tabIndex = 0; // can be scrolled by keys
});
