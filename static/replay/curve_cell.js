// One plot of the pane of curves: a joint's curves, the choice of the joint, and its values at the cursor.

import { KINDS, SECOND } from "../console/curves/curve_kinds.js";
import { jointOptions } from "../console/manual/joint_names.js";
import { lastNotAbove } from "../site/binary_search.js";
import { t } from "../site/sentences.js";
import { Plot } from "./plot.js";

const OTHERS = { state: t("page.curves.state", "state"), executed: t("page.curves.executed", "executed"), smoothed: t("page.curves.smoothed", "smoothed") };

export class CurveCell {
  #read;
  #plot;
  #drawn; // {curves, raw, unit} of the joint
  #select;
  #second; // choice of a signal of another joint that is drawn too
  #other = null; // the values of that signal
  #values = new Map(); // name of a curve -> element of its value

  /**
   * Plot number `number` of `count`; the first has the strip of the chunks. `read(index)` returns {curves, raw, unit} of a
   * joint; `chose()` is called when another joint or signal is chosen, `remove()` when the plot is to be removed.
   */
  constructor({ index, number, count, read, joints, grippers, library, behind, shown, seek, hover, chose, remove }) {
    this.#read = read;
    this.index = index;
    this.element = document.getElementById("curve-cell").content.firstElementChild.cloneNode(true);
    const place = this.element.querySelector(".curves-plot");
    this.#select = this.element.querySelector("select");
    if (!number) [this.#select.id, place.id] = ["joint", "curves"];
    this.#select.setAttribute("aria-label", t("page.curves.joint_of", "Joint of curve {n}", { n: number + 1 }));
    this.#select.replaceChildren(...jointOptions(joints, grippers));
    this.#select.value = String(index);
    this.#select.addEventListener("change", () => {
      this.index = Number(this.#select.value);
      this.draw();
      chose();
    });
    this.#second = this.element.querySelector("[data-second]");
    this.#second.setAttribute("aria-label", t("page.curves.another_in", "Another signal in curve {n}", { n: number + 1 }));
    this.#second.append(...Object.keys(OTHERS).map((kind) => signals(kind, joints)));
    this.#second.addEventListener("change", () => {
      this.#beside();
      chose();
    });
    const off = this.element.querySelector("[data-remove]");
    off.setAttribute("aria-label", t("page.curves.leave_out", "Leave out curve {n}, {joint}", { n: number + 1, joint: joints[index] }));
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
    const other = document.createElement("span");
    other.style.setProperty("color", `var(${SECOND.colour})`);
    values.append(other);
    this.#values.set("second", other);
  }

  #beside() {
    const [kind, index] = this.#second.value.split(":");
    this.#other = kind ? this.#read(Number(index)).curves[kind] : null;
    const value = this.#values.get("second");
    this.#second.title = kind ? this.#second.selectedOptions[0].text : t("page.curves.another", "Another signal in this plot");
    value.title = kind ? t("page.curves.dotted", "{signal}, dotted, axis at the right", { signal: this.#second.title }) : "";
    this.#plot.beside(this.#other);
  }

  get second() {
    return Boolean(this.#other);
  }

  align(on) {
    this.#plot.align(on);
  }

  focus() {
    this.#select.focus();
  }

  /** Draw the chosen joint; the element must be on the page. */
  draw() {
    this.#drawn = this.#read(this.index);
    this.element.querySelector("[data-unit]").textContent = this.#drawn.unit;
    this.#plot.show(this.#drawn.curves, this.#drawn.raw);
  }

  reveal(name, shown) {
    this.#plot.reveal(name, shown);
  }

  /**
   * Move the line of the clock to `now`, and show the values at `time`, which lies in `tick` and in a step of chunk `owner`.
   */
  at(now, { tick, time, owner }) {
    const { curves, raw } = this.#drawn;
    this.#plot.at(now);
    this.#plot.choose(owner);
    for (const name of ["state", "executed", "smoothed"]) this.#say(name, tick < 0 ? NaN : curves[name][tick]);
    this.#say("raw", wanted(raw, time));
    if (this.#other) this.#say("second", tick < 0 ? NaN : this.#other[tick]);
    else this.#values.get("second").textContent = "";
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

/** Return a group of options: the signal `kind` of every joint. */
function signals(kind, joints) {
  const group = document.createElement("optgroup");
  group.label = OTHERS[kind];
  group.append(...joints.map((name, index) => new Option(`${name} ${OTHERS[kind]}`, `${kind}:${index}`)));
  return group;
}

/** Return what the newest chunk wants at `time`; NaN if there is none. */
function wanted(chunks, time) {
  const chunk = chunks.findLast(({ times }) => times[0] <= time);
  return chunk ? chunk.values[lastNotAbove(chunk.times, time)] : NaN;
}
