// A proposed chunk as an animation: the ghost goes through its rows at the robot's speed, again and again.

const REST_S = 0.7; // pause at the end, before it begins again

/**
 * Return the position `seconds` after the start, with keyframes at `rows` (row numbers) of a chunk whose rows are `period`
 * seconds apart: {from, to, share} between two keyframes.
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
  #pose = null; // [P * 16] at the present moment
  #began = 0; // on this page's clock [ms]
  #period;

  /** Start the animation of `numbers`, matrices of all parts at each of `rows`. */
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

  /** Return the matrices of the parts at `now` [ms], or null if nothing is shown; the next call overwrites them. */
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
