// The station's log: its events as sentences, newest first, without gaps, with a filter by words.

import { clockTime } from "../../site/times.js";
import { kindLabel, eventText, severity } from "./event_text.js";
import { t } from "../../site/sentences.js";

const KEPT = 400;

export class Events {
  #list = document.getElementById("events");
  #filter = document.getElementById("events-filter");
  #count = document.getElementById("events-count");
  #boot = "";
  #newest = 0;
  #covered = false; // some events are hidden from this user
  #rows = new WeakMap(); // row -> its event

  constructor() {
    this.#filter.addEventListener("input", () => this.#show());
    document.addEventListener("eva:language", () => this.#translate());
    this.#show();
  }

  /** Number of the newest event in the list, to request what comes after it. */
  get newest() {
    return this.#newest;
  }

  /** Boot of the runtime that the events belong to. */
  get boot() {
    return this.#boot;
  }

  /** Add events; `covered` is true if some are hidden from this user, so that numbers are missing. */
  add({ boot, events, covered = false }) {
    if (covered !== this.#covered) {
      // The numbers differ then, and all events are sent once more.
      this.#covered = covered;
      this.#newest = 0;
      this.#list.replaceChildren();
    }
    if (boot && boot !== this.#boot) {
      if (this.#boot && this.#newest) this.#divide(t("page.events.anew", "The station was started anew"));
      this.#boot = boot;
      this.#newest = 0;
    }
    const fresh = events.filter((event) => event.number > this.#newest);
    if (!fresh.length) return;
    const expected = this.#newest + 1;
    if (this.#newest && !covered && fresh[0].number > expected) this.#divide(t("page.events.gone", "Events {first} to {last} are no longer kept", { first: expected, last: fresh[0].number - 1 }));
    for (const event of fresh) this.#list.prepend(this.#row(event));
    this.#newest = fresh.at(-1).number;
    while (this.#list.children.length > KEPT) this.#list.lastElementChild.remove();
    this.#show();
  }

  #row(event) {
    const { number, kind, wall } = event;
    const text = eventText(event);
    const row = document.createElement("li");
    row.className = "event";
    row.dataset.kind = kind;
    row.dataset.weight = severity(event);
    row.dataset.words = `${kind} ${kindLabel(kind)} ${event.text} ${text}`.toLowerCase();
    const time = document.createElement("time");
    time.textContent = clockTime(wall * 1000);
    if (!this.#covered) time.title = t("page.events.number", "event {n}", { n: number });
    const name = document.createElement("span");
    name.className = "event-kind clip";
    name.textContent = kindLabel(kind);
    name.title = kindLabel(kind);
    const words = document.createElement("span");
    words.textContent = text;
    words.title = event.text;
    row.append(time, name, words);
    this.#rows.set(row, event);
    return row;
  }

  /** Translate all rows again, after another language was chosen or its catalogue has arrived. */
  #translate() {
    for (const row of this.#list.querySelectorAll(".event")) {
      const event = this.#rows.get(row);
      if (event) row.replaceWith(this.#row(event));
    }
    this.#show();
  }

  #divide(text) {
    const row = document.createElement("li");
    row.className = "event event-divider";
    row.dataset.words = text.toLowerCase();
    row.textContent = text;
    this.#list.prepend(row);
  }

  #show() {
    const wanted = this.#filter.value.trim().toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of this.#list.querySelectorAll(".event")) {
      row.hidden = !wanted.every((word) => row.dataset.words.includes(word));
      if (!row.hidden) shown += 1;
    }
    this.#list.toggleAttribute("data-empty", shown === 0);
    this.#list.dataset.note = wanted.length ? t("page.events.no_match", "No events match.") : t("page.events.none", "Events at the station appear here.");
    this.#count.textContent = wanted.length ? t("page.events.shown", "{n} shown", { n: shown }) : "";
  }
}
