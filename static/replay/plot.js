// The curves of one joint over the whole episode, with what happened drawn behind and over them.

import { KINDS, axes, blank, css, series, spread } from "../console/curve_kinds.js";

const LINES = KINDS.filter((kind) => kind.name !== "raw"); // raw is drawn chunk by chunk
const RAW = KINDS.find((kind) => kind.name === "raw");
const SAFETY_HEIGHT = 5; // px

export class Plot {
  #element;
  #library;
  #plot = null;
  #cursor = document.createElement("i");
  #data;
  #behind; // {held, marks, safety, chunks}
  #time = 0;
  #shown;

  constructor({ element, library, behind, shown, seek }) {
    this.#element = element;
    this.#library = library;
    this.#behind = behind;
    this.#shown = shown;
    this.seek = seek;
    this.#cursor.className = "replay-cursor";
    new ResizeObserver(() => this.#fit()).observe(element);
    document.addEventListener("eva:theme", () => this.#build());
  }

  /** `curves`: {time, state, executed, smoothed} of one joint; `chunks`: [{times, values}] as the policy gave them. */
  show(curves, chunks) {
    this.#behind.chunks = chunks;
    this.#data = [Array.from(curves.time), ...LINES.map((kind) => blank(curves[kind.name]))];
    if (this.#plot) this.#plot.setData(this.#data);
    else this.#build();
    this.at(this.#time);
  }

  /** Draw the curve of that name, or leave it out. */
  reveal(name, shown) {
    if (name === RAW.name) this.#plot?.redraw();
    else this.#plot?.setSeries(1 + LINES.findIndex((kind) => kind.name === name), { show: shown });
  }

  /** Move the line of the clock. */
  at(time) {
    this.#time = time;
    if (!this.#plot) return;
    const left = this.#plot.valToPos(time, "x");
    this.#cursor.hidden = left < 0 || left > this.#plot.over.clientWidth;
    this.#cursor.style.transform = `translateX(${left}px)`;
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
      legend: { show: false },
      cursor: { drag: { x: true, y: false }, points: { show: false } },
      scales: { x: { time: false }, y: { range: (plot, low, high) => spread(low, high) } },
      axes: axes(),
      series: series(LINES, this.#shown),
      hooks: {
        drawAxes: [(plot) => this.#drawBehind(plot)],
        draw: [(plot) => this.#drawOver(plot)],
        setScale: [() => this.at(this.#time)],
      },
    };
    this.#plot = new this.#library(options, this.#data, this.#element);
    this.#plot.over.append(this.#cursor);
    this.#pick(this.#plot);
    this.at(this.#time);
  }

  /** A click goes there; a drag looks closer, a double click at everything. */
  #pick(plot) {
    let pressed = null;
    plot.over.addEventListener("pointerdown", (event) => (pressed = event.clientX));
    plot.over.addEventListener("pointerup", (event) => {
      const moved = pressed === null || Math.abs(event.clientX - pressed) > 4;
      pressed = null;
      if (!moved) this.seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
  }

  #inside(plot, draw) {
    const { left, top, width, height } = plot.bbox;
    plot.ctx.save();
    plot.ctx.beginPath();
    plot.ctx.rect(left, top, width, height);
    plot.ctx.clip();
    draw(plot.ctx, (time) => plot.valToPos(time, "x", true), { top, height });
    plot.ctx.restore();
  }

  #drawBehind(plot) {
    this.#inside(plot, (ctx, x, { top, height }) => {
      ctx.fillStyle = css("--holding-soft");
      for (const [from, to] of this.#behind.held) ctx.fillRect(x(from), top, Math.max(1, x(to) - x(from)), height);
      ctx.fillStyle = css("--edge");
      for (const { time } of this.#behind.marks) ctx.fillRect(Math.round(x(time)), top, 1, height);
      if (!this.#shown(RAW.name)) return;
      ctx.strokeStyle = css(RAW.colour);
      ctx.lineWidth = devicePixelRatio;
      ctx.beginPath();
      for (const { times, values } of this.#behind.chunks) {
        values.forEach((value, index) => {
          const at = [x(times[index]), plot.valToPos(value, "y", true)];
          if (index) ctx.lineTo(...at);
          else ctx.moveTo(...at);
        });
      }
      ctx.stroke();
    });
  }

  #drawOver(plot) {
    this.#inside(plot, (ctx, x, { top, height }) => {
      const tall = SAFETY_HEIGHT * devicePixelRatio;
      for (const { time, refused } of this.#behind.safety) {
        ctx.fillStyle = css(refused ? "--faulted" : "--holding");
        ctx.fillRect(x(time), top + height - tall * (refused ? 2 : 1), Math.max(1, devicePixelRatio), tall * (refused ? 2 : 1));
      }
    });
  }
}
