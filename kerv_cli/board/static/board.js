// A page that nobody sees does not ask for news.
document.addEventListener("htmx:beforeRequest", (event) => {
  if (document.hidden && event.target.matches("[hx-trigger*=every], [hx-trigger*=visibilitychange]")) event.preventDefault();
});

// Charts are drawn when a page is loaded, and again when htmx has replaced a part of it. What was open stays open.
const opened = "details[open], .switch input:checked, .pick[aria-expanded=true]";
const name = (element) => (element.closest("summary, label, button") ?? element.querySelector("summary")).textContent;
let before = [];
document.addEventListener("htmx:beforeSwap", ({ target }) => {
  before = [...target.querySelectorAll(opened)].map((one) => [one.tagName, name(one)]);
});
document.addEventListener("htmx:load", ({ detail: { elt } }) => {
  if (!elt.querySelector(".study, .chart")) return;
  showStudy(elt);
  for (const one of elt.querySelectorAll("details, .switch input, .pick")) {
    if (!before.some(([tag, text]) => tag === one.tagName && text === name(one))) continue;
    one.tagName === "DETAILS" ? (one.open = true) : one.click();
  }
  before = [];
});
