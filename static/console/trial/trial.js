// The Eval page: a trial is chosen, prepared and set up with one press, run, and scored.

import { post, RequestFailed } from "../../site/api.js";
import { uuid } from "../../site/identity.js";
import { config } from "../live/config.js";
import { PlanControls, times } from "./plan.js";
import { formatDuration } from "../live/labels.js";
import { t } from "../../site/sentences.js";

const OF_TRIALS = ["trial", "episode", "sight"];

export class TrialPanel {
  #store;
  #commands;
  #panel = document.getElementById("panel");
  #busy = ""; // name of the action under way
  #sent = {}; // the newest score, as JSON, and the uuid with which it was sent

  constructor(store, commands) {
    this.#store = store;
    this.#commands = commands;
    new PlanControls(store, commands, (name, work) => this.#do(name, work));
    document.addEventListener("click", (event) => this.#clicked(event));
    document.addEventListener("submit", (event) => this.#submitted(event));
    document.addEventListener("input", (event) => event.target.closest("#score") && this.draw());
    store.on(["snapshot", "second"], () => this.draw());
    store.on("changed", (what) => what.some((name) => OF_TRIALS.includes(name)) && this.refresh());
    document.body.addEventListener("htmx:afterSettle", () => this.draw());
    this.draw();
  }

  get #data() {
    return this.#panel.querySelector("#steps").dataset;
  }

  /** Fetch the fragment again. */
  refresh() {
    window.htmx.trigger(this.#panel, "eva:trial");
  }

  /** Draw what depends on the live state: which buttons are blocked and why, the run's clock, the bench's ground truth. */
  draw() {
    const { setUp, status, limit } = this.#data;
    const { snapshot } = this.#store;
    const prepare = this.#panel.querySelector("[data-prepare]");
    if (prepare) prepare.dataset.blocked = this.#panel.querySelector("#choose") ? "" : t("page.trial.nothing_to_choose", "nothing can be chosen yet: see step 1");
    for (const run of this.#panel.querySelectorAll("[data-needs-setup]")) {
      run.dataset.blocked = status !== "prepared" ? t("page.trial.choose_first", "choose and set up first") : setUp === "yes" ? "" : t("page.trial.set_up_first", "set up first");
    }
    scoreRule();
    this.#commands.gate();
    if (!snapshot) return;
    this.#clock(snapshot, Number(limit));
    for (const word of this.#panel.querySelectorAll("[data-truth]")) {
      const reached = snapshot.truth?.milestones?.[word.dataset.truth];
      word.textContent = reached === undefined ? "" : reached ? t("page.trial.reached", " · bench: reached") : t("page.trial.not_reached", " · bench: not reached");
    }
  }

  #clock({ run }, limit) {
    const clock = this.#panel.querySelector("[data-run-clock]");
    if (!clock) return;
    clock.hidden = run.number === 0;
    clock.querySelector('[data-show="run-time"]').textContent = formatDuration(run.elapsed);
    if (limit) clock.querySelector("progress").value = Math.min(run.elapsed, limit);
  }

  #clicked(event) {
    const button = event.target.closest("[data-prepare], [data-abandon], [data-void]");
    if (!button) return;
    if (button.getAttribute("aria-disabled") === "true") {
      this.#commands.say(button.title, "refused");
    } else if ("prepare" in button.dataset) {
      this.#do(t("page.trial.set_up", "Set up"), () => this.#prepare());
    } else if (button.dataset.abandon) {
      this.#do(t("page.trial.again", "Choose again"), () => post(`${config.trial}/${button.dataset.abandon}/abandon`, { reason: "chosen again" }));
    } else {
      this.#do(t("page.trial.void", "Void"), () => this.#void(button));
    }
  }

  #submitted(event) {
    if (event.target.closest("#choose")) event.preventDefault();
    const form = event.target.closest("#score");
    if (!form) return;
    event.preventDefault();
    const save = saveButton();
    if (save.getAttribute("aria-disabled") === "true") this.#commands.say(save.title, "refused");
    else this.#do(t("page.trial.save", "Save score"), () => this.#score(form));
  }

  /** Do one action at a time and show its outcome on the page. */
  async #do(name, act) {
    if (this.#busy) {
      this.#commands.say(t("page.common.not_yet", "{name}: not yet, {busy} is on its way", { name, busy: this.#busy }), "refused");
      return;
    }
    this.#busy = name;
    this.#commands.say(t("page.common.pressed", "{name}: pressed …", { name }), "pressed");
    try {
      const said = await act();
      if (said !== null) this.#commands.say(t("page.common.done", "{name}: done", { name }), "accepted");
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      this.#commands.fail(name, error);
    } finally {
      this.#busy = "";
      this.refresh();
    }
  }

  async #prepare() {
    const form = this.#panel.querySelector("#choose");
    const { scene, position, checkpoint, seed } = form.elements;
    if (!position?.value) throw new RequestFailed(t("page.trial.choose_position", "choose a position"), { status: 400 });
    const choice = { scene: scene.value, position: Number(position.value), checkpoint: checkpoint.value };
    if (seed?.value) choice.seed = Number(seed.value);
    const trial = await post(config.trials, choice);
    saved(form);
    await this.#commands.give("setup", {}, { trial: trial.id });
    return null; // the command has reported its outcome
  }

  async #score(form) {
    const milestones = {};
    for (const box of form.querySelectorAll('[name="milestone"]')) milestones[box.value] = box.checked;
    const { note, success } = form.elements;
    const score = { milestones, times: times(form), note: note.value, ...whyOf(form) };
    if (success) score.success = success.value === "yes";
    await post(`${config.trial}/${form.dataset.score}/score`, { ...score, uuid: this.#uuid(form.dataset.score, score) });
    saved(form);
  }

  /** Return the same uuid for the same score of a trial, so that Save adds no second score if the first answer was lost. */
  #uuid(trial, score) {
    const words = JSON.stringify([trial, score]);
    if (this.#sent.words !== words) this.#sent = { words, uuid: uuid() };
    return this.#sent.uuid;
  }

  async #void(button) {
    const form = button.closest("form");
    await post(`${config.trial}/${button.dataset.void}/void`, { reason: form.elements.void_reason.value });
    saved(form);
  }
}

function saved(form) {
  form.dispatchEvent(new Event("eva:saved", { bubbles: true }));
}

/** Return phase and cause of a failure as far as they are chosen; both are "" for a success. */
function whyOf(form) {
  const said = (name) => form.querySelector(`#why:not([hidden]) [name="${name}"]:checked`)?.value ?? "";
  return { failure_phase: said("failure_phase"), failure: said("failure") };
}

/** Return which required parts of the failure are not chosen yet, or "" if none. */
function unexplained(form) {
  const levels = [...form.querySelectorAll('#why[data-explained="yes"]:not([hidden]) fieldset')];
  const open = levels.filter((level) => !level.querySelector(":checked")).map((level) => level.querySelector("legend").textContent.toLowerCase());
  return open.length ? t("page.trial.unexplained", "choose the {levels} of the failure", { levels: open.join(t("page.trial.and_the", " and the ")) }) : "";
}

function saveButton() {
  return document.querySelector('[type="submit"][form="score"]');
}

/** Show what the ticks amount to, and why they cannot be saved yet; a success is not asked for the causes of a failure. */
function scoreRule() {
  const form = document.getElementById("score");
  if (!form) return;
  const required = [...form.querySelectorAll('[data-required="yes"]')];
  const choice = form.elements.success;
  const said = () => (choice.value === "" ? null : choice.value === "yes");
  const fails = form.querySelector("[data-fails]") !== null;
  const success = fails ? false : required.length ? required.every((box) => box.checked) : said();
  const verdict = form.querySelector(".verdict");
  const means = !fails && required.length > 0 && success === false;
  const criterion = form.querySelector("[data-criterion]");
  if (criterion) criterion.hidden = means;
  const wanted = criterion?.textContent || required.map((box) => box.dataset.text).join(", ");
  if (success === null) verdict.textContent = t("page.trial.success_or_not", "Success? Say yes or no.");
  else if (means) verdict.textContent = t("page.trial.means", "Success means: {wanted}", { wanted });
  else verdict.textContent = success ? t("page.trial.success", "Success") : t("page.trial.no_success", "No success");
  verdict.dataset.verdict = String(success);
  const why = form.querySelector("#why");
  if (why) why.hidden = success !== false;
  saveButton().dataset.blocked = success === null ? t("page.trial.say_success", "say whether it was a success") : unexplained(form);
}
