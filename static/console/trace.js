// The last seconds of every joint: a ring of rows, one per frame, each holding one vector per kind of curve.

export class Trace {
  #times;
  #rows = {};
  #next = 0;
  #filled = 0;

  constructor({ dim, kinds, rows }) {
    this.dim = dim;
    this.size = rows;
    this.#times = new Float64Array(rows);
    for (const kind of kinds) this.#rows[kind] = new Float32Array(rows * dim).fill(NaN);
  }

  get newest() {
    return this.#filled ? this.#times[(this.#next - 1 + this.size) % this.size] : NaN;
  }

  /** Add one row at time `t` [s]; a kind without a vector has no value there. */
  add(t, vectors) {
    if (t <= this.newest) return; // a frame that was overtaken
    const at = this.#next;
    this.#times[at] = t;
    for (const [kind, rows] of Object.entries(this.#rows)) {
      const row = rows.subarray(at * this.dim, (at + 1) * this.dim);
      if (vectors[kind]?.length === this.dim) row.set(vectors[kind]);
      else row.fill(NaN);
    }
    this.#next = (at + 1) % this.size;
    this.#filled = Math.min(this.#filled + 1, this.size);
  }

  clear() {
    this.#filled = 0;
    this.#next = 0;
  }

  /** One joint's columns since `from`: {times, values: {kind: Float32Array}}, oldest first. */
  joint(index, from) {
    const times = [];
    const places = [];
    for (let back = this.#filled; back > 0; back -= 1) {
      const at = (this.#next - back + this.size) % this.size;
      if (this.#times[at] < from) continue;
      times.push(this.#times[at]);
      places.push(at);
    }
    const values = {};
    for (const [kind, rows] of Object.entries(this.#rows)) values[kind] = places.map((at) => rows[at * this.dim + index]);
    return { times, values };
  }
}
