// Which chunk owns each step, which chunks contributed to it, and what is known about each chunk.

import { lastNotAbove } from "../site/binary_search.js";

const NONE = -1;

export class Chunks {
  #time; // times of the ticks [s]
  #owner; // chunk with the largest weight; -1 for none, 0 for the held target
  #makers; // contributions to tick k are entries makers[k] up to, not including, makers[k + 1]
  #maker; // {chunk, weight}
  #known; // {id, observed, arrived, delay, mistimed, overlap, rows, first, last, strategy, inference}
  #strategies;
  #period;

  /** `ticks`, `makers` and `chunks` are streams of the episode's curves; `period` is the period of the ticks [s]. */
  constructor({ ticks, makers, chunks, strategies, period }) {
    this.#time = ticks.time;
    this.#owner = ticks.chunk;
    this.#makers = ticks.makers;
    this.#maker = makers;
    this.#known = chunks;
    this.#strategies = strategies;
    this.#period = period;
    this.spans = this.#spans((tick) => this.#owner[tick], NONE);
    this.overlaps = this.#spans((tick) => Number(this.#count(tick) > 1), 0).map(({ from, to }) => [from, to]);
  }

  #count(tick) {
    return this.#makers[tick + 1] - this.#makers[tick];
  }

  /**
   * Return the stretches of ticks with the same value as [{from, to, id, next}], from and to in seconds, without those of value
   * `none`.
   */
  #spans(value, none) {
    const found = [];
    for (let tick = 0; tick < this.#time.length; tick += 1) {
      const id = value(tick);
      const end = this.#end(tick);
      const open = found.at(-1);
      if (open && open.id === id && open.next === tick) Object.assign(open, { to: end, next: tick + 1 });
      else if (id !== none) found.push({ from: this.#time[tick], to: end, id, next: tick + 1 });
    }
    return found;
  }

  /** Return when the next tick begins, or 1.5 periods after this one if a gap follows. */
  #end(tick) {
    const next = this.#time[tick + 1] ?? Infinity;
    return Math.min(next, this.#time[tick] + 1.5 * this.#period);
  }

  /** Return the chunk that owns the step at `time`, or -1 if there is none. */
  ownerAt(time) {
    const tick = lastNotAbove(this.#time, time);
    return tick < 0 || time >= this.#end(tick) ? NONE : this.#owner[tick];
  }

  /** Return the contributions to the step at `time`: [{id, weight}], largest first. */
  makersAt(time) {
    const tick = lastNotAbove(this.#time, time);
    if (tick < 0) return [];
    const found = [];
    for (let at = this.#makers[tick]; at < this.#makers[tick + 1]; at += 1) found.push({ id: this.#maker.chunk[at], weight: this.#maker.weight[at] });
    return found.sort((one, other) => other.weight - one.weight);
  }

  /** Return what is known about chunk `id`; null for the held target and for a chunk that no policy gave. */
  about(id) {
    const at = lastNotAbove(this.#known.id, id);
    if (at < 0 || this.#known.id[at] !== id) return null;
    const told = Object.fromEntries(Object.entries(this.#known).map(([name, values]) => [name, values[at]]));
    return { ...told, strategy: this.#strategies[told.strategy] ?? "", seconds: told.arrived - told.observed };
  }
}
