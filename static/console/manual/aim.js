// Where the robot would go: asked over the live socket, answered by the station, shown by whoever listens.

import { t } from "../../site/sentences.js";

const EVERY_MS = 80; // at least, between two questions; the newest one always goes out
const PATIENCE_MS = 4000; // longer than the lab's own

/**
 * Asks the station where a target is; nothing moves. Every answer is told as the event "eva:aimed" on the document,
 * whose detail is {ok, reason, joints, poses, reached, clipped, distance, duration_s, ..., links}, or null where
 * there is no target any more: then no ghost of one may be shown.
 */
export class Aim {
  #send;
  #number = 0;
  #shown = 0; // the newest question whose answer was shown, or that was cleared
  #waiting = new Map(); // id -> {resolve, timer}
  #next = null; // the newest question that waits for its turn
  #following = false;

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

  /** Ask about what changes quickly, such as a slider: one at a time, and only the newest; `heard(answer)`. */
  follow(args, heard) {
    this.#next = { args, heard };
    if (!this.#following) this.#go();
  }

  /** There is no target any more. */
  clear() {
    this.#next = null;
    this.#shown = this.#number; // what is still under way is no longer shown
    tell(null);
  }

  /** An answer came over the socket. */
  answered(answer) {
    const asked = this.#waiting.get(answer.id);
    if (!asked) return;
    this.#waiting.delete(answer.id);
    clearTimeout(asked.timer);
    if (answer.id > this.#shown) {
      this.#shown = answer.id;
      tell(answer);
    }
    asked.resolve(answer);
  }

  /** The next question waits for the answer: on a slow connection every answer would be out of date before it came. */
  async #go() {
    this.#following = true;
    try {
      while (this.#next) {
        const { args, heard } = this.#next;
        this.#next = null;
        const pause = new Promise((resolve) => setTimeout(resolve, EVERY_MS));
        const asked = this.ask(args);
        const number = this.#number;
        const answer = await asked;
        if (number === this.#shown) heard(answer);
        await pause;
      }
    } finally {
      this.#following = false;
    }
  }
}

function tell(detail) {
  document.dispatchEvent(new CustomEvent("eva:aimed", { detail }));
}
