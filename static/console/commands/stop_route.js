// The way to a stop that no page keeps busy: the process for stops, at a port of its own, or at the web's own address
// where a proxy leads the e-stop there.

import { get, post, RequestFailed } from "../../site/api.js";

export class StopRoute {
  #origin;
  #paths;
  #alone = false;

  /** `origin` is "" where this page was told of no port; `paths` are those of `estop` and `commands`. */
  constructor(origin, paths) {
    this.#origin = origin;
    this.#paths = paths;
  }

  /** Whether there is one, as far as this page was told. */
  get there() {
    return Boolean(this.#origin) || this.#alone;
  }

  get estop() {
    return this.#origin + this.#paths.estop;
  }

  /** Ask whether it stands; from then on it knows who presses. */
  async ask() {
    try {
      this.#alone = (await get(this.estop)).alone === true;
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      this.#alone = false;
    }
    return this.#alone;
  }

  /** Give a stop or halt this way too; null where a proxy leads it to the web. */
  post(command) {
    return this.#origin ? post(this.#origin + this.#paths.commands, command) : null;
  }
}
