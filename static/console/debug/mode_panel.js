// The step "Run" of the Debug page: the mode, the one primary button, and what the run is doing.

import { distanceText, buttonLabels, MODES, phaseText, primaryCommand, proposed, SIM_INPUTS, shown } from "./modes.js";
import { t } from "../../site/sentences.js";

const SETTLE_MS = 600; // Time [ms] for which a button that replaced another ignores presses, which may be meant for the previous one.
const POLICY_MODES = ["sim", "step", "preview", "continuous"];

export class ModePanel {
  #store;
  #commands;
  #form = document.getElementById("mode");
  #chosen = "";
  #primary = "run";
  #changed = -Infinity;

  /** `picked(mode)` is called when the user chooses a mode. */
  constructor(store, commands, picked) {
    this.#store = store;
    this.#commands = commands;
    this.#chosen = this.#form.elements.mode.value; // as restored from a draft
    this.#form.addEventListener("submit", (event) => event.preventDefault());
    this.#form.addEventListener("change", (event) => this.#choose(event));
    // also when the chosen mode is clicked again
    this.#form.addEventListener("click", ({ target }) => target.name === "mode" && picked(target.value));
    part("seen").addEventListener("change", () => this.draw());
    commands.provide("run", () => this.#runs());
    store.on(["snapshot", "second"], () => this.draw());
    this.draw();
  }

  /** The mode that is shown: that of the open run, or of the next one. */
  get mode() {
    return this.#form.elements.mode.value;
  }

  #choose({ target }) {
    if (target.name === "mode") this.#chosen = target.value;
    this.draw();
  }

  #runs() {
    const mode = this.mode;
    return mode === "sim" ? { mode, sim_state: this.#form.elements.sim_state.value } : { mode };
  }

  draw() {
    const { snapshot } = this.#store;
    const open = Boolean(snapshot?.run?.number);
    const offered = snapshot?.facts?.modes;
    const mode = shown({ open, mode: snapshot?.mode, offered }, this.#chosen);
    this.#drawChoice(mode, open, offered);
    this.#drawPrimary(snapshot ?? {}, mode);
    write("line", MODES[mode] ?? "");
    write("phase", snapshot && this.#store.fresh ? phaseText({ ...snapshot, rate: snapshot.facts?.rate }) : "");
    this.#drawNote(snapshot, mode, open);
    this.#drawFar(snapshot, mode, open);
  }

  #drawChoice(mode, open, offered) {
    for (const radio of this.#form.elements.mode) {
      radio.checked = radio.value === mode;
      refuse(radio, open ? t("page.modes.run_open", "the run is open: stop it first") : offered && !offered.includes(radio.value) ? t("page.modes.no_mode", "this station has no such mode") : "");
    }
    part("seen").hidden = mode !== "sim" || open; // while it runs, the note says this
    for (const radio of this.#form.elements.sim_state) {
      if (open && mode === "sim") radio.checked = radio.value === this.#store.snapshot.sim_state;
      refuse(radio, open ? t("page.modes.run_open", "the run is open: stop it first") : "");
    }
  }

  #drawPrimary(snapshot, mode) {
    const now = primaryCommand({ ...snapshot, mode });
    if (now !== this.#primary) {
      this.#primary = now;
      this.#changed = performance.now();
      setTimeout(() => this.draw(), SETTLE_MS + 20);
    }
    const settling = performance.now() - this.#changed < SETTLE_MS;
    for (const button of document.querySelectorAll("[data-primary]")) {
      button.hidden = button.dataset.primary !== now;
      button.toggleAttribute("data-settling", settling);
    }
    for (const [name, text] of Object.entries(buttonLabels(mode))) write(name, text);
    this.#commands.gate();
  }

  #drawNote(snapshot, mode, open) {
    const running = open && this.#store.fresh;
    let text = "";
    if (running && mode === "sim") text = t("page.modes.simulated", "Simulated: the real robot holds still. {seen}", { seen: SIM_INPUTS[snapshot.sim_state] ?? "" });
    else if (running && mode === "preview") text = proposed(snapshot.proposal);
    write("note", text);
    part("note").hidden = !text;
    part("note").dataset.kind = mode;
  }

  /** Warn about a first action far from the present pose, and offer a choice. */
  #drawFar(snapshot, mode, open) {
    const proposal = open && mode === "preview" ? snapshot.proposal : null;
    const before = !open && snapshot?.state_is.ready && POLICY_MODES.includes(mode) && mode !== "sim" ? snapshot.first_action : null;
    const far = [proposal, before].find((one) => one?.far);
    part("far").hidden = !far;
    if (far) write("far-text", proposal ? t("page.modes.chunk_far", "This chunk begins {distance}.", { distance: distanceText(far) }) : t("page.modes.action_far", "The policy's first action is {distance}: approach it on a limited path first, or run from here.", { distance: distanceText(far) }));
  }
}

function part(name) {
  return document.querySelector(`[data-mode="${name}"]`);
}

function write(name, text) {
  const element = part(name);
  if (element.textContent !== text) element.textContent = text;
}

function refuse(radio, reason) {
  radio.disabled = Boolean(reason);
  const label = radio.closest("label");
  if (label.title !== reason) label.title = reason;
}
