// The milestones of a scene: a list in the order of their keys, dragged or moved by arrow keys.

import { orderable } from "./order.js";

const FIELDS = ["text", "points", "required", "time_limit_s", "truth"];
const KEYS = 9; // milestones that have a key at scoring

export class MilestoneList {
  #editor;
  #changed;
  #rows = document.getElementById("milestone-rows");
  #pattern = document.getElementById("milestone-row");
  #said = document.getElementById("milestones-said");

  constructor(editor, changed) {
    this.#editor = editor;
    this.#changed = changed;
    orderable(this.#rows, (from, to) => this.#moved(from, to));
    this.#rows.addEventListener("input", (event) => this.#typed(event.target));
    this.#rows.addEventListener("click", (event) => event.target.closest("[data-remove]") && this.#removed(this.#index(event.target)));
    document.getElementById("add-milestone")?.addEventListener("click", () => this.#added());
  }

  get #all() {
    return this.#editor.scene.milestones;
  }

  #index(target) {
    return [...this.#rows.children].indexOf(target.closest("li"));
  }

  show() {
    while (this.#rows.children.length > this.#all.length) this.#rows.lastElementChild.remove();
    while (this.#rows.children.length < this.#all.length) this.#rows.append(this.#pattern.content.cloneNode(true));
    this.#all.forEach((milestone, index) => {
      const row = this.#rows.children[index];
      for (const name of FIELDS) {
        const field = row.querySelector(`[data-milestone=${name}]`);
        // A bench of the lab's own may report what ours do not: it is shown as it is kept.
        if (field.matches("select") && ![...field.options].some(({ value }) => value === milestone[name])) field.add(new Option(milestone[name], milestone[name]));
        if (field.type === "checkbox") field.checked = milestone[name];
        else field.value = milestone[name] ?? "";
      }
      const words = `Milestone ${index + 1}`;
      const key = row.querySelector("kbd");
      key.textContent = index < KEYS ? index + 1 : "–";
      key.title = index < KEYS ? `Key ${index + 1} ticks it at scoring` : "No key: the first nine have one";
      row.querySelector("[data-milestone=text]").setAttribute("aria-label", words);
      row.querySelector("[data-handle]").setAttribute("aria-label", `Move milestone ${index + 1}: drag, or arrow keys`);
      row.querySelector("[data-remove]")?.setAttribute("aria-label", `Remove milestone ${index + 1}`);
      row.querySelector("summary").setAttribute("aria-label", `More of milestone ${index + 1}`);
    });
    document.getElementById("no-milestones").hidden = this.#all.length > 0;
    const points = this.#all.reduce((sum, { points: own }) => sum + (Number(own) || 0), 0);
    document.getElementById("points").textContent = this.#all.length ? `${points} point${points === 1 ? "" : "s"} in all` : "";
  }

  #typed(field) {
    const milestone = this.#all[this.#index(field)];
    const name = field.dataset.milestone;
    if (field.type === "checkbox") milestone[name] = field.checked;
    else if (field.type === "number") milestone[name] = field.value === "" ? (name === "points" ? 0 : null) : Number(field.value);
    else milestone[name] = field.value;
    if (name === "points") document.getElementById("points").textContent = `${this.#all.reduce((sum, { points }) => sum + points, 0)} points in all`;
    this.#changed();
  }

  #added() {
    this.#all.push({ id: null, text: "", points: 1, required: false, time_limit_s: null, truth: "" });
    this.show();
    this.#rows.lastElementChild.querySelector("[data-milestone=text]").focus();
    this.#changed();
  }

  #removed(index) {
    const [{ text }] = this.#all.splice(index, 1);
    this.show();
    document.getElementById("add-milestone").focus();
    this.#said.textContent = `Removed: ${text || "an empty milestone"}`;
    this.#changed();
  }

  #moved(from, to) {
    this.#all.splice(to, 0, ...this.#all.splice(from, 1));
    this.show();
    this.#said.textContent = `${this.#all[to].text || "It"} is milestone ${to + 1} of ${this.#all.length} now`;
    this.#changed();
  }
}
