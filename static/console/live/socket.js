// The one websocket of a page: opened again whenever it breaks, credits paid for frames that were drawn.

import { BadFrame, decode } from "./frame.js";

const WAITS_MS = [250, 500, 1000, 2000, 4000]; // before the next try
const SILENCE_MS = 6000; // an open socket on which nothing comes for so long, though it should, is dead
const ASK_MS = 2000; // how often the server hears that this page still reads

/**
 * `told(message)` hears every JSON message, `draw(frame)` every frame and returns when it is on the screen,
 * `changed(open, code)` that the connection is there or gone, with the server's code for it; `greet()` says what is wanted; `expected()` whether
 * frames should be coming.
 */
export class LiveSocket {
  #address;
  #told;
  #draw;
  #changed;
  #greet;
  #expected;
  #timer = 0;
  #socket = null;
  #tries = 0;
  #heard = 0;

  constructor(address, { told, draw, changed, greet, expected }) {
    this.#address = address;
    this.#told = told;
    this.#draw = draw;
    this.#changed = changed;
    this.#greet = greet;
    this.#expected = expected;
    setInterval(() => this.#watch(), ASK_MS);
    window.addEventListener("online", () => this.#connectNow());
    this.#connect();
  }

  get open() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Send a JSON message; false where there is no connection. */
  send(message) {
    if (!this.open) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  #connect() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}${this.#address}`);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    this.#heard = performance.now();
    socket.addEventListener("open", () => {
      this.#changed(true);
      this.#greet();
    });
    socket.addEventListener("message", ({ data }) => this.#receive(socket, data));
    socket.addEventListener("close", ({ code }) => this.#lost(socket, code));
  }

  #receive(socket, data) {
    this.#heard = performance.now();
    this.#tries = 0;
    if (typeof data === "string") this.#told(JSON.parse(data));
    else this.#drawn(socket, data);
  }

  async #drawn(socket, data) {
    try {
      await this.#draw(decode(data));
    } catch (error) {
      if (!(error instanceof BadFrame)) throw error;
      console.error(error.message);
    } finally {
      if (socket.readyState === WebSocket.OPEN) socket.send('{"type":"credit"}');
    }
  }

  #lost(socket, code = 0) {
    if (socket !== this.#socket) return;
    this.#changed(false, code);
    const wait = WAITS_MS[Math.min(this.#tries, WAITS_MS.length - 1)];
    this.#tries += 1;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#connect(), wait * (0.75 + Math.random() / 2));
  }

  #connectNow() {
    if (this.#socket?.readyState !== WebSocket.CLOSED) return;
    clearTimeout(this.#timer);
    this.#connect();
  }

  #watch() {
    if (!this.open) return;
    if (this.#expected() && !document.hidden && performance.now() - this.#heard > SILENCE_MS) {
      const silent = this.#socket;
      silent.close();
      this.#lost(silent);
      return;
    }
    this.#greet({ again: true });
  }
}
