// The milestones of a scene: a list in the order of their keys, reordered by dragging or by arrow keys.

import { orderable } from "./order.js";
import { t } from "../site/sentences.js";

const FIELDS = ["text", "points", "required", "time_limit_s", "truth"];
const KEYS = 9; // number of milestones that have a key at scoring

const inAll = (n) => (n === 1 ? t("page.milestones.point", "1 point in all") : t("page.milestones.points", "{n} points in all", { n }));

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
        // A bench of the lab's own may report values that ours do not: they are shown as they are stored.
        if (field.matches("select") && ![...field.options].some(({ value }) => value === milestone[name])) field.add(new Option(milestone[name], milestone[name]));
        if (field.type === "checkbox") field.checked = milestone[name];
        else field.value = milestone[name] ?? "";
      }
      const words = t("page.milestones.milestone", "Milestone {n}", { n: index + 1 });
      const key = row.querySelector("kbd");
      key.textContent = index < KEYS ? index + 1 : "–";
      key.title = index < KEYS ? t("page.milestones.key", "Key {n} ticks it at scoring", { n: index + 1 }) : t("page.milestones.no_key", "No key: the first nine have one");
      row.querySelector("[data-milestone=text]").setAttribute("aria-label", words);
      row.querySelector("[data-handle]").setAttribute("aria-label", t("page.milestones.move", "Move milestone {n}: drag, or arrow keys", { n: index + 1 }));
      row.querySelector("[data-remove]")?.setAttribute("aria-label", t("page.milestones.remove", "Remove milestone {n}", { n: index + 1 }));
      row.querySelector("summary").setAttribute("aria-label", t("page.milestones.more", "More of milestone {n}", { n: index + 1 }));
    });
    document.getElementById("no-milestones").hidden = this.#all.length > 0;
    this.#showTotal();
  }

  #showTotal() {
    const points = this.#all.reduce((sum, { points: own }) => sum + (Number(own) || 0), 0);
    document.getElementById("points").textContent = this.#all.length ? inAll(points) : "";
  }

  #typed(field) {
    const milestone = this.#all[this.#index(field)];
    const name = field.dataset.milestone;
    if (field.type === "checkbox") milestone[name] = field.checked;
    else if (field.type === "number") milestone[name] = field.value === "" ? (name === "points" ? 0 : null) : Number(field.value);
    else milestone[name] = field.value;
    if (name === "points") this.#showTotal();
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
    this.#said.textContent = t("page.milestones.removed", "Removed: {text}", { text: text || t("page.milestones.empty", "an empty milestone") });
    this.#changed();
  }

  #moved(from, to) {
    this.#all.splice(to, 0, ...this.#all.splice(from, 1));
    this.show();
    const place = { text: this.#all[to].text, n: to + 1, all: this.#all.length };
    this.#said.textContent = place.text ? t("page.milestones.moved", "{text} is milestone {n} of {all} now", place) : t("page.milestones.moved_empty", "It is milestone {n} of {all} now", place);
    this.#changed();
  }
}
