// What there is to say of the e-stop: presses that wait for an answer, and the latch as the station tells of it. News of
// the station may be late: what is older than a press, or than an answer, overwrites neither.

const QUICKEST_S = 1; // the quickest news of this page took no longer

/** The truth of one page; `now` is this page's clock [s]. */
export class EStopState {
  #waiting = new Map(); // uuid -> {at, failed, reason, latched: seen after it, released: seen since}, as pressed
  #heldAt = null; // when an answer said that the robot is held, until the station's news are as new
  #latched = false;
  #boot = "";
  #clock = -Infinity; // of the newest news, on the station's clock [s]
  #ahead = -Infinity; // that clock minus ours, of the quickest news

  get latched() {
    return this.#latched;
  }

  /** Whether that press still waits for an answer. */
  waits(uuid) {
    return this.#waiting.has(uuid);
  }

  pressed(uuid, now) {
    this.#waiting.set(uuid, { at: now, failed: false, reason: "", latched: false, released: false });
  }

  /** It was not acknowledged in time, or not at all; an answer may still come. */
  failed(uuid, reason) {
    const press = this.#waiting.get(uuid);
    if (press) Object.assign(press, { failed: true, reason });
  }

  /** It was carried out: one latch answers all that were pressed before. Of a press that waits no more it says nothing. */
  answered(uuid, now) {
    const press = this.#waiting.get(uuid);
    if (!press) return;
    for (const before of [...this.#waiting.keys()]) {
      this.#waiting.delete(before);
      if (before === uuid) break;
    }
    if (!press.released) this.#heldAt = now; // else it may have been before the release: the station's news say it
  }

  /** News of the station; those that others of the same boot have overtaken say nothing. */
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

  /** {kind, reason}: "failed", "pressed" (the newest press decides), "latched", "held", or "" at rest. */
  get shown() {
    const newest = [...this.#waiting.values()].at(-1);
    if (newest) return { kind: newest.failed ? "failed" : "pressed", reason: newest.reason };
    return { kind: this.#latched ? "latched" : this.#heldAt === null ? "" : "held", reason: "" };
  }

  /** Whether the newest news were made after the moment `at` of this page's clock, for sure. */
  #isAfter(at) {
    return this.#clock > at + this.#ahead + QUICKEST_S;
  }
}
