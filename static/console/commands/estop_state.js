// What to show of the e-stop: presses that wait for an answer, and the latch as the station reports it. A snapshot may arrive
// late: one that is older than a press or an answer does not override it.

const QUICKEST_S = 1; // bound on the shortest delay of a snapshot [s]

/** E-stop state of one page; `now` is this page's clock [s]. */
export class EStopState {
  #waiting = new Map(); // uuid -> {at, failed, reason, latched and released: seen since}, in order
  #heldAt = null; // time of the answer that the robot is held; null once a snapshot is as recent
  #latched = false;
  #boot = "";
  #clock = -Infinity; // time of the newest snapshot on the station's clock [s]
  #ahead = -Infinity; // station's clock minus this page's clock at the snapshot with the least delay [s]

  get latched() {
    return this.#latched;
  }

  /** Return whether that press still waits for an answer. */
  waits(uuid) {
    return this.#waiting.has(uuid);
  }

  pressed(uuid, now) {
    this.#waiting.set(uuid, { at: now, failed: false, reason: "", latched: false, released: false });
  }

  /** Mark a press as not acknowledged in time, or as failed; an answer may still come. */
  failed(uuid, reason) {
    const press = this.#waiting.get(uuid);
    if (press) Object.assign(press, { failed: true, reason });
  }

  /**
   * Mark a press and all earlier ones as carried out, because one latch answers them all. Ignore a press that no longer waits.
   */
  answered(uuid, now) {
    const press = this.#waiting.get(uuid);
    if (!press) return;
    for (const before of [...this.#waiting.keys()]) {
      this.#waiting.delete(before);
      if (before === uuid) break;
    }
    if (!press.released) this.#heldAt = now; // otherwise the stop may have preceded the release, and the next snapshot says what is true
  }

  /** Take in a snapshot; ignore one that a newer snapshot of the same boot has overtaken. */
  snapshot(news, now) {
    const { boot = "", clock = now, state_is: is } = news;
    if (boot === this.#boot && clock < this.#clock) return;
    this.#ahead = Math.max(boot === this.#boot ? this.#ahead : -Infinity, clock - now);
    this.#boot = boot;
    this.#clock = clock;
    const released = this.#latched && !is.latched;
    this.#latched = is.latched;
    for (const [uuid, press] of [...this.#waiting]) {
      if (this.#latched) press.latched ||= this.#isAfter(press.at);
      else if (press.latched) this.#waiting.delete(uuid);
      else press.released ||= released;
    }
    if (!this.#latched && this.#heldAt !== null && (released || this.#isAfter(this.#heldAt))) this.#heldAt = null;
  }

  /** {kind, reason}; kind is "failed" or "pressed" (decided by the newest press), "latched", "held", or "" at rest. */
  get shown() {
    const newest = [...this.#waiting.values()].at(-1);
    if (newest) return { kind: newest.failed ? "failed" : "pressed", reason: newest.reason };
    return { kind: this.#latched ? "latched" : this.#heldAt === null ? "" : "held", reason: "" };
  }

  /** Return true if the newest snapshot was certainly made after the moment `at` of this page's clock [s]. */
  #isAfter(at) {
    return this.#clock > at + this.#ahead + QUICKEST_S;
  }
}
