// One of the small multiples: the curves of a joint, which joint that is, and its values at the cursor.

import { KINDS } from "../console/curves/curve_kinds.js";
import { jointOptions } from "../console/manual/joint_names.js";
import { last } from "../site/ascending.js";
import { Plot } from "./plot.js";

export class CurveCell {
  #read;
  #plot;
  #drawn; // {curves, raw, unit} of the joint
  #select;
  #values = new Map(); // name of a curve -> where its value stands

  /**
   * Number `number` of `count`, the first with the strip of the chunks. `read(index)` gives {curves, raw, unit} of a joint;
   * `chose()` hears that another one is drawn, `remove()` that it is not wanted any more.
   */
  constructor({ index, number, count, read, joints, grippers, library, behind, shown, seek, hover, chose, remove }) {
    this.#read = read;
    this.index = index;
    this.element = document.getElementById("curve-cell").content.firstElementChild.cloneNode(true);
    const place = this.element.querySelector(".curves-plot");
    this.#select = this.element.querySelector("select");
    if (!number) [this.#select.id, place.id] = ["joint", "curves"];
    this.#select.setAttribute("aria-label", `Joint of curve ${number + 1}`);
    this.#select.replaceChildren(...jointOptions(joints, grippers));
    this.#select.value = String(index);
    this.#select.addEventListener("change", () => {
      this.index = Number(this.#select.value);
      this.draw();
      chose();
    });
    const off = this.element.querySelector("[data-remove]");
    off.setAttribute("aria-label", `Leave out curve ${number + 1}, ${joints[index]}`);
    off.hidden = count < 2;
    off.addEventListener("click", remove);
    this.#write();
    this.#plot = new Plot({ element: place, library, behind, strip: !number, shown, seek, hover });
  }

  #write() {
    const values = this.element.querySelector("[data-values]");
    for (const { name, colour, means } of KINDS) {
      const value = Object.assign(document.createElement("span"), { title: `${name}: ${means}` });
      value.style.setProperty("color", `var(${colour})`);
      values.append(value);
      this.#values.set(name, value);
    }
  }

  focus() {
    this.#select.focus();
  }

  /** Draw its joint; it has to be on the page. */
  draw() {
    this.#drawn = this.#read(this.index);
    this.element.querySelector("[data-unit]").textContent = this.#drawn.unit;
    this.#plot.show(this.#drawn.curves, this.#drawn.raw);
  }

  reveal(name, shown) {
    this.#plot.reveal(name, shown);
  }

  /** Move the line of the clock to `now`, and say the values at `time`, which is in `tick` and a step of chunk `owner`. */
  at(now, { tick, time, owner }) {
    const { curves, raw } = this.#drawn;
    this.#plot.at(now);
    this.#plot.choose(owner);
    for (const name of ["state", "executed", "smoothed"]) this.#say(name, tick < 0 ? NaN : curves[name][tick]);
    this.#say("raw", wanted(raw, time));
  }

  #say(name, value) {
    const text = Number.isFinite(value) ? value.toFixed(3) : "–";
    const place = this.#values.get(name);
    if (place.textContent !== text) place.textContent = text;
  }

  destroy() {
    this.#plot.destroy();
  }
}

/** What the newest chunk wants at `time`; NaN where it says nothing. */
function wanted(chunks, time) {
  const chunk = chunks.findLast(({ times }) => times[0] <= time);
  return chunk ? chunk.values[last(chunk.times, time)] : NaN;
}
