// Bands, hairlines and ticks on the canvas of the curves.

import { css } from "../live/style.js";
import { GHOSTS } from "../scene/scene_ghosts.js";

const TICK = 7; // height [px]
const STRIP = 4; // height [px]
const MOST_SEAMS = 200; // more hairlines in one plot would look like an area

/** Paints on a uPlot plot; a new one is made when the theme changes. */
export class Paint {
  #seam = css("--mark-chunk");
  #band = css("--mark-overlap");
  #limit = css("--warn");
  #simulation = GHOSTS.simulated.colour;

  /** Paint what lies under the curves. */
  behind(plot, { bands, seams }) {
    inside(plot, (ctx, { top, height }) => {
      ctx.fillStyle = this.#band;
      for (const [from, to] of bands) ctx.fillRect(x(plot, from), top, Math.max(1, x(plot, to) - x(plot, from)), height);
      if (seams.length > MOST_SEAMS) return;
      ctx.fillStyle = this.#seam;
      for (const time of seams) ctx.fillRect(Math.round(x(plot, time)), top, Math.max(1, Math.round(devicePixelRatio)), height);
    });
  }

  /** Paint what lies over the curves: executions of a simulated robot along the top, changes by safety at the bottom. */
  over(plot, { limits, simulations }) {
    inside(plot, (ctx, { top, height }) => {
      ctx.fillStyle = this.#simulation;
      for (const [from, to] of simulations) ctx.fillRect(x(plot, from), top, Math.max(1, x(plot, to) - x(plot, from)), STRIP * devicePixelRatio);
      const tall = TICK * devicePixelRatio;
      ctx.fillStyle = this.#limit;
      for (const time of limits) ctx.fillRect(x(plot, time), top + height - tall, Math.max(2, 2 * devicePixelRatio), tall);
    });
  }
}

function x(plot, time) {
  return plot.valToPos(time, "x", true);
}

function inside(plot, paint) {
  const { left, top, width, height } = plot.bbox;
  plot.ctx.save();
  plot.ctx.beginPath();
  plot.ctx.rect(left, top, width, height);
  plot.ctx.clip();
  paint(plot.ctx, { top, height });
  plot.ctx.restore();
}
