// The Collect page: sessions are opened and resumed, episodes armed, recorded, labelled and discarded; it shows the queue and
// the dataset.

import { config } from "../console/live/config.js";
import { post, RequestFailed } from "../site/api.js";
import { otherPresses } from "../site/presses.js";
import { ARM_FIRST, armText, primaryAction, discardArguments, leaderText, labelTarget, Twice, discardProblem, labelProblem, startProblem } from "./actions.js";
import { gamepads } from "./pads.js";
import { t } from "../site/sentences.js";

const SETTLE_MS = 600; // time [ms] for which a Start that replaced Stop ignores presses, which may be meant for Stop
const REST_MS = 10000; // longest wait for the robot to come to rest before a new recording [ms]
const QUEUE_MS = 2000;
const OF_SESSIONS = ["collect", "episode", "job"];
const [OPEN, PUBLISH] = [t("page.collect.open", "Open"), t("page.collect.publish", "Publish")];
const ACTS = {
  setup: t("page.collect.act_setup", "setup"),
  arm: t("page.collect.act_arm", "arm"),
  big: t("page.collect.act_big", "big"),
  discard: t("page.collect.act_discard", "discard"),
  rerecord: t("page.collect.act_rerecord", "rerecord"),
  label: t("page.collect.act_label", "label"),
  open: t("page.collect.act_open", "open"),
  close: t("page.collect.act_close", "close"),
  resume: t("page.collect.act_resume", "resume"),
  publish: t("page.collect.act_publish", "publish"),
  retry: t("page.collect.act_retry", "retry"),
};
const RESULTS = {
  success: t("page.collect.success", "success"),
  partial: t("page.collect.partial", "partial"),
  fail: t("page.collect.fail", "fail"),
};

export class CollectPanel {
  #store;
  #commands;
  #busy = "";
  #twice = new Twice(() => this.#commands.say(t("page.collect.forgotten", "Not pressed again: nothing was done"), "pressed"));
  #seen = ""; // the newest episode that this page knows
  #closed = ""; // the newest episode that is on disk
  #older = ""; // episode after which Start was pressed without effect, so that it is not the newest attempt
  #kind = "run";
  #changed = -Infinity;
  #drawnQueue = 0;

  constructor(store, commands) {
    this.#store = store;
    this.#commands = commands;
    document.addEventListener("click", (event) => this.#clicked(event));
    document.addEventListener("submit", (event) => event.target.matches("#open-session, #publish") && event.preventDefault());
    document.addEventListener("change", ({ target }) => target.id === "session-tasks" && this.#picked(target));
    store.on(["snapshot", "second"], () => this.draw());
    document.body.addEventListener("htmx:afterSettle", () => this.draw());
    store.on("second", () => this.#follow());
    store.on("changed", (what) => what.some((name) => OF_SESSIONS.includes(name)) && this.refresh());
    otherPresses((target) => target.closest?.("[data-collect]"), () => this.#unasked()); // added before the listener for a pedal's keys
    gamepads((action) => this.#pressed(action));
    this.draw();
  }

  /** Uuid of the open session, or "". */
  get session() {
    return document.querySelector("[data-session-uuid]")?.dataset.sessionUuid ?? "";
  }

  /** Fetch both fragments again. */
  refresh() {
    for (const id of ["session", "progress"]) window.htmx.trigger(`#${id}`, "eva:collect");
  }

  /** Refresh the queue while the worker is busy: its progress changes without any change in the database. */
  #follow() {
    if (!document.querySelector('[data-queue="active"]') || performance.now() - this.#drawnQueue < QUEUE_MS) return;
    this.#drawnQueue = performance.now();
    window.htmx.trigger("#progress", "eva:collect");
  }

  // --- what is shown -------------------------------------------------------------------------------------------

  draw() {
    const { snapshot } = this.#store;
    const { collect } = snapshot ?? {};
    this.#notice(collect);
    this.#twice.about(this.#asked);
    document.getElementById("collects-nothing").hidden = !snapshot || Boolean(collect);
    const task = document.querySelector("[data-session-uuid]")?.dataset.task;
    write("prompt", task ? `“${task}”` : t("page.collect.no_session", "No session is open."));
    write("armed", armText(snapshot ?? {}));
    const { text, weight } = leaderText(collect);
    write("leader", text);
    show("leader").dataset.weight = weight;
    this.#drawArm(collect);
    this.#drawBig(snapshot);
    this.#drawEpisode(snapshot ?? {}, collect);
    for (const button of document.querySelectorAll('[data-collect="setup"]')) button.dataset.blocked = this.session ? "" : t("page.collect.open_first", "open or resume a session first");
    this.#commands.gate();
  }

  /** Keep track of the newest episode: the open one, until another one is closed. */
  #notice(collect) {
    const closed = collect?.last?.uuid ?? "";
    if (collect?.episode) this.#seen = collect.episode;
    else if (closed !== this.#closed) this.#seen = closed;
    this.#closed = closed;
  }

  #drawArm(collect) {
    const button = document.getElementById("arm");
    button.setAttribute("aria-checked", String(Boolean(collect?.armed)));
    button.dataset.gate = collect?.armed ? "disarm" : "arm";
    button.dataset.blocked = collect?.armed || !collect ? "" : this.session ? (collect.set_up ? "" : t("page.collect.set_up_first", "set up first")) : t("page.collect.open_first", "open or resume a session first");
    write("arm", collect?.armed ? t("page.collect.armed", "Armed") : t("page.collect.arm", "Arm"));
  }

  #drawBig(snapshot) {
    const button = document.getElementById("big");
    const { kind, text } = primaryAction(snapshot ?? {});
    if (kind !== this.#kind) {
      this.#kind = kind;
      this.#changed = performance.now();
      setTimeout(() => this.draw(), SETTLE_MS + 20);
    }
    button.toggleAttribute("data-settling", kind === "run" && performance.now() - this.#changed < SETTLE_MS);
    button.dataset.gate = kind;
    button.dataset.blocked = kind === "run" ? startProblem(snapshot, this.session) : "";
    button.classList.toggle("button-halt", kind === "stop");
    button.classList.toggle("button-primary", kind === "run");
    write("big", text);
  }

  #drawEpisode(snapshot, collect) {
    const episode = labelTarget(collect, this.#seen);
    const said = collect?.last?.uuid === episode ? collect.last : null;
    const busy = this.#busy === "rerecord" ? t("page.collect.rest_first", "the robot comes to rest first") : "";
    for (const button of document.querySelectorAll('[data-collect="label"]')) {
      button.dataset.blocked = labelProblem(snapshot, episode);
      button.setAttribute("aria-pressed", String(said?.result === button.dataset.result && !said.discarded));
    }
    for (const name of ["discard", "rerecord"]) {
      document.querySelector(`[data-collect="${name}"]`).dataset.blocked = busy || discardProblem(snapshot, episode);
      document.querySelector(`[data-collect="${name}"]`).toggleAttribute("data-asks", this.#twice.asks(name));
    }
    write("discard", this.#twice.asks("discard") ? t("page.collect.again_discard", "Again: discard") : t("page.collect.discard", "Discard"));
    write("rerecord", this.#twice.asks("rerecord") ? t("page.collect.again_rerecord", "Again: re-record") : t("page.collect.rerecord", "Re-record"));
    write("result", collect?.episode ? t("page.collect.recording", "recording") : said ? (said.discarded ? t("page.collect.discarded", "discarded") : said.result ? "" : t("page.collect.how", "how did it go?")) : "");
  }

  // --- what is pressed -----------------------------------------------------------------------------------------

  #picked(select) {
    if (!select.value) return;
    const field = document.getElementById("session-task");
    field.value = select.value;
    field.dispatchEvent(new Event("input", { bubbles: true })); // saves it as a draft
    select.value = "";
  }

  /** Click the button that belongs to a gamepad's action. */
  #pressed(action) {
    const place = ["success", "partial", "fail"].includes(action) ? `[data-result="${action}"][data-collect]` : `[data-collect="${action}"]`;
    document.querySelector(place)?.click();
  }

  /** Drop the open question, because something other than these buttons was pressed. */
  #unasked() {
    this.#twice.clear();
    this.draw();
  }

  #clicked(event) {
    const button = event.target.closest("[data-collect]");
    if (!button) return;
    const { collect: what, result } = button.dataset;
    this.#twice.about(this.#asked);
    if (!this.#twice.asks(result ?? what)) this.#twice.clear();
    if (what === "big" && this.#kind === "run" && !("settling" in button.dataset)) this.#older = this.#episode;
    if (button.getAttribute("aria-disabled") === "true") {
      this.#commands.say(t("page.common.why", "{name}: {why}", { name: nameOf(button), why: button.title }), "refused");
      return;
    }
    const stops = what === "big" && this.#kind === "stop";
    if (this.#busy && !stops) this.#commands.say(t("page.common.not_yet", "{name}: not yet, {busy} is on its way", { name: nameOf(button), busy: ACTS[this.#busy] ?? this.#busy }), "refused");
    else this.#do(what, button);
  }

  async #do(what, button) {
    const acts = {
      setup: () => this.#give("setup", this.#bench()),
      arm: () => this.#commands.give(button.dataset.gate),
      big: () => (this.#kind === "stop" ? this.#commands.give("stop") : this.#start()),
      discard: () => this.#discard(),
      rerecord: () => this.#rerecord(),
      label: () => this.#label(button.dataset.result),
      open: () => this.#ask(OPEN, config.sessions, opening()),
      close: () => this.#ask(t("page.collect.close", "Close"), `${config.session}/${this.session}/close`),
      resume: () => this.#ask(t("page.collect.resume", "Resume"), `${config.session}/${document.getElementById("session-earlier").value}/resume`),
      publish: () => this.#ask(PUBLISH, `${config.session}/${this.session}/publish`, publishing()),
      retry: () => this.#ask(t("page.collect.retry", "Retry"), `${config.jobs}/${button.dataset.job}/retry`),
    };
    const before = this.#busy;
    this.#busy = what;
    if (document.activeElement?.matches("#seed, #open-session input")) document.activeElement.blur(); // frees the keys again
    try {
      await acts[what]();
    } finally {
      this.#busy = before;
      this.draw();
    }
  }

  get #episode() {
    return labelTarget(this.#store.snapshot?.collect, this.#seen);
  }

  /** What a question is about: session, episode, and whether that is discarded already. */
  get #asked() {
    return [this.session, this.#episode, discardProblem(this.#store.snapshot ?? {}, this.#episode)].join();
  }

  #give(kind, args = {}) {
    return this.#commands.give(kind, args, { session: this.session });
  }

  #bench() {
    const seed = document.getElementById("seed");
    return seed && seed.value !== "" ? { bench: { seed: seed.valueAsNumber } } : {};
  }

  async #start() {
    const answer = await this.#give("run");
    if (answer?.data?.episode) this.#seen = answer.data.episode;
    return answer;
  }

  /** Label the newest attempt; if the last Start had no effect, ask once before the previous episode is labelled. */
  async #label(result) {
    const episode = this.#episode;
    if (episode && episode === this.#older && !this.#twice.press(result)) {
      this.#commands.say(t("page.collect.label_again", "{result}: the last start did not take; press again to label the episode before it", { result: RESULTS[result] ?? result }), "pressed");
      return;
    }
    if (await this.#commands.give("label", { episode, result })) this.#older = "";
  }

  async #discard() {
    if (!this.#twice.press("discard")) {
      this.#commands.say(t("page.collect.discard_again", "Discard: press again to discard the episode; its files stay, it is never published"), "pressed");
      return;
    }
    await this.#commands.give("discard", discardArguments(this.#store.snapshot?.collect, this.#episode));
  }

  async #rerecord() {
    if (!this.#twice.press("rerecord")) {
      this.#commands.say(t("page.collect.rerecord_again", "Re-record: press again to discard the episode and start the next at once"), "pressed");
      return;
    }
    this.draw();
    const answer = await this.#commands.give("discard", discardArguments(this.#store.snapshot?.collect, this.#episode));
    if (!answer) return;
    const why = await this.#rested();
    if (why) this.#commands.say(t("page.collect.rerecord_not_started", "Re-record: discarded, not started: {why}", { why }), "refused");
    else await this.#start();
  }

  /** Wait until an episode can start; resolve to why it cannot, or to "". */
  async #rested() {
    const until = performance.now() + REST_MS;
    let why = "";
    while (performance.now() < until) {
      const { snapshot } = this.#store;
      why = startProblem(snapshot, this.session) || this.#commands.reason("run");
      const open = Boolean(snapshot?.collect?.episode) || snapshot?.state_is.going;
      if (!open && !why) return "";
      if (!open && !snapshot?.state_is.held && why === ARM_FIRST) return snapshot.collect.why_not || why;
      await new Promise((resolve) => setTimeout(resolve, 50));
    }
    return why || t("page.collect.not_at_rest", "the robot is not at rest");
  }

  /** Send one request to the web server and show its outcome on the page. */
  async #ask(name, address, content = {}) {
    this.#commands.say(t("page.common.pressed", "{name}: pressed …", { name }), "pressed");
    try {
      await post(address, content);
      this.#commands.say(name === PUBLISH ? t("page.collect.publish_asked", "Publish: asked for; the queue below shows how far it is") : t("page.common.done", "{name}: done", { name }), "accepted");
      const form = name === OPEN && document.getElementById("open-session");
      if (form) form.dispatchEvent(new Event("eva:saved", { bubbles: true }));
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      this.#commands.fail(name, error);
    } finally {
      this.refresh();
    }
  }
}

function opening() {
  const { task, dataset, target } = document.getElementById("open-session").elements;
  return { task: task.value, dataset: dataset.value.trim(), target: target.value === "" ? null : target.valueAsNumber };
}

function publishing() {
  const { failures, version } = document.getElementById("publish").elements;
  return { results: ["success", "partial", ...(failures?.checked ? ["fail"] : [])], version: version.disabled ? "" : version.value };
}

function show(name) {
  return document.querySelector(`[data-collect-show="${name}"]`);
}

/** Return a button's name without its key. */
function nameOf(button) {
  return button.textContent.replace(/\s+\S+$/, "").trim();
}

function write(name, text) {
  const element = show(name);
  if (element.textContent !== text) element.textContent = text;
}
