// The legend of the curves: each entry shows or hides its curve, and shows the value at the cursor.

import { KINDS } from "./curve_kinds.js";
import { t } from "../../site/sentences.js";

const KEY = "eva-curves-hidden"; // the choice applies to every page of this browser

/** Fills `element`; `changed(name, shown)` is called for every entry that is pressed. */
export class Legend {
  #entries = new Map();
  #hidden = new Set(JSON.parse(localStorage.getItem(KEY) ?? "[]"));
  #changed;

  constructor(element, changed) {
    this.#changed = changed;
    for (const kind of KINDS) {
      const entry = button(kind);
      entry.addEventListener("click", () => this.#press(kind.name));
      element.append(entry);
      this.#entries.set(kind.name, entry);
      this.#mark(kind.name);
    }
  }

  /** Return whether the curve of that name is drawn. */
  shown(name) {
    return !this.#hidden.has(name);
  }

  /** Write the value beside the word; NaN becomes a dash. */
  value(name, value) {
    const text = Number.isFinite(value) ? value.toFixed(3) : "–";
    const place = this.#entries.get(name).lastElementChild;
    if (place.textContent !== text) place.textContent = text;
  }

  /** Show why there is nothing to draw, in place of the meaning. */
  explain(name, words) {
    this.#entries.get(name).title = words;
  }

  #press(name) {
    if (!this.#hidden.delete(name)) this.#hidden.add(name);
    localStorage.setItem(KEY, JSON.stringify([...this.#hidden]));
    this.#mark(name);
    this.#changed(name, this.shown(name));
  }

  #mark(name) {
    this.#entries.get(name).setAttribute("aria-pressed", String(this.shown(name)));
  }
}

function button({ name, title, colour, dash, means }) {
  const entry = document.createElement("button");
  entry.type = "button";
  entry.className = "legend";
  entry.dataset.curve = name;
  entry.title = t("page.curves.press", "{means}. Press to show or hide it.", { means });
  const swatch = document.createElement("i");
  swatch.style.setProperty("--colour", `var(${colour})`);
  swatch.toggleAttribute("data-dashed", Boolean(dash));
  const word = document.createElement("span");
  word.textContent = title;
  const value = document.createElement("span");
  value.className = "legend-value";
  entry.append(swatch, word, value);
  return entry;
}
