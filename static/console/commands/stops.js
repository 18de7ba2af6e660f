// The commands Stop and Pause: sent over the open socket, which needs no database, and to the process for stops at once; also
// posted under the same uuid if the socket is closed or neither answers. The station carries out a uuid once, whichever way it
// came.

import { RequestFailed } from "../../site/api.js";
import { t } from "../../site/sentences.js";

const ACK_MS = 500;
const CARRIED_OUT = ["accepted", "done"];

/** Kinds of commands that are sent this way. If one is pressed again while the first is under way, it is sent again. */
export const STOPPING = ["stop", "halt"];

/** Return the acknowledgement of a command; throw RequestFailed if it was not carried out or its outcome is unknown. */
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
   * `send(message)` returns false if the socket is closed, `beside(command)` null if there is no process for stops; `late(ack)`
   * is called with answers for which nobody waits any more.
   */
  constructor({ send, beside = () => null, post, late }) {
    this.#send = send;
    this.#beside = beside;
    this.#post = post;
    this.#late = late;
  }

  /**
   * Send `command`; resolve to the first success, whichever way it comes; throw RequestFailed if all ways have failed. `ackMs`
   * is the time [ms] after which it is also posted.
   */
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

  /** Take in an acknowledgement from the socket. */
  acknowledged(ack) {
    const take = this.#waiting.get(ack.uuid);
    if (take) take(ack);
    else this.#late(ack);
  }
}

/** Resolve to the first success, or throw the failure of the first way if all fail. */
function firstOf(ways) {
  return Promise.any(ways).catch(({ errors }) => {
    throw errors[0];
  });
}

function silence(ms) {
  return new Promise((resolve) => setTimeout(() => resolve(null), ms));
}
