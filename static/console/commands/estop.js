// The software e-stop: a button that never moves, Escape, and Space. While the robot is idle, ready or already stopped, Space
// goes to the control that has the focus.
// Escape closes an open dialog or menu, and presses the e-stop unless it has closed one while the robot is certainly at rest.
// The e-stop waits for nothing: it is sent over the socket and to the process for stops at once, under one uuid, which the
// station carries out once. If the socket is closed or neither answers, it is posted to the web server as well; if nothing
// answers, the page says so in red letters. estop_state.js decides what is shown.

import { post } from "../../site/api.js";
import { uuid } from "../../site/identity.js";
import { config } from "../live/config.js";
import { EStopState } from "./estop_state.js";
import { t } from "../../site/sentences.js";

const ACK_MS = 500;
const ASK_MS = 5000;
const CONTROLS = 'input, textarea, select, button, summary, [contenteditable="true"]'; // keys.js takes the focus away from controls that were clicked
const AT_REST = ["idle", "ready"];
// Prepared at load, so that no press waits for a translation.
const UNACKNOWLEDGED = t("page.estop.unacknowledged", "the software stop was not acknowledged");
const OPEN = "dialog[open], details[open]:has(> .float)";
const WORDS = {
  pressed: { kind: "pressed", text: t("page.estop.pressed", "E-stop pressed …") },
  failed: { kind: "failed", text: t("page.estop.failed", "USE THE HARDWARE STOP") },
  held: { kind: "stopped", text: t("page.estop.held", "E-stop acknowledged: the robot is held.") },
  latched: { kind: "stopped", text: t("page.estop.latched", "E-stop is latched.") },
};

const now = () => performance.now() / 1000;

export class EStop {
  #socket;
  #store;
  #way;
  #presses = new Map(); // uuid -> {ways: requests under way, left: addresses not tried yet, why, reason, timer}
  #state = new EStopState();
  #drawn = "";
  #again = 0; // timer of the next request to the process for stops
  #early = ""; // what the early script last reported of its press
  #note = document.getElementById("estop-note");
  #area = document.getElementById("estop-area");
  #rest = this.#note.dataset.rest;

  constructor(store, socket, way) {
    this.#store = store;
    this.#socket = socket;
    this.#way = way;
    document.getElementById("estop").addEventListener("click", () => this.press("button"));
    window.addEventListener("keydown", (event) => this.#key(event), { capture: true });
    window.addEventListener("keyup", (event) => this.#keyUp(event), { capture: true });
    this.#heed();
    store.on("open", () => store.open && this.ask());
    store.on("ack", (ack) => ack.kind === "estop" && this.acknowledged(ack));
    store.on("snapshot", () => this.#news());
    this.ask();
    this.#area.dataset.ready = ""; // from here on estop_early.js does nothing
    startedAfterAll(document.getElementById("outcome"));
  }

  /** Make the process for stops know this user before anything is pressed; repeat until it answers, as it may be starting. */
  async ask() {
    clearTimeout(this.#again);
    const there = await this.#way.ask();
    this.#area.toggleAttribute("data-second-way", there);
    clearTimeout(this.#again); // timer of a concurrent call, such as when the socket was opened meanwhile
    if (!there) this.#again = setTimeout(() => this.ask(), ASK_MS);
  }

  /** Press the e-stop; `why` names what was pressed. */
  press(why) {
    const id = uuid();
    this.#heed();
    this.#state.pressed(id, now());
    const press = { ways: 0, left: new Set([config.api.estop]), why: `${why} on the page`, reason: "" };
    this.#presses.set(id, press);
    this.#show();
    press.timer = setTimeout(() => this.#failed(id, UNACKNOWLEDGED), ACK_MS);
    const sent = this.#socket.send({ type: "estop", uuid: id, why: press.why });
    if (sent) press.ways += 1;
    if (this.#way.there) this.#post(id, press, this.#way.estop);
    if (!sent) this.#postWhatIsLeft(id, press);
  }

  /** Take in an answer of the server, from the socket or by POST; it changes nothing if its press no longer waits for one. */
  acknowledged({ uuid: id, status, reason }) {
    if (!this.#state.waits(id)) return; // already answered, or released since
    this.#heed();
    if (status !== "accepted" && status !== "done") {
      this.#oneWayFailed(id, reason || t("page.estop.was", "the e-stop was {status}", { status }));
      return;
    }
    this.#state.answered(id, now());
    this.#show();
  }

  /** Record that one way has failed; report the failure if no other is left. */
  #oneWayFailed(id, reason) {
    const press = this.#presses.get(id);
    press.ways -= 1;
    press.reason ||= reason;
    if (press.ways <= 0) this.#failed(id, reason);
  }

  #failed(id, reason) {
    if (!this.#state.waits(id)) return;
    const press = this.#presses.get(id);
    this.#state.failed(id, press.reason || reason);
    this.#show();
    this.#postWhatIsLeft(id, press);
  }

  #postWhatIsLeft(id, press) {
    for (const address of press.left) this.#post(id, press, address);
  }

  async #post(id, press, address) {
    press.left.delete(address);
    press.ways += 1;
    try {
      this.acknowledged({ status: "done", ...(await post(address, { uuid: id, why: press.why }, { simple: true })), uuid: id });
    } catch (error) {
      this.acknowledged({ uuid: id, status: "failed", reason: error.message });
    }
  }

  /**
   * Take in a snapshot of the station. Redraw only if it changes something, because a screen reader reads out whatever is
   * drawn.
   */
  #news() {
    this.#heed();
    this.#state.snapshot(this.#store.snapshot, now());
    this.#area.toggleAttribute("data-latched", this.#state.latched);
    if (this.#state.shown.kind !== this.#drawn) this.#show();
  }

  /** Take over the press of the early script, whose message stays until this module draws another one. */
  #heed() {
    const { early, kind } = this.#area.dataset;
    if (!early || kind === this.#early) return;
    if (!this.#early) this.#state.pressed(early, now());
    if (kind === "failed") this.#state.failed(early, "");
    if (kind === "stopped") this.#state.answered(early, now());
    this.#early = kind;
    this.#drawn = this.#state.shown.kind;
  }

  #show() {
    const { kind, reason } = this.#state.shown;
    for (const [id, { timer }] of this.#presses) {
      if (this.#state.waits(id)) continue;
      clearTimeout(timer);
      this.#presses.delete(id);
    }
    this.#drawn = kind;
    delete this.#area.dataset.early; // from here on estop_early.js shows nothing
    this.#note.title = reason;
    if (kind) this.#say(WORDS[kind], reason);
    else this.#atRest();
  }

  #say({ kind, text }, reason) {
    this.#area.dataset.kind = kind;
    this.#note.textContent = text;
    if (!reason) return;
    const detail = document.createElement("span");
    detail.className = "estop-detail";
    detail.textContent = reason;
    this.#note.append(detail);
  }

  #atRest() {
    this.#note.innerHTML = this.#rest;
    delete this.#area.dataset.kind;
  }

  #isStop(event) {
    if (event.ctrlKey || event.altKey || event.metaKey) return "";
    if (event.key === "Escape") return "Escape";
    if (event.code !== "Space") return "";
    const control = event.target.closest?.(CONTROLS)?.checkVisibility();
    return control && this.#leavesSpace() ? "" : "space";
  }

  #key(event) {
    const why = this.#isStop(event);
    if (!why) return;
    if (why === "space") event.preventDefault(); // prevents scrolling of the page
    if (event.repeat) return;
    const closed = why === "Escape" && closeTop();
    if (!closed || !this.#atRestForSure()) this.press(why);
  }

  /**
   * Return true if Space may go to the focused control: the e-stop is latched, or the robot is at rest and only a button can
   * start a motion.
   */
  #leavesSpace() {
    return this.#state.latched || (this.#store.fresh && AT_REST.includes(this.#store.snapshot.state));
  }

  /** Return true if this page's information is current and says that nothing moves. */
  #atRestForSure() {
    return this.#store.fresh && !this.#store.snapshot.state_is.moving;
  }

  #keyUp(event) {
    if (this.#isStop(event) === "space") event.preventDefault();
  }
}

/** Remove the early script's message that the page has not started. */
function startedAfterAll(outcome) {
  if (outcome?.dataset.late === undefined) return;
  outcome.textContent = "";
  delete outcome.dataset.late;
}

/** Close the last open dialog or menu in the page; return whether one was open. */
function closeTop() {
  const top = [...document.querySelectorAll(OPEN)].filter((each) => each.checkVisibility()).at(-1);
  if (top instanceof HTMLDialogElement) top.close();
  else if (top) top.open = false;
  return Boolean(top);
}
