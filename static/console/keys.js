// Keys: whatever has data-key can be pressed with it; `?` shows them all. The stopping keys are in estop.js.

const FIXED = [
  ["Esc", "E-stop"],
  ["Space", "E-stop, outside text fields"],
  ["?", "These keys, and away with them"],
];
const TYPING = 'input:not([type="checkbox"]):not([type="radio"]), textarea, select, [contenteditable="true"]';

function usable(element) {
  return element.checkVisibility();
}

function keyOf(event) {
  const key = event.key.toLowerCase();
  return event.ctrlKey ? `ctrl+${key}` : key;
}

function label(key) {
  return key
    .split("+")
    .map((part) => part[0].toUpperCase() + part.slice(1))
    .join(" + ");
}

function text(element) {
  if (element.dataset.keyText) return element.dataset.keyText;
  const words = element.cloneNode(true);
  for (const key of words.querySelectorAll("kbd")) key.remove();
  return words.textContent.trim();
}

function show(dialog) {
  const rows = [...FIXED];
  for (const element of document.querySelectorAll("[data-key]")) {
    if (usable(element)) rows.push([element.dataset.key, text(element)]);
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
  dialog.querySelector("button").focus();
}

/** Listen for keys; text fields keep theirs, but for those with Ctrl. */
export function keyboard() {
  const dialog = document.getElementById("keys");
  document.querySelector("[data-open-keys]")?.addEventListener("click", () => show(dialog));
  window.addEventListener("keydown", (event) => {
    if (event.altKey || event.metaKey || event.repeat) return;
    if (event.target.closest?.(TYPING) && !event.ctrlKey) return;
    const key = keyOf(event);
    if (key === "?") {
      if (dialog.open) dialog.close();
      else show(dialog);
      return;
    }
    const candidates = [...document.querySelectorAll(`[data-key="${CSS.escape(key)}"]`)];
    const element = candidates.find(usable);
    if (!element) return;
    event.preventDefault();
    if (element.matches('input[type="search"], input[type="text"]')) element.focus();
    else element.click();
  });
}
