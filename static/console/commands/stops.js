// Stop and pause: over the open socket, which needs no database, and to the process for stops at once; by post under the
// same uuid where the socket is closed or both say nothing. The station carries out a uuid once, whichever way it came.

import { RequestFailed } from "../../site/api.js";
import { t } from "../../site/sentences.js";

const ACK_MS = 500;
const CARRIED_OUT = ["accepted", "done"];

/** The kinds that go this way; pressed again while the first one is under way, they are sent again. */
export const STOPPING = ["stop", "halt"];

/** What the server said of a command, or RequestFailed where it was not carried out or nobody knows. */
export function answered(ack) {
  if (CARRIED_OUT.includes(ack.status)) return ack;
  const unknown = ack.status === "unknown" || ack.status === "pressed";
  throw new RequestFailed(ack.reason || t("page.stops.answered", "the station answered {status}", { status: ack.status }), { body: ack, unknown });
}

export class Stops {
  #send;
  #beside;
  #post;
  #late;
  #waiting = new Map(); // uuid -> function that takes the acknowledgement

  /**
   * `send(message)` is false where the socket is closed, `beside(command)` null where there is no process for stops;
   * `late(ack)` hears of answers nobody waits for any more.
   */
  constructor({ send, beside = () => null, post, late }) {
    this.#send = send;
    this.#beside = beside;
    this.#post = post;
    this.#late = late;
  }

  /** Give `command`; resolves to what was said of it first, whichever way; throws RequestFailed where all have failed. */
  async give(command, ackMs = ACK_MS) {
    const { kind, uuid, epoch } = command;
    const ack = new Promise((resolve) => this.#waiting.set(uuid, resolve)).then(answered);
    try {
      const sent = this.#send({ type: kind, uuid, epoch });
      const beside = [this.#beside(command)].filter(Boolean);
      if (!sent) return await firstOf([this.#post(command), ...beside]);
      const said = await Promise.race([firstOf([ack, ...beside]), silence(ackMs)]);
      if (said) return said;
      return await Promise.race([ack, firstOf([this.#post(command), ...beside])]);
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

/** What the first of them resolves to, or the first one's failure where none does. */
function firstOf(ways) {
  return Promise.any(ways).catch(({ errors }) => {
    throw errors[0];
  });
}

function silence(ms) {
  return new Promise((resolve) => setTimeout(() => resolve(null), ms));
}
