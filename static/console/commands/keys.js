// Keys: whatever has data-key can be pressed with it; `?` shows them all. The stopping keys are in estop.js.

const FIXED = [
  ["Esc", "E-stop"],
  ["Space", "E-stop, outside text fields", '[data-key="space"]'], // but where something else has it
  ["?", "These keys, and away with them"],
];
const TEXTS = 'input:not([type="checkbox"], [type="radio"], [type="range"], [type="number"]), textarea, [contenteditable="true"]';
const STOPS = '[data-command="stop"], [data-command="halt"], [data-command="cancel"], [data-key="space"]';
const SCROLLED = 'select, input[type="range"], input[type="radio"], #events'; // they go by arrows of their own
const CAPS = { arrowleft: "←", arrowright: "→", arrowup: "↑", arrowdown: "↓", pageup: "PgUp", pagedown: "PgDn", shift: "⇧" };

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

function text(element) {
  if (element.dataset.keyText) return element.dataset.keyText;
  const words = element.cloneNode(true);
  for (const key of words.querySelectorAll("kbd")) key.remove();
  return words.textContent.trim();
}

function show(dialog) {
  const rows = FIXED.filter(([, , other]) => !other || !document.querySelector(other));
  const taken = new Set(); // a key is that of the first that has it, as when it is pressed
  for (const element of document.querySelectorAll("[data-key]")) {
    if (!usable(element) || taken.has(element.dataset.key)) continue;
    taken.add(element.dataset.key);
    rows.push([element.dataset.key, text(element)]);
  }
  const list = dialog.querySelector("#keys-list");
  list.replaceChildren();
  for (const [key, what] of rows) {
    const name = document.createElement("dt");
    const cap = document.createElement("kbd");
    cap.textContent = label(key);
    name.append(cap);
    const meaning = document.createElement("dd");
    meaning.textContent = what;
    list.append(name, meaning);
  }
  dialog.show(); // never modal: that would put the e-stop out of reach
  dialog.querySelector("button").focus({ preventScroll: true });
  dialog.scrollTop = 0;
}

/** What is pressed with it: the first that is on the page and visible. */
function meant(event) {
  for (const name of namesOf(event)) {
    const element = [...document.querySelectorAll(`[data-key="${CSS.escape(name)}"]`)].find(usable);
    if (element) return element;
  }
  return null;
}

/** Fields keep what they are typed with: numbers their digits, lists their letters but for those that stop. */
function kept(event, element) {
  const field = event.target;
  if (!field.closest || event.ctrlKey) return false;
  if (field.closest(TEXTS)) return true;
  if (field.closest('input[type="number"]')) return !/^[a-z ]$/i.test(event.key);
  if (field.closest("select") && !element?.matches(STOPS)) return true;
  return /^(Arrow|Page)/.test(event.key) && Boolean(field.closest(SCROLLED));
}

function press(element) {
  const written = element.matches('select, textarea, input:not([type="checkbox"], [type="radio"])');
  if (!written) element.click();
  else if (!element.disabled) element.focus();
}

/** A list that was chosen from gives the keys back; one that is gone through by keys keeps them until Enter. */
function released() {
  let byKey = false;
  document.addEventListener("pointerdown", () => (byKey = false), { capture: true });
  document.addEventListener("keydown", ({ key, target }) => {
    byKey = key !== "Enter";
    if (key === "Enter" && target.matches?.("select")) target.blur();
  }, { capture: true });
  document.addEventListener("change", ({ target }) => !byKey && target.matches("select") && target.blur());
}

/** Listen for keys. */
export function keyboard() {
  released();
  const dialog = document.getElementById("keys");
  document.querySelector("[data-open-keys]")?.addEventListener("click", () => show(dialog));
  window.addEventListener("keydown", (event) => {
    if (event.altKey || event.metaKey || event.repeat || event.defaultPrevented) return;
    const element = meant(event);
    if (kept(event, element)) return;
    if (event.key === "?") {
      if (dialog.open) dialog.close();
      else show(dialog);
      return;
    }
    if (!element) return;
    event.preventDefault();
    press(element);
  });
  window.addEventListener("keyup", (event) => {
    // Else the letting go would press the button that has the focus, beside the one that has the key.
    if (event.key === " " && meant(event) && !kept(event, meant(event))) event.preventDefault();
  });
}
