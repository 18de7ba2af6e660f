// Curves of further joints beside the first: a plot each, with a choice of joint above it; all are paused and hidden together.

import { jointOptions } from "../manual/joint_names.js";
import { Curves } from "./curves.js";
import { t } from "../../site/sentences.js";

const MOST = 3; // plots beside the first; more would be too small to read
const QUIET = { show() {} }; // only the first plot updates the legend of marks

export class Beside {
  #place;
  #key;
  #make;
  #cells = []; // {element, curves, select}
  #names = [];
  #grippers = [];

  /**
   * `place` holds the plots, `key` is the key of the choice in localStorage, and `make` has {library, legend} for all plots.
   */
  constructor({ place, key, ...make }) {
    this.#place = place;
    this.#key = key;
    this.#make = make;
  }

  get all() {
    return this.#cells.map(({ curves }) => curves);
  }

  /** True if there is no room for another plot. */
  get full() {
    return this.#cells.length >= Math.min(MOST, this.#names.length - 1);
  }

  /** Use the joints of this robot; those of the kept choice are drawn again. */
  joints(names, grippers) {
    this.#names = names;
    this.#grippers = grippers;
    for (const { element } of this.#cells) element.remove();
    this.#cells = [];
    const kept = JSON.parse(localStorage.getItem(this.#key) ?? "[]");
    for (const joint of kept.map((name) => names.indexOf(name)).filter((index) => index >= 0)) if (!this.full) this.#draw(joint);
  }

  /** Add a plot: of the joint after `joint` and all joints already drawn. */
  add(joint) {
    if (this.full) return;
    const drawn = [joint, ...this.#cells.map(({ select }) => select.selectedIndex)];
    this.#draw((Math.max(...drawn) + 1) % this.#names.length);
    this.#keep();
  }

  #draw(joint) {
    const element = document.createElement("div");
    element.className = "curves-cell";
    const head = document.createElement("div");
    head.className = "row line small";
    const select = document.createElement("select");
    select.setAttribute("aria-label", t("page.curves.joint_beside", "Joint of another curve"));
    select.append(...jointOptions(this.#names, this.#grippers));
    select.selectedIndex = joint;
    const off = Object.assign(document.createElement("button"), { type: "button", className: "button button-quiet", textContent: "×" });
    off.setAttribute("aria-label", t("page.curves.remove", "Remove the curve of {joint}", { joint: this.#names[joint] }));
    head.append(select, off);
    const plot = document.createElement("div");
    plot.className = "curves-plot";
    element.append(head, plot);
    this.#place.append(element);
    const { library, legend } = this.#make;
    const curves = new Curves({ element: plot, library, legend: { shown: (name) => legend.shown(name), value() {} }, markLegend: QUIET, names: this.#names });
    curves.show(joint);
    const cell = { element, curves, select };
    this.#cells.push(cell);
    select.addEventListener("change", () => {
      curves.show(select.selectedIndex);
      off.setAttribute("aria-label", t("page.curves.remove", "Remove the curve of {joint}", { joint: this.#names[select.selectedIndex] }));
      this.#keep();
    });
    off.addEventListener("click", () => {
      this.#cells.splice(this.#cells.indexOf(cell), 1);
      curves.end();
      element.remove();
      this.#keep();
      this.#place.dispatchEvent(new Event("curves"));
    });
  }

  #keep() {
    localStorage.setItem(this.#key, JSON.stringify(this.#cells.map(({ select }) => this.#names[select.selectedIndex])));
  }
}
