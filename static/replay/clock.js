// The one clock of a page: row k is shown from k / fps on.

const LONGEST_STEP_S = 0.25; // prevents a jump after a tab was suspended
const ROUNDING = 1e-6; // rows: sums of small steps end slightly below the row that they reach

export class Clock extends EventTarget {
  #fps;
  #frames;
  #time = 0;
  #rate = 1;
  #playing = false;
  #ready = [];
  #before = 0;
  #range = null; // {from, to}: first row that is played, and the row after the last one
  #loop = false;

  constructor({ fps, frames }) {
    super();
    this.#fps = fps;
    this.#frames = frames;
  }

  /** `ready()` returns whether something that follows the clock can continue; the clock waits until all can. */
  waitFor(ready) {
    this.#ready.push(ready);
  }

  get time() {
    return this.#time;
  }

  get row() {
    return Math.min(this.#frames - 1, Math.floor(this.#time * this.#fps + ROUNDING));
  }

  get rows() {
    return this.#frames;
  }

  get fps() {
    return this.#fps;
  }

  get duration() {
    return this.#frames / this.#fps;
  }

  get playing() {
    return this.#playing;
  }

  get rate() {
    return this.#rate;
  }

  set rate(rate) {
    this.#rate = rate;
    this.#tell("rate");
  }

  /** The rows that are played, [from, to); all rows if no range is set. */
  get range() {
    return this.#range ?? { from: 0, to: this.#frames };
  }

  /** True if only a part is played. */
  get narrowed() {
    return this.#range !== null;
  }

  /** Play only the rows from `from` to before `to`; null plays all. */
  narrow(range) {
    const from = range && Math.min(Math.max(0, Math.floor(range.from)), this.#frames - 1);
    this.#range = range && { from, to: Math.min(Math.max(from + 1, Math.floor(range.to)), this.#frames) };
    this.#tell("range");
  }

  get loop() {
    return this.#loop;
  }

  set loop(loop) {
    this.#loop = loop;
    this.#tell("range");
  }

  play() {
    if (this.#playing) return;
    const { from, to } = this.range;
    if (this.row >= to - 1 || this.row < from) this.seekRow(from);
    this.#playing = true;
    this.#before = performance.now();
    requestAnimationFrame((now) => this.#go(now));
    this.#tell("play");
  }

  pause() {
    if (!this.#playing) return;
    this.#playing = false;
    this.#tell("pause");
    this.seekRow(this.row);
  }

  toggle() {
    if (this.#playing) this.pause();
    else this.play();
  }

  /** Go to a time [s]; everything that follows the clock jumps there. */
  seek(time) {
    this.#time = Math.min(Math.max(0, time), this.duration);
    this.#tell("seek");
  }

  /** Go to the start of a row. */
  seekRow(row) {
    this.seek(Math.min(Math.max(0, row), this.#frames - 1) / this.#fps);
  }

  /** Pause and move by `count` rows, negative for back. */
  step(count) {
    this.pause();
    this.seekRow(this.row + count);
  }

  #go(now) {
    if (!this.#playing) return;
    const passed = Math.min(Math.max(0, now - this.#before) / 1000, LONGEST_STEP_S);
    this.#before = now;
    if (this.#ready.every((ready) => ready())) this.#advance(passed * this.#rate);
    if (!this.#playing) return;
    requestAnimationFrame((next) => this.#go(next));
  }

  #advance(by) {
    const end = this.range.to / this.#fps;
    const over = (this.#time + by) * this.#fps + ROUNDING >= this.range.to; // with the same rounding as `row`
    this.#time = Math.min(this.#time + by, end);
    if (over && this.#loop) {
      this.seekRow(this.range.from);
      return;
    }
    this.#tell("tick");
    if (!over) return;
    const last = this.range.to - 1;
    this.pause();
    this.seekRow(last); // the last row stays visible at the end, not the one after it
  }

  #tell(kind) {
    this.dispatchEvent(new Event(kind));
    if (kind !== "tick") this.dispatchEvent(new Event("change"));
  }
}

/**
 * The clock of one of several episodes: the shared clock, `offset` seconds later. It stands still before the episode's first
 * row and after its last.
 */
export class Shifted extends EventTarget {
  #clock;
  #offset;

  constructor(clock, { fps, frames }, offset = 0) {
    super();
    this.#clock = clock;
    this.#offset = offset;
    Object.assign(this, { fps, rows: frames, duration: frames / fps });
    for (const kind of ["tick", "seek", "play", "pause", "rate", "change"]) {
      clock.addEventListener(kind, () => this.dispatchEvent(new Event(kind)));
    }
  }

  waitFor(ready) {
    this.#clock.waitFor(() => this.resting || ready());
  }

  get offset() {
    return this.#offset;
  }

  set offset(offset) {
    this.#offset = offset;
    this.dispatchEvent(new Event("seek"));
  }

  get #own() {
    return this.#clock.time - this.#offset;
  }

  get time() {
    return Math.min(Math.max(0, this.#own), this.duration);
  }

  get row() {
    return Math.min(this.rows - 1, Math.floor(this.time * this.fps + 1e-6));
  }

  /** True if the episode has no row at the time of the shared clock. */
  get resting() {
    return this.#own < -1e-6 || this.#own > this.duration - 0.5 / this.fps;
  }

  get playing() {
    return this.#clock.playing && !this.resting;
  }

  get rate() {
    return this.#clock.rate;
  }

  pause() {
    this.#clock.pause();
  }

  seek(time) {
    this.#clock.seek(time + this.#offset);
  }

  seekRow(row) {
    this.seek(Math.min(Math.max(0, row), this.rows - 1) / this.fps);
  }
}
