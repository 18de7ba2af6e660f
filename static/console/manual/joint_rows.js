// A slider and a number field for each joint of a group, within its limits.

import { clampToLimits } from "./targets.js";
import { digitsOf, shortUnit, stepOf } from "../curves/units.js";
import { t } from "../../site/sentences.js";

export class JointRows {
  #list = document.getElementById("joints");
  #template = document.getElementById("joint-row").content;
  #rows = []; // {joint, slider, number, row}
  #typed;

  /** `typed(index, value, said)` is called when the user sets a value; `said` reports how it was limited, or is "". */
  constructor(typed) {
    this.#typed = typed;
  }

  build(joints) {
    this.#rows = joints.map((joint) => this.#row(joint));
    this.#list.replaceChildren(...this.#rows.map(({ row }) => row));
  }

  /** Show the target; a field with the focus is left alone. */
  show(target) {
    for (const { joint, slider, number } of this.#rows) {
      const value = target[joint.index];
      if (document.activeElement !== slider || slider.valueAsNumber !== value) slider.value = value;
      if (document.activeElement !== number) number.value = value.toFixed(digitsOf(joint));
    }
  }

  /** Mark on each track where the robot is. */
  now(measured) {
    for (const { joint, row } of this.#rows) {
      const at = (measured[joint.index] - joint.lower) / (joint.upper - joint.lower);
      row.style.setProperty("--now", Math.min(1, Math.max(0, at)).toFixed(4));
    }
  }

  /** Focus the next slider or, with `by` -1, the previous one, counted from the slider that has the focus. */
  focus(by) {
    const at = this.#rows.findIndex(({ slider }) => slider === document.activeElement);
    const count = this.#rows.length;
    this.#rows[at < 0 ? (by > 0 ? 0 : count - 1) : (at + by + count) % count]?.slider.focus();
  }

  #row(joint) {
    const row = this.#template.cloneNode(true).firstElementChild;
    const [label, slider, number] = [row.querySelector("label"), ...row.querySelectorAll("input")];
    const step = stepOf(joint);
    Object.assign(slider, { id: `joint-${joint.index}`, min: joint.lower, max: joint.upper, step: "any" });
    Object.assign(number, { step, min: joint.lower, max: joint.upper });
    label.htmlFor = slider.id;
    label.textContent = joint.label;
    const { unit } = joint;
    row.title = t("page.manual.range", "{joint}: {lower} to {upper} {unit}", { joint: joint.full, lower: joint.lower, upper: joint.upper, unit }).trim();
    row.querySelector(".joint-unit").textContent = shortUnit(unit);
    slider.setAttribute("aria-label", joint.full);
    number.setAttribute("aria-label", unit ? t("page.manual.number_in", "{joint} in {unit}, as a number", { joint: joint.full, unit }) : t("page.manual.number", "{joint} as a number", { joint: joint.full }));
    slider.addEventListener("input", () => this.#set(joint, slider.valueAsNumber, number));
    slider.addEventListener("keydown", (event) => this.#arrow(event, joint, slider, number));
    number.addEventListener("input", () => this.#type(joint, number.valueAsNumber, slider));
    number.addEventListener("change", () => this.#set(joint, number.valueAsNumber, number, slider));
    return { joint, slider, number, row };
  }

  #set(joint, given, number, slider = null) {
    if (!Number.isFinite(given)) return;
    const { value, said } = clampToLimits(joint, given);
    number.value = value.toFixed(digitsOf(joint));
    if (slider) slider.value = value;
    this.#typed(joint.index, value, said);
  }

  /** Apply a number while it is typed; the field itself is limited and formatted when it is left. */
  #type(joint, given, slider) {
    if (!Number.isFinite(given)) return;
    const { value, said } = clampToLimits(joint, given);
    slider.value = value;
    this.#typed(joint.index, value, said);
  }

  /** Move a slider by one step per arrow key, by ten with Shift: its built-in steps would be too coarse, or not round. */
  #arrow(event, joint, slider, number) {
    const sign = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    if (!sign || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    this.#set(joint, slider.valueAsNumber + sign * stepOf(joint) * (event.shiftKey ? 10 : 1), number, slider);
  }
}
