// The controls of the lease: take, renew each second, request, hand over, give up. A hidden page says so when it renews: it
// keeps the lease while nothing moves and nobody else asks for it. A run in progress is held, after a countdown with tones.

import { post } from "../../site/api.js";
import { clockTime } from "../../site/times.js";
import { config } from "../live/config.js";
import { t } from "../../site/sentences.js";

const NAMES = {
  claim: t("page.lease.claim", "Take the station"),
  give_up: t("page.lease.give_up", "Give up"),
  request: t("page.lease.request", "Ask for the station"),
  withdraw: t("page.lease.withdraw", "Withdraw"),
  hand_over: t("page.lease.hand_over", "Hand over"),
  decline: t("page.lease.decline", "Decline"),
  move: t("page.lease.move", "Take it here"),
};

const GIVEN_AWAY = ["give_up", "hand_over"];
const WHY = {
  elsewhere: t("page.lease.why_elsewhere", "you took the station on another page"),
  other: "",
  free: t("page.lease.why_free", "the lease was ended by the station"),
};

export class LeaseControls {
  #store;
  #socket;
  #commands;
  #hiddenAt = 0;
  #yields = false; // another user asks for the station while this page is hidden
  #away = ""; // message to show if it turns out that the lease ended while this page was hidden
  #tones = null;
  #title = document.title;
  #awake = null;
  #refused = 0;
  #before = "unknown";
  #mine = false; // this page has commanded, and it is not known yet that it does not any more
  #heardAt = 0; // time of the last renewal [ms]

  constructor(store, socket, commands) {
    this.#store = store;
    this.#socket = socket;
    this.#commands = commands;
    store.on(["snapshot", "link", "open"], () => this.#draw());
    store.on("renewed", (answer) => this.#renewed(answer));
    store.on("changed", (what) => what.includes("lease") && this.#changed());
    document.body.addEventListener("htmx:afterSettle", () => this.#draw());
    document.addEventListener("click", (event) => this.#clicked(event));
    document.addEventListener("submit", (event) => this.#taken(event));
    document.addEventListener("visibilitychange", () => this.#visibility());
    window.addEventListener("beforeunload", (event) => this.#leaving(event));
    new Worker(config.beat).addEventListener("message", () => this.#beat());
    this.#draw();
  }

  /** Take in the answer to a renewal; the snapshot says who has the lease. */
  #renewed({ ok, reason }) {
    this.#refused = ok || this.#store.lease !== "mine" ? 0 : this.#refused + 1;
    if (ok) {
      this.#away = "";
      this.#heardAt = performance.now();
    }
    // A single refusal is normal right after a hand-over.
    if (this.#refused > 1) this.#commands.say(t("page.lease.not_renewed", "Lease not renewed: {reason}", { reason }), "refused");
  }

  #draw() {
    const lease = this.#store.fresh ? this.#store.lease : "unknown";
    for (const part of document.querySelectorAll("[data-lease-when]")) part.hidden = part.dataset.leaseWhen !== lease;
    for (const name of document.querySelectorAll("[data-lease-holder]")) {
      name.textContent = this.#store.commander;
    }
    document.body.dataset.lease = lease;
    if (!["mine", "unknown"].includes(lease)) this.#ended(lease);
    if (lease === this.#before) return;
    if (lease === "mine") {
      this.#mine = true;
      this.#heardAt = performance.now();
      this.#stayAwake();
    }
    if (this.#before === "mine") this.#letSleep();
    this.#before = lease;
  }

  #beat() {
    if (document.hidden) this.#countDown();
    this.#renew();
  }

  /** Renew the lease; the runtime accepts a hidden page's renewal only while nothing moves. */
  #renew() {
    if (this.#store.lease !== "mine" || (document.hidden && this.#yields)) return;
    this.#socket.send({ type: "renew", epoch: this.#store.epoch, ...(document.hidden && { hidden: true }) });
  }

  #changed() {
    this.#yields ||= document.hidden;
    window.htmx.trigger("#lease", "eva:lease");
  }

  /** Show in the tab's title how long until the run is held, with a tone each second. */
  #countDown() {
    const { facts, state_is } = this.#store.snapshot;
    const left = Math.ceil(facts.lease_ttl_s - (performance.now() - this.#hiddenAt) / 1000);
    if (!this.#hiddenAt || !state_is.moving || left < -1) return;
    document.title = left > 0 ? t("page.lease.come_back", "COME BACK: holds in {left} s", { left }) : t("page.lease.held", "the robot is held");
    if (left > 0) this.#tone();
  }

  #tone() {
    this.#tones ??= new AudioContext();
    const tone = new OscillatorNode(this.#tones, { frequency: 880 });
    tone.connect(this.#tones.destination);
    tone.start();
    tone.stop(this.#tones.currentTime + 0.15);
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
    const done = await this.#act("take", t("page.lease.take_over", "Take over"), { reason: form.elements.reason.value });
    if (done) form.dispatchEvent(new Event("eva:saved", { bubbles: true }));
  }

  async #act(action, name, content) {
    this.#commands.say(t("page.common.pressed", "{name}: pressed …", { name }), "pressed");
    const mine = this.#mine;
    if (GIVEN_AWAY.includes(action)) this.#mine = false; // a lease that is given up is not reported as lost
    try {
      await post(config.api.lease, { action, page: this.#store.page, ...content });
      this.#commands.say(t("page.common.done", "{name}: done", { name }), "accepted");
      return true;
    } catch (error) {
      this.#mine = mine;
      this.#commands.fail(name, error);
      return false;
    } finally {
      window.htmx.trigger("#lease", "eva:lease");
    }
  }

  /**
   * Start the countdown when this page is hidden, and prepare the message when it is shown again: a hidden page may not command
   * a robot that moves. The page says so beforehand, and the tab's title meanwhile.
   */
  #visibility() {
    if (document.hidden) {
      if (this.#store.lease !== "mine") return;
      this.#hiddenAt = performance.now();
      this.#beat();
      return;
    }
    if (!this.#hiddenAt) return;
    const away = (performance.now() - this.#hiddenAt) / 1000;
    const held = this.#yields || document.title !== this.#title;
    if (held) this.#away = t("page.lease.hidden", "This page was hidden for {seconds} s: its lease has ended, and a run in progress is held.", { seconds: away.toFixed(0) });
    this.#hiddenAt = 0;
    this.#yields = false;
    document.title = this.#title;
    this.#stayAwake();
    this.#renew();
    this.#draw();
  }

  /** Report that this page no longer commands, since when and why, unless it gave the station away itself. */
  #ended(lease) {
    if (this.#mine || this.#away) this.#commands.say(this.#away || this.#lost(lease), "refused");
    this.#mine = false;
    this.#away = "";
  }

  #lost(lease) {
    const silent = (performance.now() - this.#heardAt) / 1000;
    const expired = silent > 0.8 * this.#store.snapshot.facts.lease_ttl_s;
    const why = expired ? t("page.lease.unheard", "your page was not heard for {seconds} s", { seconds: silent.toFixed(0) }) : WHY[lease];
    const taken = lease === "other" ? t("page.lease.taken", "{who} commands", { who: this.#store.commander }) : "";
    const at = clockTime(Date.now());
    const because = [why, taken].filter(Boolean).join(t("page.common.semicolon", "; "));
    return t("page.lease.lost", "You do not command any more, since {at}: {because}.", { at, because });
  }

  #leaving(event) {
    if (this.#store.lease === "mine" && this.#store.snapshot.state_is.going) event.preventDefault();
  }

  /** Keep the screen on: a tablet that turns it off would hide the page. */
  async #stayAwake() {
    if (!("wakeLock" in navigator) || document.hidden) return;
    try {
      this.#awake = await navigator.wakeLock.request("screen");
    } catch (error) {
      console.info(`the screen may turn off by itself: ${error.message}`);
    }
  }

  #letSleep() {
    this.#awake?.release();
    this.#awake = null;
  }
}
