// Adds the episodes that are chosen in the list to the form that deletes them.

import { t } from "../site/sentences.js";

const form = document.getElementById("delete");
const chosen = () => [...document.querySelectorAll("[data-episode-index]:checked")];

if (form) {
  const count = form.querySelector("[data-count]");
  const show = () => (count.textContent = String(chosen().length));
  document.getElementById("chosen").addEventListener("change", show);
  document.body.addEventListener("htmx:afterSwap", show); // a narrowed list has fewer episodes, and those that are gone are not chosen any more
  window.addEventListener("pageshow", show); // a browser that comes back restores its fields
  form.addEventListener("submit", (event) => {
    if (!chosen().length) {
      event.preventDefault();
      count.closest("button").title = t("page.datasets.choose_first", "Choose episodes in the list first");
      return;
    }
    for (const { dataset } of chosen()) form.append(Object.assign(document.createElement("input"), { type: "hidden", name: "episodes", value: dataset.episodeIndex }));
  });
}
