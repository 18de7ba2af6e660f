// The one websocket of a page: reopened whenever it breaks, with a credit sent for each frame that was drawn.

import { BadFrame, decode } from "./frame.js";

const WAITS_MS = [250, 500, 1000, 2000, 4000]; // waits before each further attempt to connect
const SILENCE_MS = 6000; // silence [ms] after which an open socket that should carry messages counts as dead
const ASK_MS = 2000; // interval [ms] at which the server is told that this page still reads

/**
 * Websocket of a page. `told(message)` is called with every JSON message. `draw(frame)` is called with every frame and resolves
 * when it is on the screen. `changed(open, code)` is called when the connection opens or closes, with the server's close code.
 * `greet()` requests what the page needs; `expected()` returns whether messages should be arriving.
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

  /** Send a JSON message; return false if there is no connection. */
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
