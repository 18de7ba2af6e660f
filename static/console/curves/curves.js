// Curves of one joint over the last seconds: its state, what the policy wants, what was planned, what was sent.

import { lastNotAbove } from "../../site/binary_search.js";
import { KINDS, axes, series, spread } from "./curve_kinds.js";
import { marks } from "./curve_marks.js";
import { Paint } from "./curve_paint.js";
import { decimate } from "./decimate.js";
import { Trace } from "./trace.js";

const SECONDS = 20;
const ROWS = 60 * (SECONDS + 2);
const GAP_S = 0.5; // time [s] without samples from which there is a gap instead of a line
const DRAW_MS = 100;
const WHOLE = [-SECONDS, 0];
const LEAST_S = 0.2; // shortest time range to zoom into
const NO_MARKS = { seams: [], bands: [], limits: [], simulations: [] };

export class Curves {
  #element;
  #plot = null;
  #paint = null;
  #library;
  #legend;
  #markLegend;
  #trace = null;
  #names = [];
  #joint = 0;
  #span = WHOLE; // time range that is drawn [s]
  #frozen = null; // copy of the trace while paused
  #frozenAt = 0; // on this page's clock [ms]
  #marks = NO_MARKS;
  #columns = null; // columns of the samples that are drawn, with their times
  #data = [[], ...KINDS.map(() => [])]; // as uPlot takes them
  #addedAt = 0; // on this page's clock [ms]
  #over = new AbortController();

  constructor({ element, library, legend, markLegend, names }) {
    this.#element = element;
    this.#library = library;
    this.#legend = legend;
    this.#markLegend = markLegend;
    this.joints(names);
    const sized = new ResizeObserver(() => this.#fit());
    sized.observe(element);
    document.addEventListener("eva:theme", () => this.#build(), { signal: this.#over.signal });
    const drawing = setInterval(() => this.#draw(), DRAW_MS);
    this.#over.signal.addEventListener("abort", () => {
      sized.disconnect();
      clearInterval(drawing);
      this.#plot?.destroy();
      this.#plot = null;
    });
    this.#build();
  }

  /** Stop drawing and release the plot. */
  end() {
    this.#over.abort();
  }

  /** Set the joints' names, in the order of the vectors. */
  joints(names) {
    if (names.join() === this.#names.join()) return;
    this.#names = names;
    this.#frozen = null;
    this.#trace = new Trace({ dim: names.length, kinds: KINDS.map((kind) => kind.name), rows: ROWS });
  }

  /**
   * Add samples, some of which may be known already: {t [s], chunk, chunks, limited, simulated, curves}. The columns have one
   * length K; `curves` has [K * D] numbers for each kind, where NaN is a gap.
   */
  add({ t, curves, ...columns }) {
    const dim = this.#names.length;
    if (!dim || Object.values(curves).some((numbers) => numbers.length !== t.length * dim)) return;
    if (t.at(-1) < this.#trace.newest - 1) this.#trace.clear(); // another server with another clock
    const sample = {};
    const vectors = {};
    for (let at = 0; at < t.length; at += 1) {
      if (t[at] <= this.#trace.newest) continue;
      if (t[at] - this.#trace.newest > GAP_S) this.#trace.add(t[at] - 1e-3, {});
      for (const name in columns) sample[name] = Number(columns[name][at]);
      for (const kind in curves) vectors[kind] = curves[kind].subarray(at * dim, (at + 1) * dim);
      this.#trace.add(t[at], vectors, sample);
      this.#addedAt = performance.now();
    }
  }

  /** Draw that joint. */
  show(joint) {
    this.#joint = joint;
    this.#draw(true);
  }

  /** Show or hide the curve of that name. */
  reveal(name, shown) {
    this.#plot.setSeries(1 + KINDS.findIndex((kind) => kind.name === name), { show: shown });
  }

  get paused() {
    return this.#frozen !== null;
  }

  /** Freeze what is drawn, so that it can be examined joint by joint, while data is still recorded. */
  pause(paused) {
    this.#frozen = paused ? this.#trace.copy() : null;
    this.#frozenAt = performance.now();
    this.#span = WHOLE;
    this.#draw(true);
  }

  /** How long it has been paused [s]. */
  get pausedFor() {
    return (performance.now() - this.#frozenAt) / 1000;
  }

  /** True if part of what is drawn was executed by a simulated robot. */
  get simulated() {
    return this.#marks.simulations.length > 0;
  }

  /** Seconds since the last sample; 0 if that is too short to show, or while paused. */
  get #silence() {
    const seconds = (performance.now() - this.#addedAt) / 1000;
    return seconds > GAP_S && !this.#frozen ? seconds : 0;
  }

  #draw(always = false) {
    const trace = this.#frozen ?? this.#trace;
    if (!this.#plot || !trace || document.hidden || (this.#frozen && !always)) return;
    if (!Number.isFinite(trace.newest)) return;
    const now = trace.newest + this.#silence; // without samples the curves still move on, and nothing follows them
    const { times, values, columns } = trace.joint(this.#joint, now - SECONDS, now);
    this.#marks = marks(times, columns);
    this.#columns = { times, ...columns };
    this.#fill(times, KINDS.map((kind) => values[kind.name]));
    this.#plot.setData(this.#data);
    this.#tell();
  }

  /** Fill the plot's data with the thinned columns; NaN becomes null for uPlot. */
  #fill(times, columns) {
    const kept = decimate(columns, 2 * this.#plot.width);
    this.#data.forEach((numbers, index) => {
      const column = index ? columns[index - 1] : times;
      numbers.length = kept.length;
      for (let at = 0; at < kept.length; at += 1) numbers[at] = Number.isNaN(column[kept[at]]) ? null : column[kept[at]];
    });
  }

  /** Show the values under the cursor or, without a cursor, the newest; without recent samples there is none. */
  #tell() {
    const at = this.#plot.cursor.idx;
    const chosen = Number.isInteger(at);
    const none = !chosen && this.#silence > 0;
    for (const [index, kind] of KINDS.entries()) {
      const column = this.#data[index + 1];
      this.#legend.value(kind.name, none ? NaN : ((chosen ? column[at] : column.at(-1)) ?? NaN));
    }
    this.#markLegend.show(none ? null : this.#sample(chosen ? this.#data[0][at] : 0));
  }

  #sample(time) {
    if (!this.#columns || time === undefined) return null;
    const { times, ...columns } = this.#columns;
    const at = lastNotAbove(times, time + 1e-6);
    return at < 0 ? null : Object.fromEntries(Object.entries(columns).map(([name, numbers]) => [name, numbers[at]]));
  }

  /** Zoom in to a dragged range while paused; a double click shows everything again. */
  #closer(plot) {
    const { left, width } = plot.select;
    const [from, to] = [left, left + width].map((at) => plot.posToVal(at, "x"));
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (this.#frozen && width > 0 && to - from > LEAST_S) this.#look([from, to]);
  }

  #look(span) {
    this.#span = span;
    this.#draw(true);
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.#element;
    if (this.#plot && width && height) this.#plot.setSize({ width, height });
  }

  #build() {
    this.#plot?.destroy();
    this.#paint = new Paint();
    const options = {
      width: this.#element.clientWidth || 600,
      height: this.#element.clientHeight || 160,
      legend: { show: false },
      cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, bind: { dblclick: () => () => this.#look(WHOLE) } },
      scales: { x: { time: false, range: () => this.#span }, y: { range: (plot, low, high) => spread(low, high) } },
      axes: axes(),
      series: series(KINDS, (name) => this.#legend.shown(name)),
      hooks: {
        setCursor: [(plot) => plot === this.#plot && this.#tell()],
        setSelect: [(plot) => plot === this.#plot && this.#closer(plot)],
        drawAxes: [(plot) => this.#paint.behind(plot, this.#marks)],
        draw: [(plot) => this.#paint.over(plot, this.#marks)],
      },
    };
    this.#plot = new this.#library(options, [[], ...KINDS.map(() => [])], this.#element);
    this.#draw(true);
  }
}
