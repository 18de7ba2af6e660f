// What every page has: the account's menu, keys, Find, and tables wider than the page that can be scrolled by keyboard. A
// station's page listens for its keys itself.

import "./find.js";
import "./sentences.js";
import { keyboard } from "./keys.js";

const menu = document.querySelector(".bar-user");

// A click elsewhere or Esc closes the menu.
if (menu) {
  document.addEventListener("click", (event) => {
    if (!menu.contains(event.target)) menu.open = false;
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") menu.open = false;
  });
  const ofReview = document.getElementById("review-keys"); // the review page has keys of its own and shows them itself
  if (ofReview) menu.querySelector("[data-open-keys]").addEventListener("click", () => ofReview.showModal());
  else if (!document.getElementById("estop-area")) keyboard();
}

function scrollers() {
  for (const element of document.querySelectorAll(".table-scroll")) {
    if (element.scrollWidth > element.clientWidth || element.scrollHeight > element.clientHeight) element.tabIndex = 0;
    else element.removeAttribute("tabindex");
  }
}
scrollers();
window.addEventListener("resize", scrollers);
document.addEventListener("htmx:afterSwap", scrollers);
document.addEventListener("toggle", scrollers, { capture: true }); // a table may be inside a details element

// Choosing a filter submits the form. The address contains only filters that are set, and the focus returns to the same field.
const APPLIED = "applied filter";
document.addEventListener("change", ({ target }) => {
  const form = target.form;
  if (!form?.matches("[data-applied]")) return;
  for (const field of form.elements) if (!field.value) field.disabled = true;
  sessionStorage.setItem(APPLIED, target.name);
  form.submit();
});
const applied = sessionStorage.getItem(APPLIED);
if (applied) document.querySelector("form[data-applied]")?.elements[applied]?.focus();
sessionStorage.removeItem(APPLIED);
window.addEventListener("pageshow", () => {
  // The user came back with the browser's Back button.
  for (const field of document.querySelectorAll("form[data-applied] :disabled")) field.disabled = false;
});
