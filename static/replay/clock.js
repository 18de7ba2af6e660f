// One clock for everything on the page: row k is shown from k / fps on.

const LONGEST_STEP_S = 0.25; // a tab that slept does not jump

export class Clock extends EventTarget {
  #fps;
  #frames;
  #time = 0;
  #rate = 1;
  #playing = false;
  #ready = () => true;
  #before = 0;

  constructor({ fps, frames }) {
    super();
    this.#fps = fps;
    this.#frames = frames;
  }

  /** `ready` says whether what follows the clock can go on; while it cannot, the clock waits. */
  waitFor(ready) {
    this.#ready = ready;
  }

  get time() {
    return this.#time;
  }

  get row() {
    return Math.min(this.#frames - 1, Math.floor(this.#time * this.#fps + 1e-6));
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

  play() {
    if (this.#playing) return;
    if (this.row >= this.#frames - 1) this.seek(0);
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

  /** Go to a time [s]; what follows the clock jumps there. */
  seek(time) {
    this.#time = Math.min(Math.max(0, time), this.duration);
    this.#tell("seek");
  }

  /** Go to the start of a row. */
  seekRow(row) {
    this.seek(Math.min(Math.max(0, row), this.#frames - 1) / this.#fps);
  }

  /** `count` rows on, or back; standing still. */
  step(count) {
    this.pause();
    this.seekRow(this.row + count);
  }

  #go(now) {
    if (!this.#playing) return;
    const passed = Math.min(Math.max(0, now - this.#before) / 1000, LONGEST_STEP_S);
    this.#before = now;
    if (this.#ready()) {
      this.#time = Math.min(this.#time + passed * this.#rate, this.duration);
      this.#tell("tick");
      if (this.#time >= this.duration) this.pause();
    }
    requestAnimationFrame((next) => this.#go(next));
  }

  #tell(kind) {
    this.dispatchEvent(new Event(kind));
    if (kind !== "tick") this.dispatchEvent(new Event("change"));
  }
}
