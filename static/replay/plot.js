// The curves of one joint over the whole episode, with marks of what happened behind and over them.

import { AXIS, KINDS, SECOND, axes, blank, series, spread } from "../console/curves/curve_kinds.js";
import { css } from "../console/live/style.js";
import { LANE, Lane } from "./lane.js";

const LINES = KINDS.filter((kind) => kind.name !== "raw"); // raw is drawn chunk by chunk
const RAW = KINDS.find((kind) => kind.name === "raw");
const SAFETY_HEIGHT = 5; // px
const EVENT_HEIGHT = 7; // px
const FAINT = 0.6; // opacity of the answers of chunks that are not under the cursor

/** Return whether an event of that kind marks another strategy, or other parameters of it. */
export function isTuningEvent(kind) {
  return kind === "tuned" || kind === "tuned_to";
}

export class Plot {
  #element;
  #library;
  #strip;
  #over = new AbortController();
  #sized;
  #plot = null;
  #cursor = document.createElement("i");
  #data;
  #behind; // {held, marks, safety, owners}
  #raw = [];
  #second = null; // values of another signal, on the axis at the right
  #aligned = false; // true if another plot has an axis at the right
  #time = 0;
  #shown;
  #lane;
  #chosen = -1; // the chunk under the cursor
  #hover;

  /**
   * `strip` says whether the plot has the strip of the chunks and the labels of the time axis; plots below each other share
   * these.
   */
  constructor({ element, library, behind, strip, shown, seek, hover }) {
    this.#element = element;
    this.#library = library;
    this.#strip = strip ? LANE : 0;
    this.#behind = behind;
    this.#shown = shown;
    this.seek = seek;
    this.#hover = hover;
    this.#lane = new Lane(behind.owners);
    this.#cursor.className = "replay-cursor";
    this.#sized = new ResizeObserver(() => this.#fit());
    this.#sized.observe(element);
    document.addEventListener("eva:theme", () => this.#build(), { signal: this.#over.signal });
  }

  destroy() {
    this.#over.abort();
    this.#sized.disconnect();
    this.#plot?.destroy();
  }

  /** Draw `curves` {time, state, executed, smoothed} of one joint and `raw` [{id, times, values}], as the policy gave them. */
  show(curves, raw) {
    this.#raw = raw;
    this.#data = [Array.from(curves.time), ...LINES.map((kind) => blank(curves[kind.name]))];
    if (this.#plot) this.#plot.setData(this.#drawn);
    else this.#build();
    this.at(this.#time);
  }

  /** Draw another signal over the same time; null draws none. */
  beside(values) {
    this.#second = values && blank(values);
    this.#build();
  }

  /** Leave as much space at the right as a plot with an axis there. */
  align(on) {
    if (on === this.#aligned) return;
    this.#aligned = on;
    this.#build();
  }

  get #drawn() {
    return this.#second ? [...this.#data, this.#second] : this.#data;
  }

  /** Show or hide the curve of that name. */
  reveal(name, shown) {
    if (name === RAW.name) this.#plot?.redraw();
    else this.#plot?.setSeries(1 + LINES.findIndex((kind) => kind.name === name), { show: shown });
  }

  /** Move the line of the clock to `time` [s]. */
  at(time) {
    this.#time = time;
    if (!this.#plot) return;
    const left = this.#plot.valToPos(time, "x");
    this.#cursor.hidden = left < 0 || left > this.#plot.over.clientWidth;
    this.#cursor.style.transform = `translateX(${left}px)`;
  }

  /** Highlight the chunk with that number. */
  choose(id) {
    if (id === this.#chosen) return;
    this.#chosen = id;
    this.#plot?.redraw(false);
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.#element;
    if (this.#plot && width && height) this.#plot.setSize({ width, height });
    this.at(this.#time);
  }

  #build() {
    if (!this.#data) return;
    this.#plot?.destroy();
    const options = {
      width: this.#element.clientWidth || 600,
      height: this.#element.clientHeight || 160,
      padding: [this.#strip || 6, this.#aligned && !this.#second ? AXIS : null, null, null],
      legend: { show: false },
      cursor: { y: false, drag: { x: true, y: false }, points: { show: false }, sync: { key: "replay" } },
      scales: { x: { time: false }, ...Object.fromEntries(["y", "second"].map((name) => [name, { range: (plot, low, high) => spread(low, high) }])) },
      axes: this.#axes(),
      series: this.#series(),
      hooks: {
        drawAxes: [(plot) => this.#drawBehind(plot)],
        draw: [(plot) => this.#drawOver(plot)],
        setScale: [() => this.at(this.#time)],
        setCursor: [(plot) => this.#hover(plot.cursor.left >= 0 ? plot.posToVal(plot.cursor.left, "x") : null)],
      },
    };
    this.#plot = new this.#library(options, this.#drawn, this.#element);
    this.#plot.over.append(this.#cursor);
    this.#pick(this.#plot);
    this.at(this.#time);
  }

  #axes() {
    const [time, values] = axes();
    const found = this.#strip ? [time, values] : [{ ...time, size: 6, values: () => [] }, values];
    return this.#second ? [...found, { ...values, scale: "second", side: 1, grid: { show: false } }] : found;
  }

  #series() {
    const own = series(LINES, this.#shown);
    const { colour, width, dash } = SECOND;
    return this.#second ? [...own, { label: "second", scale: "second", stroke: css(colour), width, dash, points: { show: false } }] : own;
  }

  /** Let a click move the clock. A drag, which zooms in, does not; a double click zooms out again. */
  #pick(plot) {
    let pressed = null;
    plot.over.addEventListener("pointerdown", (event) => (pressed = event.clientX));
    plot.over.addEventListener("pointerup", (event) => {
      const moved = pressed === null || Math.abs(event.clientX - pressed) > 4;
      pressed = null;
      if (!moved) this.seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
  }

  /**
   * Draw inside the plot and `above` device pixels above it; `x(time)` converts times, and x.left and x.right are the plot's
   * edges.
   */
  #inside(plot, draw, above = 0) {
    const { left, top, width, height } = plot.bbox;
    const x = Object.assign((time) => plot.valToPos(time, "x", true), { left, right: left + width });
    plot.ctx.save();
    plot.ctx.beginPath();
    plot.ctx.rect(left, top - above, width, height + above);
    plot.ctx.clip();
    draw(plot.ctx, x, { left, top: top - above, width, height });
    plot.ctx.restore();
  }

  #drawBehind(plot) {
    this.#inside(plot, (ctx, x, place) => {
      const { top, height } = place;
      ctx.fillStyle = css("--warn-soft");
      for (const [from, to] of this.#behind.held) ctx.fillRect(x(from), top, Math.max(1, x(to) - x(from)), height);
      this.#lane.behind(ctx, x, place);
      for (const { time, kind } of this.#behind.marks) {
        const tall = isTuningEvent(kind) ? height : EVENT_HEIGHT * devicePixelRatio;
        ctx.fillStyle = css(isTuningEvent(kind) ? "--active" : "--text-normal");
        ctx.fillRect(Math.round(x(time)), top, 2 * devicePixelRatio, tall);
      }
      if (this.#shown(RAW.name)) this.#drawRaw(plot, ctx, x);
    });
    if (!this.#strip) return;
    const above = this.#strip * devicePixelRatio;
    this.#inside(plot, (ctx, x, place) => this.#lane.strip(ctx, x, { ...place, chosen: this.#chosen }), above);
  }

  /** Draw what each chunk wanted, with the one under the cursor on top. */
  #drawRaw(plot, ctx, x) {
    const own = ({ id }) => id === this.#chosen;
    const raw = this.#raw;
    ctx.strokeStyle = css(RAW.colour);
    const kinds = [
      [raw.filter((chunk) => !own(chunk)), 1, FAINT],
      [raw.filter(own), 2.5, 1],
    ];
    for (const [chunks, width, alpha] of kinds) {
      ctx.lineWidth = width * devicePixelRatio;
      ctx.globalAlpha = alpha;
      ctx.beginPath();
      for (const { times, values } of chunks) {
        values.forEach((value, index) => {
          const at = [x(times[index]), plot.valToPos(value, "y", true)];
          if (index) ctx.lineTo(...at);
          else ctx.moveTo(...at);
        });
      }
      ctx.stroke();
    }
    ctx.globalAlpha = 1;
  }

  #drawOver(plot) {
    this.#inside(plot, (ctx, x, { top, height }) => {
      const tall = SAFETY_HEIGHT * devicePixelRatio;
      for (const { time, refused } of this.#behind.safety) {
        ctx.fillStyle = css(refused ? "--danger" : "--warn");
        ctx.fillRect(x(time), top + height - tall * (refused ? 2 : 1), Math.max(1, devicePixelRatio), tall * (refused ? 2 : 1));
      }
    });
  }
}
