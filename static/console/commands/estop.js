// The software e-stop: a button that never moves, Escape, and space outside text fields. Waits for nothing:
// the socket first, plain HTTP where that does not answer, and red letters where nobody does.

import { post } from "../site/api.js";
import { uuid } from "../site/identity.js";
import { config } from "./config.js";

const ACK_MS = 500;
const TEXT_FIELDS = 'textarea, [contenteditable="true"], input:not([type]), input[type="text"], input[type="search"], input[type="number"], input[type="password"], input[type="email"], input[type="url"]';
const SPACE_IS_TAKEN = config.page === "collect"; // there it stops and saves whatever moves, and starts

export class EStop {
  #socket;
  #store;
  #waiting = new Map(); // uuid -> timer
  #note = document.getElementById("estop-note");
  #area = document.getElementById("estop-area");
  #rest = this.#note.dataset.rest;
  #faulted = false;

  constructor(store, socket) {
    this.#store = store;
    this.#socket = socket;
    document.getElementById("estop").addEventListener("click", () => this.press("button"));
    window.addEventListener("keydown", (event) => this.#key(event), { capture: true });
    window.addEventListener("keyup", (event) => this.#keyUp(event), { capture: true });
    store.on("snapshot", () => this.#latched());
    this.#area.dataset.ready = ""; // estop_early.js leaves it to us
  }

  /** Press it; `why` is what was pressed. */
  press(why) {
    const id = uuid();
    this.#show("pressed", "E-stop pressed …");
    this.#waiting.set(id, setTimeout(() => this.#unanswered(id), ACK_MS));
    const text = `${why} on the page`;
    if (!this.#socket.send({ type: "estop", uuid: id, why: text })) this.#byPost(id, text);
  }

  /** An answer of the server came over the socket or by post. */
  acknowledged({ status, reason }) {
    if (status !== "accepted" && status !== "done") {
      this.#hardware(reason || `the e-stop was ${status}`);
      return;
    }
    for (const timer of this.#waiting.values()) clearTimeout(timer); // one latch answers every press
    this.#waiting.clear();
    this.#show("stopped", "E-stop acknowledged: the robot is held.");
  }

  #unanswered(id) {
    this.#hardware("the software stop was not acknowledged");
    this.#byPost(id, `no answer within ${ACK_MS} ms`);
  }

  async #byPost(id, why) {
    try {
      this.acknowledged({ status: "done", ...(await post(config.api.estop, { uuid: id, why })), uuid: id });
    } catch (error) {
      this.#hardware(error.message);
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
