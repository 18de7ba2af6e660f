// The last seconds of every joint: a ring of samples, each with one vector per kind of curve and columns about its chunks.

/** Columns of a sample besides the curves, with their values if nothing is known. */
const COLUMNS = { chunk: -1, chunks: 0, limited: 0, simulated: 0 };

export class Trace {
  #times;
  #rows = {};
  #columns = {};
  #window; // buffers for the result of `joint`, so that drawing allocates nothing
  #next = 0;
  #filled = 0;

  constructor({ dim, kinds, rows }) {
    this.dim = dim;
    this.size = rows;
    this.#times = new Float64Array(rows);
    this.#window = { times: new Float64Array(rows), values: {}, columns: {} };
    for (const kind of kinds) {
      this.#rows[kind] = new Float32Array(rows * dim).fill(NaN);
      this.#window.values[kind] = new Float32Array(rows);
    }
    for (const column of Object.keys(COLUMNS)) {
      this.#columns[column] = new Int32Array(rows);
      this.#window.columns[column] = new Int32Array(rows);
    }
  }

  get newest() {
    return this.#filled ? this.#times[(this.#next - 1 + this.size) % this.size] : NaN;
  }

  /** Add the sample at time `t` [s]: a vector per kind, missing for kinds without a value, and its columns. */
  add(t, vectors, columns = {}) {
    if (t <= this.newest) return; // known already
    const at = this.#next;
    this.#times[at] = t;
    for (const [kind, rows] of Object.entries(this.#rows)) {
      if (vectors[kind]?.length === this.dim) rows.set(vectors[kind], at * this.dim);
      else rows.fill(NaN, at * this.dim, (at + 1) * this.dim);
    }
    for (const [column, absent] of Object.entries(COLUMNS)) this.#columns[column][at] = columns[column] ?? absent;
    this.#next = (at + 1) % this.size;
    this.#filled = Math.min(this.#filled + 1, this.size);
  }

  clear() {
    this.#filled = 0;
    this.#next = 0;
  }

  /** Return a copy of the samples that does not change when this trace goes on. */
  copy() {
    const twin = new Trace({ dim: this.dim, kinds: Object.keys(this.#rows), rows: this.size });
    twin.#times.set(this.#times);
    for (const [kind, rows] of Object.entries(this.#rows)) twin.#rows[kind].set(rows);
    for (const [column, rows] of Object.entries(this.#columns)) twin.#columns[column].set(rows);
    twin.#next = this.#next;
    twin.#filled = this.#filled;
    return twin;
  }

  /**
   * Return one joint since `from` [s], oldest first: {times, values: {kind: numbers}, columns: {name: numbers}}. Times count
   * from `zero` [s]. The next call overwrites the result.
   */
  joint(index, from, zero = 0) {
    const { times, values, columns } = this.#window;
    let count = 0;
    for (let back = this.#filled; back > 0; back -= 1) {
      const at = (this.#next - back + this.size) % this.size;
      if (this.#times[at] < from) continue;
      times[count] = this.#times[at] - zero;
      for (const kind in values) values[kind][count] = this.#rows[kind][at * this.dim + index];
      for (const column in columns) columns[column][count] = this.#columns[column][at];
      count += 1;
    }
    const some = (found) => Object.fromEntries(Object.entries(found).map(([name, numbers]) => [name, numbers.subarray(0, count)]));
    return { times: times.subarray(0, count), values: some(values), columns: some(columns) };
  }
}
