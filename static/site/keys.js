// Keys of every page: whatever has data-key can be pressed with it; `?` shows all of them, and why some cannot be now.

import { t } from "./sentences.js";

const TEXTS = 'input:not([type="checkbox"], [type="radio"], [type="range"], [type="number"]), textarea, [contenteditable="true"]';
const STOPS = '[data-command="stop"], [data-command="halt"], [data-command="cancel"]';
const SCROLLED = 'select, input[type="range"], input[type="radio"], #events'; // they go by arrows of their own
const PRESSED = "button, summary, a[href]"; // by Enter and Space, where they have the focus
const CAPS = { arrowleft: "←", arrowright: "→", arrowup: "↑", arrowdown: "↓", pageup: "PgUp", pagedown: "PgDn", shift: "⇧" };
const ELSEWHERE = t("page.keys.elsewhere", "not on the screen at the moment");

function usable(element) {
  return element.checkVisibility();
}

/** The names under which a press may be known: with Shift first the key with it, then the key alone. */
export function namesOf({ key: pressed, ctrlKey, shiftKey }) {
  const key = pressed === " " ? "space" : pressed.toLowerCase();
  if (ctrlKey) return [`ctrl+${key}`];
  const shifted = shiftKey && (/^[a-z]$/.test(key) || key in CAPS);
  return shifted ? [`shift+${key}`, key] : [key];
}

/** A key as it stands on a keyboard. */
export function label(key) {
  return key
    .split("+")
    .map((part) => CAPS[part] ?? part[0].toUpperCase() + part.slice(1))
    .join(" + ")
    .replace("⇧ + ", "⇧");
}

/** What it does, in words. */
export function meaning(element) {
  if (element.dataset.keyText) return element.dataset.keyText;
  const words = element.cloneNode(true);
  for (const key of words.querySelectorAll("kbd")) key.remove();
  return words.textContent.trim();
}

/** Why it cannot be pressed now, "" where it can. */
export function refusal(element) {
  if (!usable(element)) return ELSEWHERE;
  if (element.disabled) return element.title || t("page.keys.not_now", "not now");
  return element.getAttribute("aria-disabled") === "true" ? element.title || t("page.keys.not_now", "not now") : "";
}

/** Of each key the one that it presses; where that is not on the screen all that it would press, each meaning once. */
function known() {
  const all = [...document.querySelectorAll("[data-key]")];
  const rows = new Map();
  for (const element of all.filter(usable)) {
    if (!rows.has(element.dataset.key)) rows.set(element.dataset.key, [element]);
  }
  const shown = new Set(rows.keys());
  for (const element of all) {
    const { key } = element.dataset;
    if (shown.has(key)) continue; // a key is that of the first that has it, as when it is pressed
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
  dialog.focus({ preventScroll: true }); // no control of it: Space stays the e-stop
  dialog.scrollTop = 0;
}

/** Open a dialog: at a station never as a modal one, which would put the e-stop out of reach. */
export function open(dialog) {
  if (document.getElementById("estop-area")) dialog.show();
  else dialog.showModal();
}

/** What is pressed with it: the first that is on the page, and visible unless `hidden`. */
function meant(event, hidden = false) {
  for (const name of namesOf(event)) {
    const element = [...document.querySelectorAll(`[data-key="${CSS.escape(name)}"]`)].find((one) => hidden || usable(one));
    if (element) return element;
  }
  return null;
}

/** Fields keep what they are typed with: numbers their digits, lists their letters but for those that stop. */
function kept(event, element) {
  const field = event.target;
  if (!field.closest || event.ctrlKey || !usable(field)) return false; // what was just closed keeps the focus for a moment
  if (field.closest(TEXTS)) return true;
  if (field.closest('input[type="number"]')) return !/^[a-z ]$/i.test(event.key);
  if (field.closest("select") && !element?.matches(STOPS)) return true;
  if (/^(Enter| )$/.test(event.key) && field.closest(PRESSED)) return true;
  return /^(Arrow|Page)/.test(event.key) && Boolean(field.closest(SCROLLED));
}

/** Press a control, or put the cursor into a field. */
export function press(element) {
  const written = element.matches('select, textarea, input:not([type="checkbox"], [type="radio"])');
  if (!written) element.click();
  else if (!element.disabled) element.focus();
}

/** Listen for keys; `refused` is told in words of one whose control is not on the screen. */
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
