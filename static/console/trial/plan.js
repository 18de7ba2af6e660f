// Trials of a plan: handed out one by one, given back with a reason, cameras confirmed, milestones ticked during the run.

import { post, RequestFailed } from "../../site/api.js";
import { config } from "../live/config.js";
import { t } from "../../site/sentences.js";

const PRESSED = "[data-next], [data-return], [data-give-back], [data-confirm-cameras], [data-override], [data-take-reference]";

/** Carries out what is pressed in the panel; `act(name, work)` does one thing at a time and reports its outcome. */
export class PlanControls {
  #store;
  #commands;
  #act;

  constructor(store, commands, act) {
    this.#store = store;
    this.#commands = commands;
    this.#act = act;
    document.addEventListener("click", (event) => this.#clicked(event));
    document.addEventListener("change", (event) => event.target.closest("#live") && this.#ticked(event.target));
    document.body.addEventListener("htmx:afterSettle", stamps);
    stamps();
  }

  #clicked(event) {
    const button = event.target.closest(PRESSED);
    if (!button) return;
    const { next, giveBack, confirmCameras, override, scene, position } = button.dataset;
    if (button.getAttribute("aria-disabled") === "true") this.#commands.say(button.title, "refused");
    else if (next) this.#act(t("page.plan.next", "Next trial"), () => this.#next(next));
    else if (button.dataset.return) this.#act(t("page.plan.return", "Return"), () => post(`${config.trial}/${button.dataset.return}/abandon`, { reason: why("return-why") }));
    else if (giveBack) this.#act(t("page.plan.give_back", "Give trials to others"), () => post(`${config.plans}/${giveBack}/give-back`, { station: config.station, reason: why("back-why") }));
    else if (confirmCameras !== undefined) this.#act(t("page.plan.cameras", "Cameras"), () => post(config.cameras_confirmed, { first: confirmCameras === "first" }));
    else if (override) this.#act(t("page.plan.accepted", "Bench accepted"), () => post(`${config.trial}/${override}/achieved`, { override: why("override-why") }));
    else this.#act(t("page.plan.reference", "Reference taken"), () => post(config.references, { scene, position: Number(position) }));
  }

  async #next(plan) {
    const { trial } = await post(`${config.plans}/${plan}/next`, { station: config.station });
    await this.#commands.give("setup", {}, { trial: trial.id });
    return null; // the command has reported its outcome
  }

  /** Give a ticked milestone the time of the run; refuse it if it is too late, or if an ordered form lacks an earlier one. */
  #ticked(box) {
    const form = box.form;
    const at = this.#store.snapshot?.run.elapsed ?? Number.NaN;
    const boxes = [...form.querySelectorAll('[name="milestone"]')];
    const earlier = boxes.slice(0, boxes.indexOf(box)).some((other) => !other.checked);
    if (box.checked && box.dataset.limit && at > Number(box.dataset.limit)) this.#untick(box, t("page.plan.late", "after its {limit} s it does not count", { limit: box.dataset.limit }));
    else if (box.checked && form.dataset.ordered && earlier) this.#untick(box, t("page.plan.order", "those before it come first"));
    form.elements[`at-${box.value}`].value = box.checked && Number.isFinite(at) ? at.toFixed(1) : "";
    stamps();
    form.dispatchEvent(new Event("input", { bubbles: true })); // saves the time in the draft too
  }

  #untick(box, reason) {
    box.checked = false;
    this.#commands.say(t("page.plan.not_ticked", "Not ticked: {reason}", { reason }), "refused");
  }
}

/** Return the times of a score form, milestone id -> seconds, for milestones that are ticked and whose time is known. */
export function times(form) {
  const found = {};
  for (const box of form.querySelectorAll('[name="milestone"]')) {
    const at = form.elements[`at-${box.value}`]?.value;
    if (box.checked && at) found[box.value] = Number(at);
  }
  return found;
}

function stamps() {
  for (const place of document.querySelectorAll("#live [data-at]")) {
    const at = place.closest("form").elements[`at-${place.dataset.at}`].value;
    place.textContent = at ? t("page.plan.at", " at {at} s", { at }) : "";
  }
}

function why(id) {
  const reason = document.getElementById(id).value.trim();
  if (!reason) throw new RequestFailed(t("page.plan.say_why", "say why, for those who read it later"), { status: 400 });
  return reason;
}
