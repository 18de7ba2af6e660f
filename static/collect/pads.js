// Gamepads and pedals on the Collect page: polled while the page is visible; their buttons are shown and can be changed.

import { PRESSED } from "../site/presses.js";
import { ACTIONS, withAssignment, buttonName, defaultMapping, Presses, parseMapping, whyNotKey } from "./pad_buttons.js";
import { t } from "../site/sentences.js";

const KEY = "eva-pad";
const TYPED = 'input, textarea, select, [contenteditable="true"]'; // fields that need their keys
const LATE_MS = 500; // pause between two polls [ms] after which changes of buttons count as no presses

/** Call `press(action)` for every press of an assigned button, as long as the page exists. */
export function gamepads(press) {
  const presses = new Presses();
  const part = (name) => document.querySelector(`[data-pad="${name}"]`);
  const list = document.getElementById("pad-list");
  let mapping = parseMapping(localStorage.getItem(KEY));
  let changing = ""; // the action that waits for its button
  let shown = "";
  let looked = -Infinity;

  const rows = Object.entries(ACTIONS).map(([action, { name }]) => {
    const row = document.getElementById("pad-row").content.cloneNode(true).firstElementChild;
    row.querySelector(".pad-name").textContent = name;
    row.dataset.action = action;
    row.querySelector("button").addEventListener("click", () => {
      changing = changing === action ? "" : action;
      draw();
    });
    list.append(row);
    return row;
  });
  part("reset").addEventListener("click", () => keep(defaultMapping()));

  function keep(next) {
    mapping = next;
    changing = "";
    localStorage.setItem(KEY, JSON.stringify(mapping));
    draw();
  }

  function pads() {
    return [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected);
  }

  function draw() {
    const [first] = pads();
    for (const row of rows) {
      row.querySelector(".pad-button").textContent = changing === row.dataset.action ? t("page.pads.press", "press a button or a key …") : buttonName(mapping[row.dataset.action], first?.mapping);
      row.querySelector("button").textContent = changing === row.dataset.action ? t("page.pads.cancel", "Cancel") : t("page.pads.change", "Change");
    }
    part("state").textContent = first ? first.id.slice(0, 32) : t("page.pads.unconnected", "none connected: press one of its buttons");
  }

  function pressed(button) {
    const action = !changing && Object.keys(mapping).find((one) => mapping[one] === button);
    if (changing) keep(withAssignment(mapping, changing, button));
    else part("said").textContent = t("page.pads.does", "{button}: {does}", { button: buttonName(button, pads()[0]?.mapping), does: action ? ACTIONS[action].name : t("page.pads.nothing", "does nothing") });
    if (action) press(action);
    else window.dispatchEvent(new Event(PRESSED));
  }

  function keyed(event) {
    if (event.repeat || event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.(TYPED)) return;
    const { key } = event;
    if (!changing && !Object.values(mapping).includes(key)) return;
    if (changing && /^(Enter| |Tab)$/.test(key) && event.target.closest?.("button")) return; // the keyboard presses Cancel
    const why = whyNotKey(key, [...document.querySelectorAll("[data-key]")].map(({ dataset }) => dataset.key));
    if (why) part("said").textContent = why;
    else {
      event.preventDefault(); // keys.js ignores the event then
      pressed(key);
    }
  }

  function look() {
    requestAnimationFrame(look);
    const now = performance.now();
    if (document.hidden || now - looked > LATE_MS) presses.forget();
    looked = now;
    const there = pads();
    const names = there.map(({ id }) => id).join();
    if (names !== shown) {
      shown = names;
      draw();
    }
    for (const { button } of presses.look(there)) pressed(button);
  }

  window.addEventListener("keydown", keyed, { capture: true });
  draw();
  look();
}
