// The lane of the segments under the time axis: bands in the colours of their labels, with those that overlap below each other.
// A drag on the empty lane draws a segment. The ends of the user's own segments are moved by a drag, or by arrow keys while
// they have the focus.

import { t } from "../site/sentences.js";
import { overlaps, stackLanes } from "./review_lanes.js";

const SETTLED_MS = 700; // time [ms] after the last arrow key until the new end is saved

/** Return the row at `x` [px] on a lane that is `width` px wide. */
export function rowOn(x, width, rows) {
  return Math.min(rows - 1, Math.max(0, Math.floor((x / Math.max(1, width)) * rows)));
}

export class SegmentLane {
  #strip;
  #clock;
  #user;
  #drawn;
  #moved;
  #segments = [];
  #colours = new Map();
  #open = document.createElement("i"); // band of the segment that has no end yet
  #moving = null; // {segment, end, band, waiting}

  /**
   * `drawn({first, last})` is called with a new segment. `moved(segment)` is called with a segment of `user` whose end was
   * moved, and resolves when it is saved.
   */
  constructor({ strip, clock, user = "", drawn = null, moved = null }) {
    this.#strip = strip;
    this.#clock = clock;
    this.#user = user;
    this.#drawn = drawn;
    this.#moved = moved;
    this.#open.className = "lane-band lane-segment";
    this.#open.dataset.open = "";
    if (drawn) strip.addEventListener("pointerdown", (event) => event.target === strip && event.button === 0 && this.#draw(event));
  }

  /** Show segments [{uuid, first, last, label, milestone, annotator}]; `colours` maps labels to colours. */
  show(segments, colours = this.#colours) {
    this.#segments = segments;
    this.#colours = colours;
    if (!this.#moving) this.#render();
  }

  /** Show the segment that has no end yet; null shows none. */
  open(span) {
    this.#open.remove();
    if (!span) return;
    this.#place(this.#open, { first: Math.min(span.first, span.last), last: Math.max(span.first, span.last), lane: 0 });
    this.#open.dataset.colour = this.#colours.get(span.label) ?? "";
    this.#open.textContent = span.label || "…";
    this.#strip.append(this.#open);
  }

  #render() {
    const { uuid, end } = this.#focused();
    const open = this.#open.isConnected;
    const placed = stackLanes(this.#segments);
    this.#strip.style.setProperty("--lanes", String(1 + Math.max(0, ...placed.map(({ lane }) => lane))));
    this.#strip.replaceChildren(...placed.map((one) => this.#band(one)), ...overlaps(this.#segments).map((one) => this.#overlap(one)));
    if (open) this.#strip.append(this.#open);
    if (uuid) this.#strip.querySelector(`[data-uuid="${CSS.escape(uuid)}"] [data-end="${end}"]`)?.focus();
  }

  #focused() {
    const held = document.activeElement;
    const band = this.#strip.contains(held) ? held.closest("[data-uuid]") : null;
    return band ? { uuid: band.dataset.uuid, end: held.dataset.end } : {};
  }

  #place(element, { first, last, lane }) {
    element.style.left = `${(100 * first) / this.#clock.rows}%`;
    element.style.width = `${(100 * (last - first + 1)) / this.#clock.rows}%`;
    element.style.setProperty("--lane", String(lane));
  }

  #overlap(span) {
    const part = Object.assign(document.createElement("i"), { className: "lane-overlap" });
    this.#place(part, { ...span, lane: 0 });
    return part;
  }

  #band(segment) {
    const band = document.createElement("div");
    band.className = "lane-band lane-segment";
    Object.assign(band.dataset, { uuid: segment.uuid, colour: this.#colours.get(segment.label) ?? "" });
    this.#place(band, segment);
    const name = Object.assign(document.createElement("button"), { type: "button", className: "segment-name clip", textContent: segment.label });
    name.dataset.end = "name";
    name.title = t("page.segments.title", "{label}, rows {first} to {last}, {who}", { label: segment.label, first: segment.first, last: segment.last, who: segment.annotator });
    name.addEventListener("click", () => this.#clock.seekRow(segment.first));
    band.append(name);
    const own = segment.annotator === this.#user && Boolean(this.#moved);
    band.dataset.own = String(own);
    if (own) band.append(...["first", "last"].map((end) => this.#end(segment, end, band)));
    return band;
  }

  /** Return the handle that moves one end of a segment. */
  #end(segment, end, band) {
    const handle = document.createElement("i");
    handle.className = "segment-end";
    handle.tabIndex = 0;
    handle.setAttribute("role", "slider");
    const { label } = segment;
    handle.setAttribute("aria-label", end === "first" ? t("page.segments.first_row", "First row of {label}", { label }) : t("page.segments.last_row", "Last row of {label}", { label }));
    handle.dataset.end = end;
    this.#say(handle, segment, end);
    handle.addEventListener("pointerdown", (event) => this.#drag(event, handle, { segment: { ...segment }, end, band }));
    handle.addEventListener("keydown", (event) => this.#key(event, handle, { segment: { ...segment }, end, band }));
    handle.addEventListener("blur", () => this.#settle());
    return handle;
  }

  #say(handle, segment, end) {
    const row = segment[end];
    const [low, high] = end === "first" ? [0, segment.last] : [segment.first, this.#clock.rows - 1];
    const said = { valuemin: low, valuemax: high, valuenow: row, valuetext: t("page.segments.row_at", "row {row}, {seconds} s", { row, seconds: (row / this.#clock.fps).toFixed(2) }) };
    for (const [name, value] of Object.entries(said)) handle.setAttribute(`aria-${name}`, String(value));
  }

  #row(clientX) {
    const { left, width } = this.#strip.getBoundingClientRect();
    return rowOn(clientX - left, width, this.#clock.rows);
  }

  /** Move an end to a row, not beyond the other end, and show the picture of that row. */
  #to(row, handle, { segment, end, band }) {
    const { rows } = this.#clock;
    segment[end] = end === "first" ? Math.min(Math.max(0, row), segment.last) : Math.max(Math.min(rows - 1, row), segment.first);
    this.#place(band, { ...segment, lane: segment.lane });
    this.#say(handle, segment, end);
    this.#clock.pause();
    this.#clock.seekRow(segment[end]);
  }

  #drag(event, handle, move) {
    if (event.button !== 0) return;
    event.preventDefault(); // keeps the focus away, so that arrow keys still move the clock
    this.#settle();
    this.#moving = move;
    handle.setPointerCapture(event.pointerId);
    const over = new AbortController();
    const { signal } = over;
    handle.addEventListener("pointermove", ({ clientX }) => this.#to(this.#row(clientX), handle, move), { signal });
    const done = (keep) => {
      over.abort();
      this.#leave(move, keep);
    };
    handle.addEventListener("pointerup", () => done(true), { signal });
    handle.addEventListener("pointercancel", () => done(false), { signal });
  }

  #key(event, handle, fresh) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const move = this.#moving ?? fresh;
    if (event.key === "Escape" && this.#moving) {
      event.stopPropagation();
      this.#leave(this.#moving, false);
      return;
    }
    const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    if (!way) return;
    event.preventDefault();
    event.stopPropagation(); // the arrow keys of the page move the clock
    clearTimeout(move.waiting);
    this.#moving = move;
    this.#to(move.segment[move.end] + way * (event.shiftKey ? Math.round(this.#clock.fps) : 1), handle, move);
    move.waiting = setTimeout(() => this.#settle(), SETTLED_MS);
  }

  #settle() {
    if (this.#moving?.waiting) this.#leave(this.#moving, true);
  }

  /** Save what was moved, or restore the previous state. */
  async #leave(move, keep) {
    clearTimeout(move.waiting);
    move.waiting = null;
    const before = this.#segments.find(({ uuid }) => uuid === move.segment.uuid);
    const changed = before && (before.first !== move.segment.first || before.last !== move.segment.last);
    if (keep && changed) await this.#moved(move.segment);
    if (move.waiting) return; // an arrow key was pressed meanwhile: its change is saved next
    if (this.#moving === move) this.#moving = null;
    if (!this.#moving) this.#render();
  }

  #draw(event) {
    const first = this.#row(event.clientX);
    let last = first;
    this.#strip.setPointerCapture(event.pointerId);
    this.#clock.pause();
    this.#clock.seekRow(first);
    const over = new AbortController();
    const { signal } = over;
    const move = ({ clientX }) => {
      last = this.#row(clientX);
      this.open({ first, last, label: "" });
      this.#clock.seekRow(last);
    };
    this.#strip.addEventListener("pointermove", move, { signal });
    this.#strip.addEventListener("pointercancel", () => (over.abort(), this.open(null)), { signal });
    this.#strip.addEventListener(
      "pointerup",
      () => {
        over.abort();
        if (last !== first) this.#drawn({ first: Math.min(first, last), last: Math.max(first, last) });
      },
      { signal },
    );
  }
}
