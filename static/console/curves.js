// Curves of one joint over the last seconds: where it is, where it was told to be, where the plan wants it.

import { keep } from "./decimate.js";
import { Trace } from "./trace.js";

const SECONDS = 20;
const ROWS = 60 * (SECONDS + 2);
const GAP_S = 0.5; // without news for so long: a gap, not a line
const DRAW_MS = 100;
const KINDS = [
  { name: "measured", colour: "--curve-1", width: 2 },
  { name: "commanded", colour: "--curve-2", width: 1.5 },
  { name: "planned", colour: "--curve-3", width: 1.5, dash: [4, 4] },
];

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

export class Curves {
  #element;
  #plot = null;
  #library = null;
  #trace = null;
  #names = [];
  #units = [];
  #joint = 0;
  #seen = new Set(); // kinds that have come
  #frozen = null;
  #addedAt = 0; // on this page's clock [ms]

  constructor({ element, library, names, units }) {
    this.#element = element;
    this.#library = library;
    this.joints(names, units);
    new ResizeObserver(() => this.#fit()).observe(element);
    document.addEventListener("eva:theme", () => this.#build());
    setInterval(() => this.#draw(), DRAW_MS);
    this.#build();
  }

  /** The joints' names and units, in the order of the vectors. */
  joints(names, units) {
    if (names.join() === this.#names.join()) return;
    this.#names = names;
    this.#units = units;
    this.#trace = new Trace({ dim: names.length, kinds: KINDS.map((kind) => kind.name), rows: ROWS });
  }

  /** One row of vectors {measured, commanded, planned} at `t` [s]. */
  add(t, vectors) {
    if (!this.#trace) return;
    if (t < this.#trace.newest - 1) this.#trace.clear(); // another server, another clock
    if (t - this.#trace.newest > GAP_S) this.#trace.add(t - 1e-3, {});
    this.#trace.add(t, vectors);
    this.#addedAt = performance.now();
    for (const kind of Object.keys(vectors)) this.#seen.add(kind);
  }

  show(joint) {
    this.#joint = joint;
    this.#frozen &&= this.#column();
    this.#draw(true);
  }

  get paused() {
    return this.#frozen !== null;
  }

  /** Stand still to be looked at, while the data goes on. */
  pause(paused) {
    this.#frozen = paused ? this.#column() : null;
    this.#draw(true);
  }

  /** Seconds since something came, where that is worth showing. */
  get #silence() {
    const seconds = (performance.now() - this.#addedAt) / 1000;
    return seconds > GAP_S ? seconds : 0;
  }

  #column() {
    const newest = this.#trace.newest + this.#silence; // without news the curve moves on and nothing follows it
    const { times, values } = this.#trace.joint(this.#joint, newest - SECONDS);
    return { times: times.map((t) => t - newest), values };
  }

  #draw(always = false) {
    if (!this.#plot || !this.#trace || document.hidden || (this.#frozen && !always)) return;
    if (!Number.isFinite(this.#trace.newest)) return;
    const { times, values } = this.#frozen ?? this.#column();
    const columns = KINDS.map((kind) => values[kind.name]);
    const kept = keep(columns, 2 * this.#plot.width);
    const blank = (value) => (Number.isNaN(value) ? null : value);
    this.#plot.setData([kept.map((at) => times[at]), ...columns.map((column) => kept.map((at) => blank(column[at])))]);
    this.#legend(columns);
  }

  #legend(columns) {
    const unit = this.#units[this.#joint] ?? "";
    for (const [index, kind] of KINDS.entries()) {
      const part = document.querySelector(`[data-curve="${kind.name}"]`);
      part.hidden = !this.#seen.has(kind.name);
      const value = this.#silence ? NaN : columns[index].at(-1);
      part.lastElementChild.textContent = Number.isFinite(value) ? `${kind.name} ${value.toFixed(3)} ${unit}` : `${kind.name} –`;
    }
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.#element;
    if (this.#plot && width && height) this.#plot.setSize({ width, height });
  }

  #build() {
    this.#plot?.destroy();
    const line = { stroke: css("--text-muted"), grid: { stroke: css("--hairline"), width: 1 }, ticks: { show: false }, font: `13px ${css("--font")}` };
    const options = {
      width: this.#element.clientWidth || 600,
      height: this.#element.clientHeight || 160,
      legend: { show: false },
      cursor: { drag: { x: false, y: false } },
      scales: { x: { time: false, range: [-SECONDS, 0] }, y: { range: (plot, low, high) => spread(low, high) } },
      axes: [
        { ...line, size: 24, values: (plot, ticks) => ticks.map((tick) => `${tick} s`) },
        { ...line, size: 56, values: (plot, ticks) => ticks.map((tick) => tick.toFixed(2)) },
      ],
      series: [{}, ...KINDS.map((kind) => ({ label: kind.name, stroke: css(kind.colour), width: kind.width, dash: kind.dash, points: { show: false } }))],
    };
    this.#plot = new this.#library(options, [[], ...KINDS.map(() => [])], this.#element);
    this.#draw(true);
  }
}

/** The range of the value axis: never so narrow that noise looks like motion. */
function spread(low, high) {
  if (low === null || !Number.isFinite(low)) return [-0.1, 0.1];
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.55, 0.02);
  return [middle - half, middle + half];
}

/** Legend entries for the page. */
export function legend(element) {
  for (const kind of KINDS) {
    const part = document.createElement("span");
    part.className = "legend";
    part.dataset.curve = kind.name;
    part.hidden = true;
    const swatch = document.createElement("i");
    swatch.style.background = `var(${kind.colour})`;
    part.append(swatch, document.createElement("span"));
    element.append(part);
  }
}
