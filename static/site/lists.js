// Filters of lists (empty values stay out of the address), and actions on all rows that are ticked.

import { post, RequestFailed } from "./api.js";
import { t } from "./sentences.js";

document.body.addEventListener("htmx:configRequest", ({ detail }) => {
  if (!detail.elt.matches("[data-list-filter]")) return;
  for (const [name, value] of [...detail.formData.entries()]) if (!value) detail.formData.delete(name);
});

const NONE = "00000000-0000-0000-0000-000000000000"; // placeholder for the uuid in an address

const episodes = (n) => (n === 1 ? t("page.lists.one_episode", "1 episode") : t("page.lists.episodes", "{n} episodes", { n }));

/** Actions on several episodes: one request for each, one after the other; refusals are reported. */
class Bulk {
  #bar = document.querySelector("[data-bulk]");
  #ticked = new Set();
  #busy = false;
  #ended = false; // the user ended the action that is under way
  #undo = []; // {value, content} that undo the last change of tags

  constructor() {
    document.addEventListener("change", ({ target }) => this.#changed(target));
    document.addEventListener("click", ({ target }) => this.#clicked(target));
    document.body.addEventListener("htmx:afterSwap", () => this.#show());
    for (const box of this.#boxes) this.#tick(box); // boxes that were ticked before this script ran, or that the browser restored on the way back
    this.#show();
  }

  get #boxes() {
    return [...document.querySelectorAll("[data-tick]")];
  }

  #part(name) {
    return this.#bar.querySelector(`[data-bulk-${name}]`);
  }

  #changed(target) {
    if (target.matches("[data-tick]")) this.#tick(target);
    if (target.matches("[data-tick-all]")) {
      for (const box of this.#boxes) this.#tick(Object.assign(box, { checked: target.checked }));
    }
    this.#show();
  }

  #tick({ checked, value }) {
    if (checked) this.#ticked.add(value);
    else this.#ticked.delete(value);
  }

  /** Update boxes and buttons: replaced rows keep their ticks, and rows that are gone are no longer chosen. */
  #show() {
    const there = new Set(this.#boxes.map(({ value }) => value));
    for (const value of this.#ticked) if (!there.has(value)) this.#ticked.delete(value);
    for (const box of this.#boxes) box.checked = this.#ticked.has(box.value);
    const all = document.querySelector("[data-tick-all]");
    if (all) {
      all.checked = there.size > 0 && this.#ticked.size === there.size;
      all.indeterminate = this.#ticked.size > 0 && !all.checked;
    }
    this.#bar.hidden = !this.#ticked.size && !this.#busy && !this.#part("said").textContent;
    this.#part("count").textContent = t("page.lists.chosen", "{n} chosen", { n: this.#ticked.size });
    for (const button of this.#bar.querySelectorAll("[data-bulk-address]")) button.disabled = this.#busy || !this.#ticked.size;
    this.#part("end").hidden = !this.#busy;
    this.#part("undo").hidden = this.#busy || !this.#undo.length;
    this.#datasets();
  }

  /**
   * Offer a link to the page that makes a new dataset of the chosen episodes: one for each dataset that contains some of them.
   */
  #datasets() {
    const published = new Map();
    for (const { checked, dataset } of this.#boxes) {
      if (checked && dataset.of) published.set(dataset.of, [...(published.get(dataset.of) ?? []), Number(dataset.index)]);
    }
    const links = [...published].map(([address, indices]) => {
      const chosen = indices.sort((one, other) => one - other);
      const [name] = address.split("/").slice(-2);
      const text = t("page.lists.new_dataset", "New dataset from {n} of {name}", { n: chosen.length, name: decodeURIComponent(name) });
      return Object.assign(document.createElement("a"), { className: "button", href: `${address}?chosen=${chosen}#split`, textContent: text });
    });
    this.#part("datasets").replaceChildren(...links);
  }

  async #clicked(target) {
    const button = target.closest?.("button");
    if (button?.matches("[data-bulk-end]")) this.#ended = true;
    if (this.#busy) return;
    if (button?.matches("[data-bulk-undo]")) await this.#takeBack();
    if (button?.matches("[data-bulk-address]")) await this.#do(button);
  }

  async #do(button) {
    const chosen = [...this.#ticked];
    const words = button.textContent.trim();
    const content = this.#content(button);
    if (!content) {
      this.#say(t("page.lists.type_tag", "Type the tag first."));
      this.#bar.querySelector("[name=tag]").focus();
      return;
    }
    const { bulkAsk, bulkTitle } = button.dataset;
    if (bulkAsk && !(await this.#sure(bulkTitle.replace("N", episodes(chosen.length)), bulkAsk))) return;
    const work = chosen.map((value) => ({ value, content }));
    const answers = await this.#all(words, button.dataset.bulkAddress, work);
    this.#undo = answers
      .map(({ value, answer: { added, removed } }) => ({ value, content: { add: removed ?? [], remove: added ?? [] } }))
      .filter(({ content: { add, remove } }) => add.length || remove.length);
    this.#show();
  }

  /** Return what a button sends, or "" if it needs a tag and none was typed. */
  #content({ dataset }) {
    const field = (name) => this.#bar.querySelector(`[data-bulk-field][name=${name}]`).value.trim();
    if (dataset.bulkTag) return field("tag") && { [dataset.bulkTag]: [field("tag")] };
    const content = JSON.parse(dataset.bulkContent ?? "{}");
    if (dataset.bulkFields) content[dataset.bulkFields] = field(dataset.bulkFields);
    return content;
  }

  async #takeBack() {
    const work = this.#undo;
    const done = await this.#all(t("page.lists.undo", "Undo"), this.#bar.querySelector("[data-bulk-tag]").dataset.bulkAddress, work);
    const values = new Set(done.map(({ value }) => value));
    this.#undo = work.filter(({ value }) => !values.has(value));
    this.#show();
  }

  /** Resolve to true if the user confirms. */
  #sure(title, words) {
    const dialog = this.#part("sure");
    dialog.querySelector("h2").textContent = t("page.lists.sure", "{title}?", { title });
    dialog.querySelector("form > p").textContent = words;
    dialog.querySelector("[value=yes]").textContent = title;
    dialog.returnValue = "";
    dialog.showModal();
    return new Promise((resolve) => {
      dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
    });
  }

  /** Send every {value, content} of `work`; resolve to the answers as [{value, answer}]. */
  async #all(words, address, work) {
    this.#busy = true;
    this.#ended = false;
    const faults = [];
    const answers = [];
    for (const [index, { value, content }] of work.entries()) {
      if (this.#ended) break;
      this.#say(t("page.lists.doing", "{words}: {n} of {all} …", { words, n: index + 1, all: work.length }));
      try {
        answers.push({ value, answer: await post(address.replace(NONE, value), content) });
      } catch (error) {
        if (!(error instanceof RequestFailed)) throw error;
        faults.push(error.message);
      }
    }
    this.#busy = false;
    const left = work.length - answers.length - faults.length;
    const changes = answers.filter(({ answer: { added, removed } }) => added?.length || removed?.length).length;
    const said = [t("page.lists.done", "{words}: {n} of {all} done", { words, n: answers.length, all: work.length })];
    if (address.endsWith("/tags") && changes < answers.length) said.push(t("page.lists.unchanged", "{n} unchanged", { n: answers.length - changes }));
    if (left) said.push(t("page.lists.ended", "ended, {left} left unchanged", { left }));
    if (faults.length) said.push(t("page.lists.refused", "{n} refused: {why}", { n: faults.length, why: [...new Set(faults)].join("; ") }));
    this.#say(said.join(t("page.common.next_sentence", ". ")) + t("page.common.full_stop", "."));
    if (answers.length) window.htmx.ajax("GET", window.location.href, { target: "#list", select: "#list", swap: "outerHTML" });
    return answers;
  }

  #say(words) {
    this.#part("said").textContent = words;
    this.#show();
  }
}

if (document.querySelector("[data-bulk]")) new Bulk();
