// Positions that are generated from the present one: the form, and the result before it is kept.

import { things } from "./bench.js";
import { generated, nearest } from "./generate.js";
import { t } from "../site/sentences.js";

const MOST = 100; // positions that may be generated at once

export class Generator {
  made = []; // benches that are not kept yet
  #form;
  #sizes;
  #bench;
  #draw;
  #keep;

  /**
   * `bench()` returns the bench to start from, `draw()` shows the benches in `made`, and `keep(benches, replace)` adds them.
   */
  constructor(form, sizes, { bench, draw, keep }) {
    this.#form = form;
    this.#sizes = sizes;
    this.#bench = bench;
    this.#draw = draw;
    this.#keep = keep;
    form.addEventListener("change", () => this.offer());
    form.addEventListener("submit", (event) => {
      event.preventDefault(); // Enter in a field must not send the form
      this.#generate();
    });
    for (const [id, act] of Object.entries({
      "generate": () => this.#generate(),
      "another-seed": () => this.#again(),
      "keep-generated": () => this.#kept(),
      "drop-generated": () => this.#drop(),
    })) document.getElementById(id).addEventListener("click", act);
  }

  /** Show the fields of the chosen method, and offer the objects that can be placed anew. */
  offer() {
    const method = this.#form.elements.method.value;
    for (const field of this.#form.querySelectorAll("[data-methods]")) field.hidden = !field.dataset.methods.split(" ").includes(method);
    const all = things(this.#bench(), this.#sizes);
    const choice = this.#form.elements.thing;
    const before = choice.value;
    const options = all.map(({ key, name }) => new Option(name, key));
    if (method !== "grid" && all.length > 1) options.unshift(new Option(t("page.generator.everything", "everything"), "*"));
    choice.replaceChildren(...options);
    if (options.some(({ value }) => value === before)) choice.value = before;
    document.getElementById("generate").disabled = !all.length;
  }

  #again() {
    this.#form.elements.seed.value = Math.floor(Math.random() * 1e6);
    this.#generate();
  }

  #generate() {
    const { elements } = this.#form;
    const value = (name) => Number(elements[name].value);
    const bench = this.#bench();
    const keys = elements.thing.value === "*" ? things(bench, this.#sizes).map(({ key }) => key) : [elements.thing.value];
    const area = ["left", "right", "near", "far"].map(value);
    const counts = Object.fromEntries(["n", "columns", "rows", "least", "seed", "turn"].map((name) => [name, value(name)]));
    const method = elements.method.value;
    const wanted = method === "grid" ? counts.columns * counts.rows : counts.n;
    if (!(Number.isInteger(wanted) && wanted >= 1 && wanted <= MOST && area[0] <= area[1] && area[2] <= area[3])) {
      this.#say(t("page.generator.not_generated", "Not generated: allowed are 1 to {most} positions, in an area given from low to high.", { most: MOST }));
      return;
    }
    const { benches, left } = generated({ method, bench, sizes: this.#sizes, keys, area, ...counts });
    const apart = nearest(benches, this.#sizes);
    const said = [benches.length === 1 ? t("page.generator.one", "1 position, shown faintly") : t("page.generator.made", "{n} positions, shown faintly", { n: benches.length })];
    if (Number.isFinite(apart)) said.push(t("page.generator.nearest", "the nearest two are {apart} mm apart", { apart: apart.toFixed(0) }));
    if (left) said.push(t("page.generator.left", "{left} of {wanted} left out: too close to something, or out of reach", { left, wanted }));
    this.#show(benches, said.join(t("page.common.semicolon", "; ")) + t("page.common.full_stop", "."));
  }

  #kept() {
    const { made } = this;
    this.#drop();
    this.#keep(made, this.#form.elements.replace.checked);
  }

  #drop() {
    this.#show([], "");
  }

  #show(benches, words) {
    this.made = benches;
    document.getElementById("generated-actions").hidden = !benches.length;
    document.getElementById("keep-generated").textContent = t("page.generator.keep", "Keep these {n}", { n: benches.length });
    this.#say(words);
    this.#draw();
  }

  #say(words) {
    document.getElementById("generated-said").textContent = words;
  }
}
