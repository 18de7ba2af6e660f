// The route for stops that no page keeps busy: the process for stops, either on its own port or at the web server's address if
// a proxy forwards the e-stop to it.

import { get, post, RequestFailed } from "../../site/api.js";

export class StopRoute {
  #origin;
  #paths;
  #alone = false;

  /** `origin` is "" if this page was given no port; `paths` are the paths `estop` and `commands`. */
  constructor(origin, paths) {
    this.#origin = origin;
    this.#paths = paths;
  }

  /** True if this page knows of a process for stops. */
  get there() {
    return Boolean(this.#origin) || this.#alone;
  }

  get estop() {
    return this.#origin + this.#paths.estop;
  }

  /** Ask whether the process for stops answers; from then on it knows this user. */
  async ask() {
    try {
      this.#alone = (await get(this.estop)).alone === true;
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      this.#alone = false;
    }
    return this.#alone;
  }

  /**
   * Send a stop or halt by this route too; return null if there is no port for it, because a proxy would lead it to the web
   * server.
   */
  post(command) {
    return this.#origin ? post(this.#origin + this.#paths.commands, command) : null;
  }
}
