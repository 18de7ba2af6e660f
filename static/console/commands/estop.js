// The software e-stop: a button that never moves, Escape, and space outside text fields. Waits for nothing: it goes
// over the socket and to the process for stops at once, under one uuid, which the station carries out once. What is
// left, plain HTTP to the web, where these say nothing; and red letters where nobody does.

import { post } from "../../site/api.js";
import { uuid } from "../../site/identity.js";
import { config } from "../live/config.js";

const ACK_MS = 500;
const TEXT_FIELDS = 'textarea, [contenteditable="true"], input:not([type]), input[type="text"], input[type="search"], input[type="number"], input[type="password"], input[type="email"], input[type="url"]';
const SPACE_IS_TAKEN = config.page === "collect"; // there it stops and saves whatever moves, and starts

export class EStop {
  #socket;
  #store;
  #way;
  #waiting = new Map(); // uuid -> {ways under way, addresses that are left, why, reason, timer}
  #note = document.getElementById("estop-note");
  #area = document.getElementById("estop-area");
  #rest = this.#note.dataset.rest;
  #faulted = false;

  constructor(store, socket, way) {
    this.#store = store;
    this.#socket = socket;
    this.#way = way;
    document.getElementById("estop").addEventListener("click", () => this.press("button"));
    window.addEventListener("keydown", (event) => this.#key(event), { capture: true });
    window.addEventListener("keyup", (event) => this.#keyUp(event), { capture: true });
    store.on("snapshot", () => this.#latched());
    this.ask();
    this.#area.dataset.ready = ""; // estop_early.js leaves it to us
  }

  /** Have the process for stops know who is here, before anybody presses. */
  async ask() {
    this.#area.toggleAttribute("data-second-way", await this.#way.ask());
  }

  /** Press it; `why` is what was pressed. */
  press(why) {
    const id = uuid();
    this.#show("pressed", "E-stop pressed …");
    const press = { ways: 0, left: new Set([config.api.estop]), why: `${why} on the page`, reason: "" };
    this.#waiting.set(id, press);
    press.timer = setTimeout(() => this.#unanswered(id), ACK_MS);
    const sent = this.#socket.send({ type: "estop", uuid: id, why: press.why });
    if (sent) press.ways += 1;
    if (this.#way.there) this.#post(id, press, this.#way.estop);
    if (!sent) this.#postWhatIsLeft(id, press);
  }

  /** An answer of the server came over the socket or by post; of a press that waits no more it changes nothing. */
  acknowledged({ uuid: id, status, reason }) {
    if (status !== "accepted" && status !== "done") {
      this.#failed(id, reason || `the e-stop was ${status}`);
      return;
    }
    if (!this.#waiting.has(id)) return; // it may be from before a release
    for (const [before, { timer }] of this.#waiting) {
      clearTimeout(timer); // one latch answers all that were pressed before
      this.#waiting.delete(before);
      if (before === id) break;
    }
    if (this.#waiting.size === 0) this.#show("stopped", "E-stop acknowledged: the robot is held.");
  }

  #unanswered(id) {
    const press = this.#waiting.get(id);
    this.#hardware(press.reason || "the software stop was not acknowledged");
    this.#postWhatIsLeft(id, press);
  }

  /** One way has failed; said where it was the last one. */
  #failed(id, reason) {
    const press = this.#waiting.get(id);
    if (!press) return; // another way was acknowledged
    press.ways -= 1;
    press.reason ||= reason;
    if (press.ways > 0) return;
    this.#hardware(press.reason);
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
      this.#failed(id, error.message);
    }
  }

  #hardware(reason) {
    this.#show("failed", "USE THE HARDWARE STOP");
    this.#note.title = reason;
    const detail = document.createElement("span");
    detail.className = "estop-detail";
    detail.textContent = reason;
    this.#note.append(detail);
  }

  #show(kind, text) {
    delete this.#area.dataset.early; // estop_early.js says nothing from here on
    this.#area.dataset.kind = kind;
    this.#note.textContent = text;
    this.#note.title = "";
  }

  /** What the station itself says of its latch: it outlives this page's words, but never a missing answer. */
  #latched() {
    const before = this.#faulted;
    this.#faulted = this.#store.snapshot.state === "faulted";
    this.#area.toggleAttribute("data-latched", this.#faulted);
    if (this.#faulted && ["", "stopped"].includes(this.#area.dataset.kind ?? "")) this.#show("stopped", "E-stop is latched.");
    if (before && !this.#faulted) this.#atRest();
  }

  #atRest() {
    delete this.#area.dataset.early;
    this.#note.innerHTML = this.#rest;
    delete this.#area.dataset.kind;
  }

  #isStop(event) {
    if (event.ctrlKey || event.altKey || event.metaKey) return "";
    if (event.key === "Escape") return "Escape";
    if (event.code === "Space" && !SPACE_IS_TAKEN && !event.target.closest?.(TEXT_FIELDS)) return "space";
    return "";
  }

  #key(event) {
    const why = this.#isStop(event);
    if (!why) return;
    if (why === "space") event.preventDefault(); // else it would also press the focused button
    if (!event.repeat) this.press(why);
  }

  #keyUp(event) {
    if (this.#isStop(event) === "space") event.preventDefault();
  }
}
