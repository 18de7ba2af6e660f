// Preview under the pointer on the time axis: the time, what happened there, and small pictures.

import { t } from "../site/sentences.js";

const HALF_THUMB = 8; // px at both ends of a range input, where its axis begins and ends
const NEAR = 6; // distance to a mark [px]
const MOST = 4; // cameras at most

/** Return the row at `x` [px] on an axis that is `width` px wide, of a clock with `rows` rows. */
export function rowAt(x, width, rows) {
  const share = (x - HALF_THUMB) / Math.max(1, width - 2 * HALF_THUMB);
  return Math.min(rows - 1, Math.max(0, Math.floor(share * rows)));
}

/** Return where a row's picture lies on its sheet, as percentages for background-position. */
export function tileAt(row, { every, across, down }) {
  const tile = Math.floor(row / every);
  const share = (at, of) => (of > 1 ? (100 * at) / (of - 1) : 0);
  return { x: share(tile % across, across), y: share(Math.floor(tile / across), down) };
}

export class Hover {
  #clock;
  #axis;
  #box = document.getElementById("hover");
  #sheets; // {sheet: address, picture: element}
  #grid;
  #marks = [];

  /** Each of `videos` has a `sheet` if one exists, laid out by `grid`; `stamp` formats seconds. */
  constructor({ clock, axis, videos = [], grid = null, stamp }) {
    this.#clock = clock;
    this.#axis = axis;
    this.#grid = grid;
    this.stamp = stamp;
    this.#sheets = videos.filter(({ sheet }) => sheet);
    axis.addEventListener("pointerenter", () => this.#fetch(), { once: true });
    axis.addEventListener("pointermove", (event) => this.#show(event.clientX));
    for (const kind of ["pointerleave", "pointercancel"]) axis.addEventListener(kind, () => (this.#box.hidden = true));
  }

  /** Show these marks when they are near the pointer: [{time, text}]. */
  mark(marks) {
    this.#marks = marks;
  }

  #fetch() {
    const place = this.#box.querySelector("[data-sheets]");
    for (const sheet of this.#sheets.slice(0, MOST)) {
      sheet.picture = document.createElement("i");
      sheet.picture.className = "timeline-picture";
      place.append(sheet.picture);
      const image = new Image();
      image.addEventListener("load", () => {
        const { across, down } = this.#grid;
        sheet.picture.style.aspectRatio = String(image.naturalWidth / across / (image.naturalHeight / down));
        sheet.picture.style.backgroundSize = `${100 * across}% ${100 * down}%`;
        sheet.picture.style.backgroundImage = `url("${sheet.sheet}")`;
      });
      image.src = sheet.sheet;
    }
  }

  #show(clientX) {
    const { left, width } = this.#axis.getBoundingClientRect();
    const x = clientX - left;
    const { rows, fps } = this.#clock;
    const row = rowAt(x, width, rows);
    for (const { picture } of this.#sheets) {
      if (!picture) continue;
      const { x: across, y: down } = tileAt(row, this.#grid);
      picture.style.backgroundPosition = `${across}% ${down}%`;
    }
    const reach = (NEAR * rows) / fps / Math.max(1, width);
    const near = this.#marks.filter(({ time }) => Math.abs(time - row / fps) <= reach).map(({ text }) => text);
    this.#box.querySelector("[data-words]").textContent = [`${this.stamp(row / fps)} · ${t("page.replay.row", "row {row}", { row })}`, ...near].join(" · ");
    this.#box.hidden = false;
    const half = this.#box.offsetWidth / 2;
    this.#box.style.left = `${Math.min(Math.max(x, half), width - half)}px`;
  }
}
