// Who commands: taken, renewed each second while this page is visible, requested, handed over, given up.

import { post } from "../../site/api.js";
import { config } from "../live/config.js";

const RENEW_MS = 1000;
const NAMES = {
  claim: "Take the station",
  give_up: "Give up",
  request: "Ask for the station",
  withdraw: "Withdraw",
  hand_over: "Hand over",
  decline: "Decline",
  move: "Take it here",
};
const AWAY_S = 5; // the lease's time to live

export class LeaseControls {
  #store;
  #socket;
  #commands;
  #hiddenAt = 0;
  #title = document.title;
  #awake = null;
  #refused = 0;
  #before = "unknown";

  constructor(store, socket, commands) {
    this.#store = store;
    this.#socket = socket;
    this.#commands = commands;
    store.on(["snapshot", "link", "open"], () => this.#draw());
    store.on("renewed", (answer) => this.#renewed(answer));
    store.on("changed", (what) => what.includes("lease") && window.htmx.trigger("#lease", "eva:lease"));
    document.body.addEventListener("htmx:afterSettle", () => this.#draw());
    document.addEventListener("click", (event) => this.#clicked(event));
    document.addEventListener("submit", (event) => this.#taken(event));
    document.addEventListener("visibilitychange", () => this.#visibility());
    window.addEventListener("beforeunload", (event) => this.#leaving(event));
    setInterval(() => this.#renew(), RENEW_MS);
    this.#draw();
  }

  /** The server answered a renewal; the station's own state says the rest. */
  #renewed({ ok, reason }) {
    this.#refused = ok || this.#store.lease !== "mine" ? 0 : this.#refused + 1;
    if (this.#refused > 1) this.#commands.say(`Lease not renewed: ${reason}`, "refused"); // once: it was just handed over
  }

  #draw() {
    const lease = this.#store.fresh ? this.#store.lease : "unknown";
    for (const part of document.querySelectorAll("[data-lease-when]")) part.hidden = part.dataset.leaseWhen !== lease;
    for (const name of document.querySelectorAll("[data-lease-holder]")) {
      name.textContent = this.#store.commander;
    }
    document.body.dataset.lease = lease;
    if (lease === this.#before) return;
    if (lease === "mine") this.#stayAwake();
    else if (this.#before === "mine") this.#letSleep();
    this.#before = lease;
  }

  #renew() {
    if (this.#store.lease === "mine" && !document.hidden) this.#socket.send({ type: "renew", epoch: this.#store.epoch });
  }

  async #clicked(event) {
    const button = event.target.closest("[data-lease][type='button']");
    if (!button) return;
    const content = button.dataset.request ? { request: Number(button.dataset.request) } : {};
    await this.#act(button.dataset.lease, NAMES[button.dataset.lease], content);
  }

  async #taken(event) {
    const form = event.target.closest("[data-lease-take]");
    if (!form) return;
    event.preventDefault();
    const done = await this.#act("take", "Take over", { reason: form.elements.reason.value });
    if (done) form.dispatchEvent(new Event("eva:saved", { bubbles: true }));
  }

  async #act(action, name, content) {
    this.#commands.say(`${name}: pressed …`, "pressed");
    try {
      await post(config.api.lease, { action, page: this.#store.page, ...content });
      this.#commands.say(`${name}: done`, "accepted");
      return true;
    } catch (error) {
      this.#commands.fail(name, error);
      return false;
    } finally {
      window.htmx.trigger("#lease", "eva:lease");
    }
  }

  /** A page nobody sees does not command: said beforehand on the page, and here in the tab's title. */
  #visibility() {
    if (document.hidden) {
      if (this.#store.lease !== "mine") return;
      this.#hiddenAt = performance.now();
      document.title = "COME BACK: the robot will hold";
      return;
    }
    if (!this.#hiddenAt) return;
    const away = (performance.now() - this.#hiddenAt) / 1000;
    this.#hiddenAt = 0;
    document.title = this.#title;
    this.#stayAwake();
    this.#renew();
    if (away > AWAY_S) this.#commands.say(`This page was hidden for ${away.toFixed(0)} s: its lease has ended, and a run that was going on is held.`, "refused");
  }

  #leaving(event) {
    if (this.#store.lease === "mine" && this.#store.snapshot.state_is.going) event.preventDefault();
  }

  /** A tablet that darkens its screen would hide the page. */
  async #stayAwake() {
    if (!("wakeLock" in navigator) || document.hidden) return;
    try {
      this.#awake = await navigator.wakeLock.request("screen");
    } catch (error) {
      console.info(`the screen may go dark by itself: ${error.message}`);
    }
  }

  #letSleep() {
    this.#awake?.release();
    this.#awake = null;
  }
}
