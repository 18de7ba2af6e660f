// The time axis with held spans, events, milestones and chunks, and the list of events.

import { t } from "../site/sentences.js";
import { Hover } from "./hover.js";

function stamp(seconds) {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(2).padStart(5, "0")}`;
}

export class Timeline {
  #clock;
  #scrub = document.getElementById("scrub");
  #rows = [];
  #now = -1;
  #hover;

  /** `pictures` is {videos, grid} for the small pictures, if there are any. */
  constructor(clock, pictures = {}) {
    this.#clock = clock;
    this.#hover = new Hover({ clock, axis: this.#scrub, stamp, ...pictures });
    this.#scrub.addEventListener("input", () => {
      clock.pause();
      clock.seekRow(Number(this.#scrub.value));
    });
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
  }

  /** Show `held` [[from, to]], `marks` [{time, kind, text}] and `chunks` [{from}], in seconds. */
  fill({ held, marks, chunks = [] }) {
    const strip = document.getElementById("marks");
    const share = (time) => `${(100 * Math.min(time, this.#clock.duration)) / this.#clock.duration}%`;
    for (const [from, to] of held) strip.append(piece("timeline-held", share(from), share(to - from)));
    for (const { time, kind } of marks) {
      const mark = piece("timeline-mark", share(time), null);
      mark.dataset.kind = kind;
      strip.append(mark);
    }
    this.#chunks(chunks);
    this.#hover.mark(marks.map(({ time, kind, text }) => ({ time, text: text || kind })));
    this.#list(marks);
    this.#at();
  }

  /** Draw a hairline where each chunk takes over. */
  #chunks(chunks) {
    const lane = document.getElementById("chunks");
    const places = chunks.map(({ from }) => Math.min(from, this.#clock.duration) / this.#clock.duration);
    lane.toggleAttribute("hidden", !places.length);
    lane.firstElementChild.setAttribute("d", places.map((place) => `M${place.toFixed(5)} 0V1`).join(""));
  }

  #list(marks) {
    const list = document.getElementById("events");
    if (!marks.length) list.append(Object.assign(document.createElement("li"), { className: "muted", textContent: t("page.replay.no_events", "No events but the run itself.") }));
    for (const mark of [...marks].sort((one, other) => one.time - other.time)) {
      const item = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
      if (mark.kind === "milestone") button.className = "timeline-reached";
      button.append(Object.assign(document.createElement("span"), { className: "mono", textContent: stamp(mark.time) }), ` ${mark.text || mark.kind}`);
      button.addEventListener("click", () => this.#clock.seek(mark.time));
      item.append(button);
      list.append(item);
      this.#rows.push({ time: mark.time, item, text: mark.text || mark.kind });
    }
  }

  #at() {
    const { row, rows, time } = this.#clock;
    this.#scrub.value = String(row);
    this.#scrub.setAttribute("aria-valuetext", `${time.toFixed(2)} s`);
    document.getElementById("time").textContent = `${stamp(row / this.#clock.fps)} / ${stamp(this.#clock.duration)}  ${t("page.replay.row_of", "row {row} of {rows}", { row, rows })}`;
    const now = this.#rows.findLastIndex((one) => one.time <= time + 1e-6);
    if (now === this.#now) return;
    this.#rows[this.#now]?.item.removeAttribute("aria-current");
    this.#rows[now]?.item.setAttribute("aria-current", "true");
    document.getElementById("now").textContent = this.#rows[now]?.text ?? "";
    this.#now = now;
  }
}

function piece(name, left, width) {
  const element = document.createElement("i");
  element.className = name;
  element.style.left = left;
  if (width !== null) element.style.width = width;
  return element;
}
