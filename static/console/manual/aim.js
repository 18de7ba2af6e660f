// Where the robot would go: requested over the live socket, answered by the station, shown by listeners of "eva:aimed".

import { t } from "../../site/sentences.js";

const EVERY_MS = 80; // shortest time between two requests [ms]; the newest request is always sent
const PATIENCE_MS = 4000; // longer than the lab's own timeout [ms]

/**
 * Asks the station where a target is; nothing moves. Every answer is sent as the event "eva:aimed" on the document, with the
 * detail {ok, reason, joints, poses, reached, clipped, distance, duration_s, ..., links}; the detail is null if there is no
 * target any more, and its ghost may then not be shown.
 */
export class Aim {
  #send;
  #number = 0;
  #shown = 0; // number of the newest request whose answer was shown or discarded
  #waiting = new Map(); // id -> {resolve, timer}
  #next = null; // newest request that waits to be sent
  #following = false;

  /** `send(message)` returns false if the socket is closed. */
  constructor(send) {
    this.#send = send;
  }

  /** Ask about `args` (joints, pose, jog); resolve to the answer, whose `ok` is false if none came. */
  ask(args) {
    const id = (this.#number += 1);
    return new Promise((resolve) => {
      const timer = setTimeout(() => this.answered({ id, ok: false, reason: t("page.aim.silent", "the station has not said where that is") }), PATIENCE_MS);
      this.#waiting.set(id, { resolve, timer });
      if (!this.#send({ type: "aim", id, args })) this.answered({ id, ok: false, reason: t("page.aim.no_connection", "no connection to the lab") });
    });
  }

  /**
   * Ask about a target that changes quickly, such as a slider: one request at a time, and only the newest; `heard(answer)` is
   * called with its answer.
   */
  follow(args, heard) {
    this.#next = { args, heard };
    if (!this.#following) this.#go();
  }

  /** Discard the target. */
  clear() {
    this.#next = null;
    this.#shown = this.#number; // answers still under way are not shown any more
    tell(null);
  }

  /** Take in an answer from the socket. */
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

  /** Send requests one at a time: otherwise, on a slow connection, every answer would be out of date when it came. */
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
