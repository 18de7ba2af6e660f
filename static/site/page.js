// What every page has: the account's menu, keys, Find, tables that keys can scroll where they are wider than the page.
// A station's page listens for its keys itself.

import "./find.js";
import "./sentences.js";
import { keyboard } from "./keys.js";

const menu = document.querySelector(".bar-user");

// It closes when something else is pressed, or Esc.
if (menu) {
  document.addEventListener("click", (event) => {
    if (!menu.contains(event.target)) menu.open = false;
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") menu.open = false;
  });
  const ofReview = document.getElementById("review-keys"); // a page with keys of its own, which shows them itself
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
document.addEventListener("toggle", scrollers, { capture: true }); // a table may be in details

// Filters apply when one is chosen; the address says what they are, and the keyboard stays where it was.
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
  for (const field of document.querySelectorAll("form[data-applied] :disabled")) field.disabled = false; // somebody came back
});
