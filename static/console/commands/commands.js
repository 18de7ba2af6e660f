// Commands from button to answer: shown as pressed at once, then as accepted, done, refused with the reason, or outcome
// unknown.

import { post, RequestFailed } from "../../site/api.js";
import { uuid } from "../../site/identity.js";
import { otherPresses } from "../../site/presses.js";
import { config } from "../live/config.js";
import { Asking } from "./asking.js";
import { pageProblem } from "./reasons.js";
import { answered, STOPPING, Stops } from "./stops.js";
import { commandLabel } from "../live/labels.js";
import { t } from "../../site/sentences.js";

const STATUS = { accepted: t("page.commands.accepted", "accepted"), done: t("page.commands.done", "done") };
const AT_THE_DESK = ["score", "session"]; // commands that need no robot
const STOP_ADVICE = t("page.commands.stop_advice", "Press it again; if the robot still moves, press E-STOP.");

/** Sends commands, reports their outcome, and shows which commands can be given now. */
export class Commands {
  #store;
  #pending = new Set();
  #givers = new Map(); // kind -> function that returns the arguments of a command
  #stops;
  #newest = new Map(); // kind of stop command -> uuid of its last press
  #unknown = ""; // uuid of the stop whose unknown outcome is shown
  #asking = null; // the Resume command that is being retried
  #told = 0; // number of messages shown so far

  constructor(store, socket, way) {
    this.#store = store;
    this.#stops = new Stops({
      send: (message) => socket.send(message),
      beside: (command) => way.post(command),
      post: (command) => post(config.api.commands, command),
      late: (ack) => this.#late(ack),
    });
    store.on("ack", (ack) => ack.kind !== "estop" && this.acknowledged(ack));
    document.addEventListener("click", (event) => this.#clicked(event));
    otherPresses((target) => target.closest?.('[data-command="resume"]'), () => this.#askNoMore());
    store.on(["snapshot", "link", "open", "second"], () => this.gate());
    for (const moment of ["htmx:afterSwap", "htmx:afterSettle"]) document.body.addEventListener(moment, () => this.gate());
    this.gate();
  }

  /** Let `args()` provide the arguments of every command `kind` that is pressed on this page. */
  provide(kind, args) {
    this.#givers.set(kind, args);
  }

  /**
   * Send one command; if given, it names a trial, a session, an episode to replay, or the id of a checkpoint. Resolve to the
   * answer, or to null if it was not accepted; the page then shows why.
   */
  async give(kind, args = {}, { trial = null, checkpoint = "", session = "", replay = null } = {}) {
    const name = commandLabel(kind);
    let told = 0; // value of #told when this press last showed a message
    const own = (words) => {
      this.say(t("page.common.why", "{name}: {why}", { name, why: words }), "pressed");
      told = this.#told;
    };
    own(t("page.commands.pressed", "pressed …"));
    const command = { uuid: uuid(), kind, args, page: this.#store.page, epoch: this.#store.epoch };
    Object.assign(command, { boot: this.#store.snapshot?.boot ?? "", sequence: this.#store.snapshot?.sequence ?? 0 });
    if (trial) command.trial = Number(trial);
    if (checkpoint) command.checkpoint = Number(checkpoint);
    if (session) command.session = session;
    if (replay) command.replay = replay;
    const stops = STOPPING.includes(kind);
    if (stops) this.#newest.set(kind, command.uuid);
    try {
      const answer = await (stops ? this.#stops.give(command) : kind === "resume" ? this.#ask(command, own) : post(config.api.commands, command));
      if (!answer) return null; // another press ended this one and reported it
      // A success must not replace the message why a later press was refused.
      const later = this.#told !== told && ["refused", "unknown"].includes(document.getElementById("outcome").dataset.kind);
      if (stops ? this.#newest.get(kind) === command.uuid : !later) this.say(t("page.common.why", "{name}: {why}", { name, why: STATUS[answer.status] ?? answer.status }), "accepted");
      return answer;
    } catch (error) {
      this.fail(name, error, stops ? STOP_ADVICE : undefined);
      if (stops && error.unknown) this.#unknown = command.uuid;
      return null;
    }
  }

  /** Send a command that is repeated while a process of the station is starting. */
  async #ask(command, own) {
    const { boot, sequence, epoch } = command;
    const holds = () => {
      const { fresh, lease, snapshot } = this.#store;
      return fresh && lease === "mine" && this.#store.epoch === epoch && snapshot.boot === boot && snapshot.sequence === sequence;
    };
    this.#asking = new Asking({ holds, waits: (process) => own(t("page.commands.waiting", "waiting for the process {process}, trying again …", { process })) });
    // Each attempt has its own uuid: the station answers a uuid that it knows with the first answer.
    return this.#asking.answer(() => post(config.api.commands, { ...command, uuid: uuid() }));
  }

  /** Stop retrying Resume because something else was pressed. */
  #askNoMore() {
    const refused = this.#asking?.end();
    if (refused) this.fail(commandLabel("resume"), refused);
  }

  /** Take in the acknowledgement of a stop or pause from the socket. */
  acknowledged(ack) {
    this.#stops.acknowledged(ack);
  }

  /**
   * Show an answer that came after the page had given up or had been answered by POST, but only if the page still shows this
   * command's outcome as unknown.
   */
  #late(ack) {
    if (ack.uuid !== this.#unknown) return;
    const name = commandLabel(ack.kind);
    try {
      this.say(t("page.commands.late", "{name}: {status}, answered late", { name, status: STATUS[answered(ack).status] ?? answered(ack).status }), "accepted");
    } catch (error) {
      this.fail(name, error, STOP_ADVICE);
    }
  }

  /** Show what went wrong with the command `name`; if its outcome is unknown, also show `advice`. */
  fail(name, error, advice = t("page.commands.look_first", "Look at the state before you repeat it.")) {
    if (!(error instanceof RequestFailed)) throw error;
    if (error.unknown) this.say(t("page.commands.unknown", "{name}: outcome unknown. {why}. {advice}", { name, why: error.message, advice }), "unknown");
    else if (error.body.status === "failed") this.say(t("page.commands.failed", "{name} failed: {why}", { name, why: error.message }), "refused");
    else this.say(t("page.commands.refused", "{name} refused: {why}", { name, why: error.message }), "refused");
  }

  /** Show an answer in the page's one line for them. */
  say(text, kind) {
    const line = document.getElementById("outcome");
    this.#told += 1;
    this.#unknown = "";
    line.textContent = text;
    line.dataset.kind = kind;
  }

  /**
   * Return why a score cannot be saved, or a session changed, now, or "". Neither needs a robot, but nobody else may command
   * the station.
   */
  #deskReason() {
    const { role, fresh, lease } = this.#store;
    if (role === "viewer") return t("page.reasons.viewer", "a viewer watches; an administrator can make you an operator");
    return fresh && lease === "other" ? t("page.reasons.other", "someone else commands the station; ask for it") : "";
  }

  /** Return why `kind` cannot be given now, or "" if it can. */
  reason(kind) {
    return pageProblem(kind, this.#store);
  }

  /** Enable or disable every button that gives a command; a disabled button shows the reason. */
  gate() {
    for (const button of document.querySelectorAll("[data-command], [data-gate]")) {
      try {
        this.#gateOne(button);
      } catch (error) {
        reportError(error); // an error at one button must not keep Stop disabled
      }
    }
  }

  #gateOne(button) {
    const kind = button.dataset.command ?? button.dataset.gate;
    const own = "settling" in button.dataset ? t("page.commands.just_come", "it has just come up: look, then press again") : (button.dataset.blocked ?? "");
    setReason(button, own || (AT_THE_DESK.includes(kind) ? this.#deskReason() : this.reason(kind)));
    if (button.dataset.onlyWhile) button.hidden = !this.#store.snapshot?.state_is[button.dataset.onlyWhile];
  }

  async #clicked(event) {
    const button = event.target.closest("[data-command]");
    if (!button) return;
    const { command: kind, trial, checkpoint, replay } = button.dataset;
    if (button.getAttribute("aria-disabled") === "true") {
      this.say(t("page.common.why", "{name}: {why}", { name: commandLabel(kind), why: button.title }), "refused");
      return;
    }
    if (this.#pending.has(kind) && !STOPPING.includes(kind)) {
      this.say(t("page.commands.pressed_already", "{name}: pressed already, and not answered yet", { name: commandLabel(kind) }), "pressed");
      return;
    }
    this.#pending.add(kind);
    button.dataset.pressed = "";
    const beside = { trial, checkpoint: checkpoint && document.querySelector(checkpoint).value, replay: replay && JSON.parse(replay) };
    await this.give(kind, { ...this.#givers.get(kind)?.(), ...argsOf(button) }, beside);
    delete button.dataset.pressed;
    this.#pending.delete(kind);
  }
}

/** Disable a button with a reason, or enable it if the reason is "". */
export function setReason(button, reason) {
  const disabled = String(Boolean(reason));
  if (button.getAttribute("aria-disabled") !== disabled) button.setAttribute("aria-disabled", disabled);
  if (button.title !== reason) button.title = reason;
}

/**
 * Return a button's own arguments: data-args as JSON, and the values of fields, named by data-arg-NAME="selector". An empty
 * field is left out.
 */
function argsOf(button) {
  const args = JSON.parse(button.dataset.args ?? "{}");
  for (const { name, value } of button.attributes) {
    if (!name.startsWith("data-arg-")) continue;
    const field = document.querySelector(value);
    if (field.value.trim() === "") continue;
    args[name.slice("data-arg-".length)] = field.type === "number" ? field.valueAsNumber : field.value.trim();
  }
  return args;
}
