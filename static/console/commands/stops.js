// Stop and pause: over the open socket first, which needs no database; by post under the same uuid where the
// socket is closed or silent. The station carries out a uuid once, whichever way it came.

import { RequestFailed } from "../site/api.js";

const ACK_MS = 500;
const CARRIED_OUT = ["accepted", "done"];

/** The kinds that go this way; pressed again while the first one is under way, they are sent again. */
export const STOPPING = ["stop", "halt"];

/** What the server said of a command, or RequestFailed where it was not carried out or nobody knows. */
export function answered(ack) {
  if (CARRIED_OUT.includes(ack.status)) return ack;
  const unknown = ack.status === "unknown" || ack.status === "pressed";
  throw new RequestFailed(ack.reason || `the station answered ${ack.status}`, { body: ack, unknown });
}

export class Stops {
  #send;
  #post;
  #late;
  #waiting = new Map(); // uuid -> function that takes the acknowledgement

  /** `send(message)` is false where the socket is closed; `late(ack)` hears of answers nobody waits for any more. */
  constructor({ send, post, late }) {
    this.#send = send;
    this.#post = post;
    this.#late = late;
  }

  /** Give `command`; resolves to what was said of it first, whichever way; throws RequestFailed. */
  async give(command, ackMs = ACK_MS) {
    const { kind, uuid, epoch } = command;
    const ack = new Promise((resolve) => this.#waiting.set(uuid, resolve));
    try {
      if (!this.#send({ type: kind, uuid, epoch })) return await this.#post(command);
      const said = await Promise.race([ack, silence(ackMs)]);
      if (said) return answered(said);
      return await Promise.race([ack.then(answered), this.#post(command)]);
    } finally {
      this.#waiting.delete(uuid);
    }
  }

  /** An acknowledgement came over the socket. */
  acknowledged(ack) {
    const take = this.#waiting.get(ack.uuid);
    if (take) take(ack);
    else this.#late(ack);
  }
}

function silence(ms) {
  return new Promise((resolve) => setTimeout(() => resolve(null), ms));
}
