// What this page knows of its station: the newest message of every kind, and the listeners for each.

import { localized, t } from "../../site/sentences.js";

/**
 * Newest data of a station. Names of notifications: "snapshot", "joints", "poses", "camera", "link", "events", "open", "hello"
 * and "second"; for answers of the web server "ack", "renewed" and "aimed"; and "changed", with the names of what has changed
 * in the database.
 */
export class Store {
  #listeners = new Map();

  constructor({ user, page, role }) {
    this.user = user;
    this.role = role;
    this.holder = `web:${user}:${page}`;
    this.page = page;
    this.snapshot = null; // newest snapshot of the station
    this.snapshotAt = -Infinity; // arrival time of the snapshot on this page's clock [ms]
    this.facts = {}; // facts about the robot
    this.joints = null; // newest {step, engaged, measured, commanded, simulated, ...}
    this.link = { ok: false, reason: t("page.status.connecting", "connecting") }; // connection between web server and runtime
    this.open = false; // true while the socket to the web server is open
    this.closed = null; // entry of CLOSE_REASONS in labels.js if the web server refuses this page, else null
  }

  on(names, listener) {
    for (const name of [names].flat()) {
      if (!this.#listeners.has(name)) this.#listeners.set(name, []);
      this.#listeners.get(name).push(listener);
    }
  }

  tell(name, content) {
    for (const listener of this.#listeners.get(name) ?? []) {
      try {
        listener(content);
      } catch (error) {
        reportError(error); // a pane that fails must not stop the others
      }
    }
  }

  setSnapshot(snapshot) {
    this.snapshot = localized(snapshot);
    this.snapshotAt = performance.now();
    this.tell("snapshot", this.snapshot);
  }

  setJoints(joints) {
    this.joints = joints;
    this.tell("joints", joints);
  }

  /** Age of the snapshot [s]; the page does not treat an old snapshot as the station's state. */
  get age() {
    return (performance.now() - this.snapshotAt) / 1000;
  }

  get fresh() {
    return this.open && this.link.ok && this.snapshot !== null && this.age < 1.5;
  }

  /** Who has the lease: "mine", "elsewhere" (another page of the same user), "other", "free" or "unknown". */
  get lease() {
    if (!this.snapshot) return "unknown";
    const { holder } = this.snapshot.lease;
    if (!holder) return "free";
    if (holder === this.holder) return "mine";
    return holder.startsWith(`web:${this.user}:`) ? "elsewhere" : "other";
  }

  /** Name of the holder of the lease: the user's name if it is a page. */
  get commander() {
    const [kind, name] = (this.snapshot?.lease.holder ?? "").split(":");
    if (kind !== "web") return this.snapshot?.lease.holder ?? "";
    return name;
  }

  get epoch() {
    return this.snapshot?.lease.epoch ?? 0;
  }
}
