// Keyboard shortcuts of every page: a key presses the control with that data-key. `?` lists all keys, and why some cannot be
// used now.

import { t } from "./sentences.js";

const TEXTS = 'input:not([type="checkbox"], [type="radio"], [type="range"], [type="number"]), textarea, [contenteditable="true"]';
const STOPS = '[data-command="stop"], [data-command="halt"], [data-command="cancel"]';
const SCROLLED = 'select, input[type="range"], input[type="radio"], #events'; // controls that use the arrow keys themselves
const PRESSED = "button, summary, a[href]"; // controls that Enter and Space press while they have the focus
const CAPS = { arrowleft: "←", arrowright: "→", arrowup: "↑", arrowdown: "↓", pageup: "PgUp", pagedown: "PgDn", shift: "⇧" };
const ELSEWHERE = t("page.keys.elsewhere", "not on the screen at the moment");

function usable(element) {
  return element.checkVisibility();
}

/** Return the names under which a key press may be registered: with Shift, the combination before the key alone. */
export function namesOf({ key: pressed, ctrlKey, shiftKey }) {
  const key = pressed === " " ? "space" : pressed.toLowerCase();
  if (ctrlKey) return [`ctrl+${key}`];
  const shifted = shiftKey && (/^[a-z]$/.test(key) || key in CAPS);
  return shifted ? [`shift+${key}`, key] : [key];
}

/** Return a key as it is labelled on a keyboard. */
export function label(key) {
  return key
    .split("+")
    .map((part) => CAPS[part] ?? part[0].toUpperCase() + part.slice(1))
    .join(" + ")
    .replace("⇧ + ", "⇧");
}

/** Return what a control does, in words. */
export function meaning(element) {
  if (element.dataset.keyText) return element.dataset.keyText;
  const words = element.cloneNode(true);
  for (const key of words.querySelectorAll("kbd")) key.remove();
  return words.textContent.trim();
}

/** Return why a control cannot be pressed now, or "" if it can. */
export function refusal(element) {
  if (!usable(element)) return ELSEWHERE;
  if (element.disabled) return element.title || t("page.keys.not_now", "not now");
  return element.getAttribute("aria-disabled") === "true" ? element.title || t("page.keys.not_now", "not now") : "";
}

/**
 * Return the rows of the list of keys. For each key this is the control that it presses now; if none of its controls is on the
 * screen, it is every one of them, with each meaning once.
 */
function known() {
  const all = [...document.querySelectorAll("[data-key]")];
  const rows = new Map();
  for (const element of all.filter(usable)) {
    if (!rows.has(element.dataset.key)) rows.set(element.dataset.key, [element]);
  }
  const shown = new Set(rows.keys());
  for (const element of all) {
    const { key } = element.dataset;
    if (shown.has(key)) continue; // a key belongs to its first usable control, as in `meant`
    const others = rows.get(key) ?? [];
    if (!others.some((one) => meaning(one) === meaning(element))) rows.set(key, [...others, element]);
  }
  return [...rows].flatMap(([key, elements]) => elements.map((element) => ({ key, what: meaning(element), why: refusal(element) })));
}

function row({ key, what, why }) {
  const name = document.createElement("dt");
  const cap = document.createElement("kbd");
  cap.textContent = label(key);
  name.append(cap);
  const said = document.createElement("dd");
  said.textContent = what;
  if (why) said.append(Object.assign(document.createElement("span"), { className: "small", textContent: ` – ${why}` }));
  for (const element of [name, said]) {
    element.dataset.found = "";
    element.toggleAttribute("data-refused", Boolean(why));
  }
  return [name, said];
}

function show(dialog) {
  const list = dialog.querySelector("#keys-list");
  for (const old of list.querySelectorAll("[data-found]")) old.remove();
  const rows = known();
  for (const one of [...rows.filter(({ why }) => !why), ...rows.filter(({ why }) => why)]) list.append(...row(one));
  open(dialog);
  dialog.focus({ preventScroll: true }); // focuses no control, so that Space remains the e-stop
  dialog.scrollTop = 0;
}

/** Open a dialog. On a station's page it is never modal, because a modal dialog would put the e-stop out of reach. */
export function open(dialog) {
  if (document.getElementById("estop-area")) dialog.show();
  else dialog.showModal();
}

/**
 * Return the control that a key event presses: the first one with this key that is usable or, with `hidden`, any; else null.
 */
function meant(event, hidden = false) {
  for (const name of namesOf(event)) {
    const element = [...document.querySelectorAll(`[data-key="${CSS.escape(name)}"]`)].find((one) => hidden || usable(one));
    if (element) return element;
  }
  return null;
}

/**
 * Return true if the focused control needs the key itself: text fields need every key, number fields all but letters and Space,
 * lists all but those of stop commands, buttons and links Enter and Space, and sliders, radio buttons and the list of events
 * the arrow keys.
 */
function kept(event, element) {
  const field = event.target;
  if (!field.closest || event.ctrlKey || !usable(field)) return false; // a control that was just hidden keeps the focus for a moment
  if (field.closest(TEXTS)) return true;
  if (field.closest('input[type="number"]')) return !/^[a-z ]$/i.test(event.key);
  if (field.closest("select") && !element?.matches(STOPS)) return true;
  if (/^(Enter| )$/.test(event.key) && field.closest(PRESSED)) return true;
  return /^(Arrow|Page)/.test(event.key) && Boolean(field.closest(SCROLLED));
}

/** Press a control, or focus it if it is a field. */
export function press(element) {
  const written = element.matches('select, textarea, input:not([type="checkbox"], [type="radio"])');
  if (!written) element.click();
  else if (!element.disabled) element.focus();
}

/** Listen for keys; `refused(text)` is called if the control of a key is not on the screen. */
export function keyboard(refused = () => {}) {
  const dialog = document.getElementById("keys");
  for (const button of document.querySelectorAll("[data-open-keys]")) button.addEventListener("click", () => show(dialog));
  window.addEventListener("keydown", (event) => {
    if (event.altKey || event.metaKey || event.repeat || event.defaultPrevented) return;
    const element = meant(event);
    if (kept(event, element)) return;
    if (event.key === "?") {
      if (dialog.open) dialog.close();
      else show(dialog);
      return;
    }
    if (document.querySelector("dialog:modal")) return;
    if (element) {
      event.preventDefault();
      press(element);
      return;
    }
    const hidden = meant(event, true);
    if (hidden) refused(t("page.keys.refused", "{meaning} ({key}): {why}", { meaning: meaning(hidden), key: label(hidden.dataset.key), why: ELSEWHERE }));
  });
}
