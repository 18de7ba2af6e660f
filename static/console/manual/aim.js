// Where the robot would go: asked over the live socket, answered by the station, shown by whoever listens.

import { t } from "../../site/sentences.js";

const EVERY_MS = 80; // between two questions; the newest one always goes out
const PATIENCE_MS = 4000; // longer than the lab's own

/**
 * Asks the station where a target is; nothing moves. Every answer is told as the event "eva:aimed" on the document,
 * whose detail is {ok, reason, joints, poses, reached, clipped, distance, duration_s, ..., links}, or null where
 * there is no target any more: then no ghost of one may be shown.
 */
export class Aim {
  #send;
  #number = 0;
  #waiting = new Map(); // id -> {resolve, timer}
  #next = null; // the newest question that waits for its turn
  #turn = 0;

  /** `send(message)` is false where the socket is closed. */
  constructor(send) {
    this.#send = send;
  }

  /** Ask about `args` (joints, pose, jog); resolves to the answer, whose `ok` is false where there is none. */
  ask(args) {
    const id = (this.#number += 1);
    return new Promise((resolve) => {
      const timer = setTimeout(() => this.answered({ id, ok: false, reason: t("page.aim.silent", "the station has not said where that is") }), PATIENCE_MS);
      this.#waiting.set(id, { resolve, timer });
      if (!this.#send({ type: "aim", id, args })) this.answered({ id, ok: false, reason: t("page.aim.no_connection", "no connection to the lab") });
    });
  }

  /** Ask about what changes quickly, such as a slider: not too often, and only the newest; `heard(answer)`. */
  follow(args, heard) {
    this.#next = { args, heard };
    if (!this.#turn) this.#go();
  }

  /** There is no target any more. */
  clear() {
    this.#next = null;
    this.#number += 1; // what is still under way is no longer shown
    tell(null);
  }

  /** An answer came over the socket. */
  answered(answer) {
    const asked = this.#waiting.get(answer.id);
    if (!asked) return;
    this.#waiting.delete(answer.id);
    clearTimeout(asked.timer);
    if (answer.id === this.#number) tell(answer);
    asked.resolve(answer);
  }

  async #go() {
    const { args, heard } = this.#next;
    this.#next = null;
    this.#turn = setTimeout(() => {
      this.#turn = 0;
      if (this.#next) this.#go();
    }, EVERY_MS);
    const number = this.#number + 1;
    const answer = await this.ask(args);
    if (number === this.#number) heard(answer);
  }
}

function tell(detail) {
  document.dispatchEvent(new CustomEvent("eva:aimed", { detail }));
}
