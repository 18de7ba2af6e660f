// Prompt and strategy: what is in force and what is edited; one press applies the edits, before or during a run.

import { changes, cost, PARAMETERS, read, text } from "./tuning.js";
import { t } from "../../site/sentences.js";

export class TuningPanel {
  #store;
  #commands;
  #kind = document.getElementById("strategy-kind");
  #task = document.getElementById("task");
  #choice = document.getElementById("task-choice");
  #fields = new Map(); // name of a parameter -> its field
  #edited = new Set(); // names of parameters the user has changed; "kind" for the strategy
  #known = ""; // the tasks and kinds that are offered, as JSON

  constructor(store, commands) {
    this.#store = store;
    this.#commands = commands;
    this.#build();
    this.#kind.addEventListener("change", () => this.#edit("kind"));
    this.#choice.addEventListener("change", () => this.#take());
    this.#task.addEventListener("input", () => this.draw());
    this.#task.addEventListener("keydown", (event) => event.key === "Enter" && button("tune").click());
    part("undo").addEventListener("click", () => this.#undo());
    part("deployed").addEventListener("click", () => this.#deployed());
    commands.provide("tune", () => this.#wanted().args);
    store.on("snapshot", () => this.draw());
  }

  #build() {
    const template = document.getElementById("parameter-row").content;
    for (const [name, { label, unit = "", choices, none, title, whole }] of Object.entries(PARAMETERS)) {
      const row = template.cloneNode(true).firstElementChild;
      const field = choices ? document.createElement("select") : document.createElement("input");
      if (choices) field.append(...choices.map((choice) => new Option(choice)));
      else Object.assign(field, { type: "text", inputMode: whole ? "numeric" : "decimal", placeholder: none ?? "", autocomplete: "off" });
      field.id = `parameter-${name}`;
      row.dataset.parameter = name;
      row.title = title;
      row.querySelector("label").htmlFor = field.id;
      row.querySelector("label").textContent = label;
      row.querySelector(".parameter-field").append(field);
      row.querySelector(".parameter-unit").textContent = unit;
      field.addEventListener("input", () => this.#edit(name));
      field.addEventListener("keydown", (event) => event.key === "Enter" && button("tune").click());
      this.#fields.set(name, field);
      document.getElementById("parameters").append(row);
    }
  }

  get #inForce() {
    return this.#store.snapshot?.tuning ?? {};
  }

  get #uses() {
    const own = this.#store.snapshot?.facts?.strategies?.[this.#kind.value] ?? [];
    return own.filter((name) => name in PARAMETERS);
  }

  #edit(name) {
    this.#edited.add(name);
    this.draw();
  }

  #take() {
    this.#task.value = this.#choice.value;
    this.#choice.selectedIndex = 0;
    this.#task.dispatchEvent(new Event("input", { bubbles: true })); // saves it as a draft too
  }

  #undo() {
    this.#edited.clear();
    this.#task.value = "";
    this.#task.dispatchEvent(new Event("input", { bubbles: true }));
  }

  #deployed() {
    const own = this.#store.snapshot?.facts?.strategy;
    if (!own) return;
    this.#kind.value = own.kind;
    for (const [name, field] of this.#fields) field.value = text(name, own[name]);
    this.#edited = new Set(["kind", ...this.#fields.keys()]);
    this.draw();
  }

  /** Return what Apply would send: {args, error, words}. */
  #wanted() {
    const { snapshot } = this.#store;
    const typed = Object.fromEntries([...this.#fields].map(([name, field]) => [name, field.value]));
    const strategy = changes(this.#kind.value, typed, this.#inForce, this.#uses);
    const task = this.#task.value.trim();
    const args = {};
    if (Object.keys(strategy.changes).length) args.strategy = strategy.changes;
    if (task && task !== snapshot.task) args.task = task;
    const words = [...Object.keys(strategy.changes).map((name) => PARAMETERS[name]?.label ?? t("page.tuning.strategy", "Strategy")), ...(args.task ? [t("page.tuning.prompt", "Prompt")] : [])];
    return { args, error: strategy.error, words };
  }

  draw() {
    const { snapshot } = this.#store;
    if (!snapshot?.tuning || !snapshot.facts?.strategies) return;
    this.#offer(snapshot);
    this.#show();
    const { error, words } = this.#wanted();
    button("tune").dataset.blocked = error || (words.length ? "" : t("page.tuning.nothing_edited", "nothing is edited: what is shown is in force"));
    part("undo").setAttribute("aria-disabled", String(!words.length && !error));
    part("deployed").setAttribute("aria-disabled", String(!snapshot.facts.strategy));
    part("deployed").title = snapshot.facts.strategy ? "" : t("page.tuning.no_deployed", "the station does not say what its deployment has");
    const program = snapshot.policy?.kind === "external" ? snapshot.policy.name : ""; // which the robot server has set up
    write("checkpoint", t("page.tuning.in_force", "In force: {what}", { what: snapshot.checkpoint?.name || program || t("page.tuning.as_deployed", "as deployed") }));
    write("task", t("page.tuning.in_force", "In force: {what}", { what: snapshot.task ? `“${snapshot.task}”` : t("page.tuning.no_prompt", "no prompt") }));
    write("edited", error || (words.length ? t("page.tuning.edited", "Edited, not yet in force: {what}", { what: words.join(t("page.common.comma", ", ")) }) : ""));
    part("edited").dataset.kind = error ? "error" : "";
    this.#drawParameters(snapshot);
    this.#commands.gate();
  }

  #offer({ facts, task }) {
    const kinds = Object.keys(facts.strategies);
    const tasks = facts.tasks ?? [];
    const known = JSON.stringify([kinds, tasks]);
    if (known === this.#known) return;
    this.#known = known;
    this.#kind.replaceChildren(...kinds.map((kind) => new Option(kind)));
    const none = new Option(tasks.length ? t("page.tuning.prompts", "Configured prompts") : t("page.tuning.no_prompts", "No configured prompt"), "");
    none.disabled = none.hidden = true;
    this.#choice.replaceChildren(none, ...tasks.map((one) => new Option(one)));
    this.#choice.disabled = !tasks.length;
    this.#choice.selectedIndex = 0;
    this.#task.placeholder = task ? t("page.tuning.as_deployed", "as deployed") : t("page.tuning.what_to_do", "what the robot is to do");
  }

  /** Show what is in force in all fields that are not edited. */
  #show() {
    const inForce = this.#inForce;
    if (!this.#edited.has("kind") && this.#kind.value !== inForce.kind) this.#kind.value = inForce.kind;
    for (const [name, field] of this.#fields) {
      const now = text(name, inForce[name]);
      if (field.value === now) this.#edited.delete(name);
      else if (!this.#edited.has(name)) field.value = now;
    }
    if (this.#kind.value === inForce.kind) this.#edited.delete("kind");
  }

  #drawParameters({ facts }) {
    const uses = this.#uses;
    for (const row of document.querySelectorAll("[data-parameter]")) {
      const name = row.dataset.parameter;
      row.hidden = !uses.includes(name);
      row.toggleAttribute("data-edited", this.#edited.has(name));
      const now = text(name, this.#inForce[name]) || PARAMETERS[name].none;
      row.querySelector(".parameter-unit").textContent = this.#edited.has(name) ? t("page.tuning.now", "in force: {now}", { now }) : (PARAMETERS[name].unit ?? "");
    }
    const unused = Object.keys(PARAMETERS).filter((name) => !uses.includes(name));
    write("unused", unused.length ? t("page.tuning.unused", "Not used by {kind}: {names}.", { kind: this.#kind.value, names: unused.map((name) => PARAMETERS[name].label).join(t("page.common.comma", ", ")) }) : "");
    const typed = Object.fromEntries([...this.#fields].map(([name, field]) => [name, read(name, field.value).value]));
    write("cost", cost(this.#kind.value, typed, facts.rate));
  }
}

function part(name) {
  return document.querySelector(`[data-tune="${name}"]`);
}

function write(name, words) {
  const element = part(name);
  if (element.textContent !== words) element.textContent = words;
}

function button(kind) {
  return document.querySelector(`[data-command="${kind}"]`);
}
