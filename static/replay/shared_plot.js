// The curves of one joint in one or several episodes: state as a solid line, executed action dashed, one colour per episode.

import { axes, spread } from "../console/curves/curve_kinds.js";
import { css } from "../console/live/style.js";

export class SharedPlot {
  #plot;
  #element;
  #cursor = document.createElement("i");
  #sized;

  /**
   * `lines` are [{number, state, executed}] at `time`; `all` includes the lines of the other plots, for a common range of
   * values.
   */
  constructor({ element, library, time, lines, all, seek }) {
    this.#element = element;
    this.#cursor.className = "replay-cursor";
    const values = all.flatMap(({ state, executed }) => [...state, ...executed]).filter((value) => value !== null);
    const range = values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
    const colour = (number) => css(`--beside-${number}`);
    const series = lines.flatMap(({ number }) => [
      { label: `${number} state`, stroke: colour(number), width: 2, points: { show: false } },
      { label: `${number} executed`, stroke: colour(number), width: 1.5, dash: [6, 4], points: { show: false } },
    ]);
    const options = {
      width: element.clientWidth || 600,
      height: element.clientHeight || 160,
      legend: { show: false },
      cursor: { drag: { x: true, y: false }, points: { show: false } },
      scales: { x: { time: false }, y: { range: () => spread(...(values.length ? range : [0, 1])) } },
      axes: axes(),
      series: [{}, ...series],
    };
    this.#plot = new library(options, [time, ...lines.flatMap(({ state, executed }) => [state, executed])], element);
    this.#plot.over.append(this.#cursor);
    this.#plot.over.addEventListener("click", (event) => seek(this.#plot.posToVal(event.clientX - this.#plot.over.getBoundingClientRect().left, "x")));
    this.#sized = new ResizeObserver(() => element.clientWidth && this.#plot.setSize({ width: element.clientWidth, height: element.clientHeight }));
    this.#sized.observe(element);
  }

  /** Move the line of the clock to `time` [s]. */
  at(time) {
    const left = this.#plot.valToPos(time, "x");
    this.#cursor.hidden = left < 0 || left > this.#plot.over.clientWidth;
    this.#cursor.style.transform = `translateX(${left}px)`;
  }

  destroy() {
    this.#sized.disconnect();
    this.#plot.destroy();
    this.#element.replaceChildren();
  }
}
