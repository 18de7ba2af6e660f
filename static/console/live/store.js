// What this page knows of its station: the newest of everything, and who wants to hear of it.

import { localized, t } from "../../site/sentences.js";

/** Names told: "snapshot", "joints", "poses", "camera", "link", "events", "open", "hello", "second"; answers of the web: "ack", "renewed", "aimed"; "changed", with the names of what has in the database. */
export class Store {
  #listeners = new Map();

  constructor({ user, page, role }) {
    this.user = user;
    this.role = role;
    this.holder = `web:${user}:${page}`;
    this.page = page;
    this.snapshot = null; // the station's state as it last came
    this.snapshotAt = -Infinity; // when, on this page's clock [ms]
    this.facts = {}; // of the robot
    this.joints = null; // {step, engaged, measured, commanded, simulated, ...} as they last came
    this.link = { ok: false, reason: t("page.status.connecting", "connecting") }; // between web and runtime
    this.open = false; // the socket to the web
    this.closed = null; // why the web lets this page in no more, as labels.js has it
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
        reportError(error); // one pane that fails must not take the others with it
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

  /** Seconds since the state came; a state older than this page can bear is not the state. */
  get age() {
    return (performance.now() - this.snapshotAt) / 1000;
  }

  get fresh() {
    return this.open && this.link.ok && this.snapshot !== null && this.age < 1.5;
  }

  /** "mine", "elsewhere" (another page of the same person), "other", "free", or "unknown". */
  get lease() {
    if (!this.snapshot) return "unknown";
    const { holder } = this.snapshot.lease;
    if (!holder) return "free";
    if (holder === this.holder) return "mine";
    return holder.startsWith(`web:${this.user}:`) ? "elsewhere" : "other";
  }

  /** Who has the lease, as people know them. */
  get commander() {
    const [kind, name] = (this.snapshot?.lease.holder ?? "").split(":");
    if (kind !== "web") return this.snapshot?.lease.holder ?? "";
    return name;
  }

  get epoch() {
    return this.snapshot?.lease.epoch ?? 0;
  }
}
