// The time axis of the transport, with held spans shaded and events marked, and the list of events.

function stamp(seconds) {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(2).padStart(5, "0")}`;
}

export class Timeline {
  #clock;
  #scrub = document.getElementById("scrub");
  #rows = [];
  #now = -1;

  constructor(clock) {
    this.#clock = clock;
    this.#scrub.addEventListener("input", () => {
      clock.pause();
      clock.seekRow(Number(this.#scrub.value));
    });
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
  }

  /** `held`: [[from, to]] and `marks`: [{time, kind, text}], in seconds. */
  fill({ held, marks }) {
    const strip = document.getElementById("marks");
    const share = (time) => `${(100 * Math.min(time, this.#clock.duration)) / this.#clock.duration}%`;
    for (const [from, to] of held) strip.append(piece("timeline-held", share(from), share(to - from)));
    for (const { time, kind } of marks) {
      const mark = piece("timeline-mark", share(time), null);
      mark.dataset.kind = kind;
      strip.append(mark);
    }
    this.#list(marks);
    this.#at();
  }

  #list(marks) {
    const list = document.getElementById("events");
    if (!marks.length) list.append(Object.assign(document.createElement("li"), { className: "muted", textContent: "Nothing happened but the run." }));
    for (const mark of [...marks].sort((one, other) => one.time - other.time)) {
      const item = document.createElement("li");
      const button = document.createElement("button");
      button.type = "button";
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
    document.getElementById("time").textContent = `${stamp(row / this.#clock.fps)} / ${stamp(this.#clock.duration)}  row ${row} of ${rows}`;
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
