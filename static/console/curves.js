// Curves of one joint over the last seconds: where it is, what the policy wants, what was planned, what was sent.

import { KINDS, axes, blank, series, spread } from "./curve_kinds.js";
import { keep } from "./decimate.js";
import { Trace } from "./trace.js";

const SECONDS = 20;
const ROWS = 60 * (SECONDS + 2);
const GAP_S = 0.5; // without news for so long: a gap, not a line
const DRAW_MS = 100;

export class Curves {
  #element;
  #plot = null;
  #library = null;
  #legend;
  #trace = null;
  #names = [];
  #joint = 0;
  #frozen = null;
  #addedAt = 0; // on this page's clock [ms]

  constructor({ element, library, legend, names }) {
    this.#element = element;
    this.#library = library;
    this.#legend = legend;
    this.joints(names);
    new ResizeObserver(() => this.#fit()).observe(element);
    document.addEventListener("eva:theme", () => this.#build());
    setInterval(() => this.#draw(), DRAW_MS);
    this.#build();
  }

  /** The joints' names, in the order of the vectors. */
  joints(names) {
    if (names.join() === this.#names.join()) return;
    this.#names = names;
    this.#trace = new Trace({ dim: names.length, kinds: KINDS.map((kind) => kind.name), rows: ROWS });
  }

  /** One row of vectors by the kinds' names at `t` [s]; NaN, or a kind that is not there: a gap. */
  add(t, vectors) {
    if (!this.#trace) return;
    if (t < this.#trace.newest - 1) this.#trace.clear(); // another server, another clock
    if (t - this.#trace.newest > GAP_S) this.#trace.add(t - 1e-3, {});
    this.#trace.add(t, vectors);
    this.#addedAt = performance.now();
  }

  /** Draw that joint. */
  show(joint) {
    this.#joint = joint;
    this.#frozen &&= this.#column();
    this.#draw(true);
  }

  /** Draw the curve of that name, or leave it out. */
  reveal(name, shown) {
    this.#plot.setSeries(1 + KINDS.findIndex((kind) => kind.name === name), { show: shown });
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
    this.#plot.setData([kept.map((at) => times[at]), ...columns.map((column) => blank(kept.map((at) => column[at])))]);
    this.#tell();
  }

  /** The values under the cursor, else the newest ones; what is old has none. */
  #tell() {
    const at = this.#plot.cursor.idx;
    const newest = this.#silence && !this.#frozen ? () => NaN : (column) => column.at(-1) ?? NaN;
    for (const [index, kind] of KINDS.entries()) {
      const column = this.#plot.data[index + 1];
      this.#legend.value(kind.name, Number.isInteger(at) ? (column[at] ?? NaN) : newest(column));
    }
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.#element;
    if (this.#plot && width && height) this.#plot.setSize({ width, height });
  }

  #build() {
    this.#plot?.destroy();
    const options = {
      width: this.#element.clientWidth || 600,
      height: this.#element.clientHeight || 160,
      legend: { show: false },
      cursor: { drag: { x: false, y: false }, points: { show: false } },
      scales: { x: { time: false, range: [-SECONDS, 0] }, y: { range: (plot, low, high) => spread(low, high) } },
      axes: axes(),
      series: series(KINDS, (name) => this.#legend.shown(name)),
      hooks: { setCursor: [(plot) => plot === this.#plot && this.#tell()] },
    };
    this.#plot = new this.#library(options, [[], ...KINDS.map(() => [])], this.#element);
    this.#draw(true);
  }
}
