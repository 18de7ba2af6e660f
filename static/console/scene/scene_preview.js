// A proposed chunk as a film: the ghost goes through its rows as fast as the robot would, again and again.

const REST_S = 0.7; // at its end, before it begins again

/**
 * Where the film is `seconds` after it began, with keyframes at `rows` (row numbers) of a chunk whose rows are
 * `period` seconds apart: {from, to, share} between two keyframes.
 */
export function moment(rows, period, seconds) {
  const last = rows.length - 1;
  const length = rows[last] * period;
  const row = Math.min(seconds % (length + REST_S), length) / period;
  let from = 0;
  while (from < last && rows[from + 1] <= row) from += 1;
  const to = Math.min(from + 1, last);
  const span = rows[to] - rows[from];
  return { from, to, share: span ? (row - rows[from]) / span : 0 };
}

export class Preview {
  #rows = [];
  #numbers = null; // [N * P * 16]
  #pose = null; // [P * 16], of this moment
  #began = 0; // on this page's clock [ms]
  #period;

  /** Show `numbers`, matrices of all parts at each of `rows`, from the first on. */
  begin(rows, numbers, period) {
    this.#rows = rows;
    this.#numbers = numbers;
    this.#pose = new Float32Array(numbers.length / rows.length);
    this.#period = period;
    this.#began = performance.now();
  }

  end() {
    this.#numbers = null;
  }

  /** The parts at `now` [ms], null where nothing is shown; overwritten by the next call. */
  at(now) {
    if (!this.#numbers) return null;
    const { from, to, share } = moment(this.#rows, this.#period, (now - this.#began) / 1000);
    const size = this.#pose.length;
    for (let place = 0; place < size; place += 1) {
      const before = this.#numbers[from * size + place];
      this.#pose[place] = before + share * (this.#numbers[to * size + place] - before);
    }
    return this.#pose;
  }
}
