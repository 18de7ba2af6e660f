// The legend of the marks among the curves, with their values at the cursor.

import { MARKS } from "./curve_marks.js";
import { t } from "../../site/sentences.js";

export class MarkLegend {
  #values = new Map();

  /** Append an entry per mark to `element`. */
  constructor(element) {
    for (const mark of MARKS) {
      const entry = document.createElement("span");
      entry.className = "legend legend-mark";
      entry.dataset.mark = mark.name;
      entry.title = mark.means;
      const swatch = document.createElement("i");
      swatch.className = mark.shape;
      swatch.style.setProperty("--colour", `var(${mark.colour})`);
      const value = document.createElement("span");
      value.className = "legend-value";
      entry.append(swatch, mark.title, value);
      element.append(entry);
      this.#values.set(mark.name, value);
    }
  }

  /** Show the values of the sample at the cursor {chunk, chunks, limited}; null shows none. */
  show(sample) {
    this.#write("chunk", sample && sample.chunk >= 0 ? String(sample.chunk) : "–");
    this.#write("overlap", sample && sample.chunks > 1 ? t("page.curves.of_chunks", "of {n}", { n: sample.chunks }) : "–");
    this.#write("safety", sample ? (sample.limited ? t("page.curves.changed", "changed") : t("page.curves.unchanged", "no")) : "–");
  }

  #write(name, text) {
    const place = this.#values.get(name);
    if (place.textContent !== text) place.textContent = text;
  }
}
