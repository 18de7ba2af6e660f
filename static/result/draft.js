// The page of a draft plan: one step at a time, saved while it is typed.

import { post } from "../site/api.js";
import { drafts } from "../site/drafts.js";
import { t } from "../site/sentences.js";

const form = document.getElementById("draft");
const said = document.getElementById("draft-saved");
const BASE = `eva-base:${form.dataset.draft}`;
let typed = 0; // number of inputs so far
let sent = 0; // that number at the last request

let waiting = null; // id of the dialog that opens once everything is saved

function was() {
  return document.getElementById("draft-was").value;
}

// --- steps: the address says which one is shown ---------------------------------------------------------------

function current() {
  const found = window.location.hash && document.querySelector(window.location.hash);
  return found?.closest("[data-of]")?.dataset.of ?? "question";
}

function show() {
  const name = current();
  for (const section of document.querySelectorAll("[data-of]")) section.hidden = section.dataset.of !== name;
  for (const link of document.querySelectorAll("[data-step]")) {
    if (link.dataset.step === name) link.setAttribute("aria-current", "step");
    else link.removeAttribute("aria-current");
  }
}

window.addEventListener("hashchange", () => {
  show();
  const head = document.querySelector(`[data-of="${current()}"] h2`);
  head?.focus({ preventScroll: true });
  window.scrollTo(0, 0);
});

// --- saving ---------------------------------------------------------------------------------------------------

function save() {
  window.htmx.trigger(form, "eva:save");
}

function forget() {
  form.dispatchEvent(new Event("eva:saved", { bubbles: true }));
}

function failed(words) {
  const again = document.createElement("button");
  again.type = "button";
  again.className = "button";
  again.textContent = t("page.draft.again", "Try again");
  again.addEventListener("click", save);
  const why = document.createElement("span");
  why.className = "bad";
  why.textContent = t("page.draft.not_saved", "Not saved: {words}. ", { words });
  said.replaceChildren(why, again);
}

function saves({ requestConfig }) {
  return requestConfig.verb === "post";
}

function reason(xhr) {
  try {
    return JSON.parse(xhr.responseText).error;
  } catch {
    return t("page.site.http_status", "the server answered with HTTP {status}", { status: xhr.status });
  }
}

// Edits refer to the version of the draft that the page showed when they began, also after a reload.
form.addEventListener("input", () => {
  typed++;
  if (sessionStorage.getItem(BASE) === null) sessionStorage.setItem(BASE, was());
});
form.addEventListener("eva:saved", () => sessionStorage.removeItem(BASE));
document.body.addEventListener("htmx:beforeRequest", ({ detail }) => {
  if (saves(detail)) sent = typed;
});
document.body.addEventListener("htmx:afterRequest", ({ detail }) => {
  if (!saves(detail)) return;
  if (detail.successful) {
    if (said.querySelector("[data-whole]") && sent === typed) {
      forget();
      if (waiting) askToFreeze(document.getElementById(waiting));
    } else if (sessionStorage.getItem(BASE) !== null) sessionStorage.setItem(BASE, was());
    waiting = null;
  } else failed(detail.xhr.status ? reason(detail.xhr) : t("page.site.unreachable", "the server cannot be reached"));
});
document.body.addEventListener("htmx:beforeSwap", ({ detail }) => {
  if (detail.xhr.responseURL.includes("/login/")) {
    detail.shouldSwap = false;
    window.location.reload();
  }
});
// An open dialog is not replaced while it is being confirmed; the server compares what it showed with the present draft.
document.body.addEventListener("htmx:oobBeforeSwap", (event) => {
  if (event.detail.target.querySelector("dialog[open]")) event.detail.shouldSwap = false;
});
document.body.addEventListener("htmx:oobAfterSwap", show);

// --- what is pressed ------------------------------------------------------------------------------------------

function changed(field) {
  field.dispatchEvent(new Event("input", { bubbles: true }));
}

function all(button) {
  const boxes = [...button.closest("fieldset").querySelectorAll("input[type=checkbox]")];
  for (const box of boxes) box.checked = Boolean(button.dataset.all);
  if (boxes.length) changed(boxes[0]);
}

function use({ useRule, useRepetitions }) {
  form.elements.stopping.value = useRule;
  form.elements.repetitions.value = useRepetitions;
  changed(form.elements.repetitions);
}

async function preflight(button) {
  const { ask, result } = document.getElementById("arms-list").dataset;
  const place = button.closest(".preflight-here").querySelector("[data-preflight-result]");
  button.disabled = true;
  try {
    const asked = await post(ask, { checkpoint: button.dataset.preflightOf }, { timeout: 15000 });
    window.htmx.ajax("GET", `${result}${asked.id}/`, { target: place, swap: "innerHTML" });
  } catch (error) {
    place.textContent = t("page.draft.preflight", "Preflight: {why}", { why: error.message });
  } finally {
    button.disabled = false;
  }
}

/** Open the dialog that asks whether to freeze the plan, with the power shown beside the design. */
function askToFreeze(dialog) {
  if (!dialog) return;
  const line = dialog.querySelector("[data-power]");
  const said = document.querySelector("#power [role=status]")?.textContent.trim();
  if (line) line.textContent = said || t("page.draft.power_unknown", "not known: see Design");
  dialog.showModal();
}

function ask(dialog) {
  if (sent === typed && !form.classList.contains("htmx-request")) askToFreeze(document.getElementById(dialog));
  else {
    waiting = dialog;
    save();
  }
}

document.addEventListener("click", ({ target }) => {
  const button = target.closest("button");
  if (!button) return;
  const { dataset } = button;
  if ("all" in dataset) all(button);
  else if ("useRule" in dataset) use(dataset);
  else if ("preflightOf" in dataset) preflight(button);
  else if ("open" in dataset) ask(dataset.open);
  else if ("close" in dataset) button.closest("dialog").close();
  else if ("take" in dataset) {
    forget();
    window.location.reload();
  }
});

document.addEventListener("input", ({ target }) => {
  if (!target.dataset.filter) return;
  const words = target.value.toLowerCase();
  for (const row of document.querySelectorAll(`${target.dataset.filter} > [data-words]`)) {
    row.hidden = !row.dataset.words.toLowerCase().includes(words) && !row.querySelector("input:checked");
  }
});

/** Ask which checkpoint is compared with the control only if there are more than two. */
function challenger() {
  const field = document.querySelector(".draft-challenger");
  const ticked = form.querySelectorAll('[name="checkpoints"]:checked').length;
  field.hidden = ticked < 3 && !("always" in field.dataset);
}

form.addEventListener("input", ({ target }) => {
  challenger();
  const result = target.checked && target.closest(".draft-arm")?.querySelector("[data-preflight-result]");
  if (result && target.name === "checkpoints") window.htmx.trigger(result, "eva:ticked");
});

const unsaved = sessionStorage.getItem(`eva-draft:${form.dataset.draft}`) !== null;
drafts();
show();
challenger();
if (unsaved) {
  document.getElementById("draft-was").value = sessionStorage.getItem(BASE) ?? was();
  save();
}
